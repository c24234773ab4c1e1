"""What reliable DDS makes of a lossy link: losses become late bursts.

Theory of operation. A reliable writer sends again what was lost, and a reliable reader passes messages on only in their
order. While the link is down nothing comes. The first message that comes through shows the reader what is missing; it
asks for it, and has it a round trip later, if the link is up then, else as soon as it is. Until then it holds back what
came meanwhile. So an outage is followed by all of its messages at once. A writer that keeps only the newest `history`
messages has forgotten those before them: these are lost for good.

Slots in, slots out; whether a slot is lost on the air says the channel below.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

LONGEST = 4096
"""Slots after which a message that has not come through is given up; at most as many it takes to send again."""

AHEAD = 3 * LONGEST
"""Slots within which each message has come, or never comes."""

GIVEN_UP = -1
"""In place of a wait."""


def waits_of(lost: NDArray[np.bool_], resend: int, history: int) -> NDArray[np.int64]:
    """Slots until the reader passes on the messages of the first N - AHEAD slots, GIVEN_UP for those it never does.

    `lost`: on the air, shape (N,); `resend`: slots from the first message that comes through until the missing ones are
    here; `history`: how many the writer keeps, 0: all.
    """
    size, k = len(lost), np.arange(len(lost))
    up = _next_up(lost)
    again = up + min(resend, LONGEST)
    arrival = np.where(lost, up[np.minimum(again, size - 1)], k)
    is_given_up = lost & ((up >= size) | (again >= size) | (arrival >= size))
    if history:
        is_given_up |= lost & (arrival - k >= history)
    held_until = np.maximum.accumulate(np.where(is_given_up, 0, arrival))
    return np.where(is_given_up, GIVEN_UP, held_until - k)[: size - AHEAD]


def _next_up(lost: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The first slot from each on that is not lost, within LONGEST of it; else one past the end; shape (N,)."""
    size = len(lost)
    following = np.where(lost, size, np.arange(size))
    following = np.minimum.accumulate(following[::-1])[::-1]
    return np.where(following - np.arange(size) > LONGEST, size, following)


class Retransmission:
    """The same slot by slot; what is lost ahead of a slot is asked for only as far as that matters."""

    def __init__(self, is_lost: Callable[[int], bool]) -> None:
        """`is_lost`: on the air, in a slot; asked for each one once, in order, but for leaps."""
        self._is_lost = is_lost
        self._known: dict[int, bool] = {}
        self._last = -1
        self._held_until = 0

    def wait(self, k: int, resend: int, history: int) -> int:
        """Slots until the reader passes on the message of slot k, GIVEN_UP if it never does."""
        if k != self._last:
            if k != self._last + 1:
                self._held_until = 0
                for j in range(max(0, k - AHEAD), k):
                    self._held_until = max(self._held_until, self._arrival(j, resend, history))
            self._last, self._own = k, self._arrival(k, resend, history)
            self._held_until = max(self._held_until, self._own)
            if len(self._known) > 2 * AHEAD:
                self._known = {j: lost for j, lost in self._known.items() if j >= k}
        return GIVEN_UP if self._own < 0 else self._held_until - k

    def _arrival(self, k: int, resend: int, history: int) -> int:
        """Slot in which the message of slot k is here, if none before it is missing; GIVEN_UP if it never is."""
        if not self._lost(k):
            return k
        up = self._up_from(k)
        again = -1 if up < 0 else self._up_from(up + min(resend, LONGEST))
        if again < 0 or (history and again - k >= history):
            return GIVEN_UP
        return again

    def _up_from(self, k: int) -> int:
        """The first slot from k on that is not lost, -1 if there is none soon."""
        return next((j for j in range(k, k + LONGEST + 1) if not self._lost(j)), -1)

    def _lost(self, k: int) -> bool:
        if k not in self._known:
            self._known[k] = self._is_lost(k)
        return self._known[k]
