"""Recorded outcomes as intervals: between receptions, of outages and of gaps between outages; what is not seen whole.

An interval of L steps between receptions holds an outage of L - 1 slots. Where a series of known slots ends, at the end
of the recording or where steps are missing, an outage that is still open is at least as long as what was seen of it: it
is a censored observation, kept apart from the complete ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.large_arrays import column_of, parts, taken
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
        return column_of(self._between_receptions(), np.int64)

    def _between_receptions(self) -> Iterator[Steps]:
        """The same in parts."""
        last = np.zeros(0, dtype=np.int64)
        for part in parts(len(self.lost), self.lost, self.k):
            received = np.concatenate((last, part.start + np.flatnonzero(~self.lost[part])))
            between, last = np.diff(received), received[-1:]
            yield between if is_unbroken(self.k) else between[np.diff(self.k[received]) == between]

    @property
    def longest(self) -> int:
        """Slots of the longest outage, complete or not; 0 without losses."""
        return max(int(self.outages.max(initial=0)), self.longest_open)


def series_of(k: Steps, lost: Outcomes) -> tuple[Steps, Steps, Outcomes]:
    """Where each series of slots with the same outcome begins, its length, and was it lost? Each of shape (n,)."""

    def begins() -> Iterator[Steps]:
        yield np.zeros(1, dtype=np.int64)
        for part in parts(len(lost) - 1, k, lost):
            here, following = slice(part.start, part.stop), slice(part.start + 1, part.stop + 1)
            is_other = lost[following] != lost[here]
            if not is_unbroken(k):
                is_other |= k[following] - k[here] != 1
            yield part.start + 1 + np.flatnonzero(is_other)

    found = np.concatenate(list(begins()))
    return found, np.diff(found, append=len(lost)), taken(lost, found)


def reception_intervals(k: Steps, lost: Outcomes) -> Intervals:
    """Intervals of outcomes `lost` of the slots `k`, increasing, both of shape (N,), N >= 1."""
    begins, lengths, is_lost = series_of(k, lost)
    seen_from = np.ones(len(begins), dtype=np.bool_)
    if not is_unbroken(k):
        seen_from = taken(k, begins) - taken(k, np.maximum(begins - 1, 0)) == 1
    seen_from[0] = False
    whole = seen_from & np.append(seen_from[1:], False)
    return Intervals(
        k,
        lost,
        outages=lengths[whole & is_lost],
        gaps=lengths[whole & ~is_lost],
        longest_open=int(lengths[~whole & is_lost].max(initial=0)),
        longest_open_gap=int(lengths[~whole & ~is_lost].max(initial=0)),
    )
