"""A node that is stopped takes what is under way to it, and knows when that is all."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping

_QUIET = 0.1
"""Nothing is under way any more when nothing has come for so long [s]."""


def has_all(received: Mapping[str, int], published: Mapping[str, int]) -> bool:
    """Has a node received all that was published on its topics? Both are counts by full name of the topic."""
    return all(count >= published.get(topic, 0) for topic, count in received.items())


class Settling:
    """What has come to a node since it was stopped."""

    def __init__(self) -> None:
        self._received = -1
        self._since = 0.0
        """When the newest message was noticed, by the steady clock [s]."""
        self._give_up = math.inf

    def is_over(self, received: int, patience: float) -> bool:
        """Has all come? `received` counts the messages so far; after `patience` [s] from the first call on it has."""
        now = time.monotonic()
        if received != self._received:
            self._received, self._since, self._give_up = received, now, min(self._give_up, now + patience)
        return now - self._since > _QUIET or now > self._give_up
