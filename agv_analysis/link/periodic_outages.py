"""Outages that repeat: the period of a recorded series of outcomes, and the outcomes of a schedule that is known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import compiled
from agv_analysis.link.reception_intervals import Outcomes, Steps
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.delay import whole_slots

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


_LONGEST = 1_000_000
"""Slots of a schedule's period that are looked at."""


def scripted_outages(channel: ChannelParameters, ts: float) -> Outcomes | None:
    """Outcomes of one period of a link that loses nothing but what its schedule has lost again and again, shape (P,).

    `ts` is the period of slots [s]. None for any other link, for one that loses everything, and for a long period.
    """
    if channel.model != "perfect" or len(channel.entries) != 1:
        return None
    outage = channel.entries[0].outage
    period, slots = whole_slots(outage.period / ts), whole_slots(outage.length / ts)
    return np.arange(period) < slots if 0 < slots < period <= _LONGEST else None


def _smallest_period(lost: Outcomes, borders: NDArray[np.int64]) -> int:
    """N less the longest proper border (Knuth, Morris and Pratt, SIAM J. Comput. 6, 1977)."""
    for i in range(1, len(lost)):
        length = borders[i - 1]
        while length > 0 and lost[i] != lost[length]:
            length = borders[length - 1]
        borders[i] = length + 1 if lost[i] == lost[length] else length
    return len(lost) - int(borders[-1])
