"""Outages that repeat: the period of a recorded series of outcomes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled import compiled
from agv_analysis.link.reception_intervals import Outcomes, Steps

_PERIODS = 3
"""Fewest periods that a recording must show, and twice as many changes between lost and received."""


def period_of(k: Steps, lost: Outcomes) -> int | None:
    """Smallest number of slots after which all outcomes repeat; None if there is none, or steps are missing.

    `k` and `lost` of shape (N,). Outcomes that are all the same have no outages that could repeat. What comes before
    the end of the first outage may be otherwise: a run begins with a pose that is known.
    """
    if np.any(np.diff(k) != 1) or np.count_nonzero(np.diff(lost)) < 2 * _PERIODS:
        return None
    ends = np.flatnonzero(lost[:-1] & ~lost[1:]) + 1
    for begin in (0, int(ends[0])):
        rest = np.ascontiguousarray(lost[begin:])
        period = int(compiled(_smallest_period)(rest, np.zeros(len(rest), dtype=np.int64)))
        if begin <= 2 * period and _PERIODS * period <= len(rest):
            return period
    return None


def _smallest_period(lost: Outcomes, borders: NDArray[np.int64]) -> int:
    """N less the longest proper border (Knuth, Morris and Pratt, SIAM J. Comput. 6, 1977)."""
    for i in range(1, len(lost)):
        length = borders[i - 1]
        while length > 0 and lost[i] != lost[length]:
            length = borders[length - 1]
        borders[i] = length + 1 if lost[i] == lost[length] else length
    return len(lost) - int(borders[-1])
