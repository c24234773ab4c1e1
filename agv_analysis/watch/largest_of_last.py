"""The largest of the last values of a series that grows."""

from __future__ import annotations

import math
from collections import deque


class LargestOfLast:
    """The largest of the last `count` values; NaN does not count.

    Values that a later one exceeds cannot become the largest any more and are forgotten, so that those that are kept
    decrease and the first one is the largest: `add` needs constant time on average, `value` always.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._added = 0
        self._kept: deque[tuple[int, float]] = deque()
        """Number and value of those that may be the largest now or later."""

    def add(self, value: float) -> None:
        """Append a value."""
        if not math.isnan(value):
            while self._kept and self._kept[-1][1] <= value:
                self._kept.pop()
            self._kept.append((self._added, value))
        self._added += 1
        while self._kept and self._kept[0][0] < self._added - self._count:
            self._kept.popleft()

    @property
    def value(self) -> float:
        """The largest; NaN if there is none."""
        return self._kept[0][1] if self._kept else math.nan
