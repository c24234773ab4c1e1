"""Recorded outcomes as intervals: between receptions, of outages and of gaps between outages; what is not seen whole.

An interval of L steps between receptions holds an outage of L - 1 slots. Where a series of known slots ends, at the end
of the recording or where steps are missing, an outage that is still open is at least as long as what was seen of it: it
is a censored observation, kept apart from the complete ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from agv_analysis.metrics.outages import is_unbroken

Steps = NDArray[np.int64]
Outcomes = NDArray[np.bool_]


@dataclass(frozen=True)
class Intervals:
    """What a recording shows of a link, in the order of time; lengths in slots."""

    k: Steps
    """The slots of the recording, shape (N,)."""
    lost: Outcomes
    """Their outcomes."""
    outages: Steps
    """Complete series of lost slots."""
    gaps: Steps
    """Complete series of received slots, from an outage to the next."""
    longest_open: int
    """The longest outage of which the end was not seen, or not the beginning; 0 if there is none."""
    longest_open_gap: int
    """The same of gaps."""

    @cached_property
    def between_receptions(self) -> Steps:
        """L, complete, shape (n,)."""
        received = np.flatnonzero(~self.lost)
        between = np.diff(received)
        if is_unbroken(self.k):
            return between
        series = np.searchsorted(np.flatnonzero(np.diff(self.k) != 1), received)
        return np.asarray(between[np.diff(series) == 0])

    @property
    def longest(self) -> int:
        """Slots of the longest outage, complete or not; 0 without losses."""
        return max(int(self.outages.max(initial=0)), self.longest_open)


def reception_intervals(k: Steps, lost: Outcomes) -> Intervals:
    """Intervals of outcomes `lost` of the slots `k`, increasing, both of shape (N,), N >= 1."""
    breaks = np.zeros(len(k) - 1, dtype=np.bool_) if is_unbroken(k) else np.diff(k) != 1
    begins = np.append(0, np.flatnonzero(breaks | (lost[1:] != lost[:-1])) + 1)
    lengths, is_lost = np.diff(begins, append=len(lost)), lost[begins]
    seen_from = np.append(False, ~breaks[begins[1:] - 1])
    whole = seen_from & np.append(seen_from[1:], False)
    return Intervals(
        k,
        lost,
        outages=lengths[whole & is_lost],
        gaps=lengths[whole & ~is_lost],
        longest_open=int(lengths[~whole & is_lost].max(initial=0)),
        longest_open_gap=int(lengths[~whole & ~is_lost].max(initial=0)),
    )
