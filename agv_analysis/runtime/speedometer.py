"""How fast a run goes."""

from __future__ import annotations

import time


class Speedometer:
    """Speed between the first and the last step that was seen."""

    def __init__(self) -> None:
        self._first: tuple[int, float] | None = None
        self._last = (0, 0.0)

    def see(self, steps: int) -> None:
        """Record that `steps` steps are done now."""
        if steps > self._last[0]:
            self._last = (steps, time.monotonic())
            self._first = self._first or self._last

    @property
    def rate(self) -> float:
        """Steps per second."""
        (k, begun), (end_k, ended) = self._first or self._last, self._last
        return (end_k - k) / (ended - begun) if end_k > k else 0.0
