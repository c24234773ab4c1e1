"""The survival time by a corridor: the longest outages with which the AGV stays near enough to its reference."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from agv_analysis.corridor.lap_loop import LapLoop, outage
from agv_analysis.corridor.outage_sequences import largest_n, worst_sequence
from agv_analysis.corridor.single_outage import single_outage
from agv_analysis.corridor.widths import Widths, widths_of
from agv_analysis.scenario import Scenario

_LONGEST = 500
"""Longest outages [slots] that are tried in sequences."""

_PLACES = 500
"""Places of the lap from which an outage is tried for how far it leads."""


class CorridorSurvival(NamedTuple):
    """What outages of the uplink a loop takes within its corridor, by the nonlinear loop."""

    half_width: float
    """[m]"""
    single: int | None
    """Longest single outage [slots] from anywhere on the lap; -1: outside without any, None: all that were tried."""
    any_sequence: int | None
    """Largest n for which no sequence of outages of up to n slots was found that leaves; likewise."""


def survival_in_corridor(scenario: Scenario, most: int | None) -> CorridorSurvival | None:
    """What a scenario's loop takes within its corridor; None if it has none.

    Sequences are tried up to `most` slots, beyond which the loop is not stable anyway. Raises TrackFileError if the
    track's file cannot be used, PartError if a part raises.
    """
    widths = widths_of(scenario.error_detector)
    if widths is None:
        return None
    loop = LapLoop(scenario, widths)
    if not loop.loss_free_share <= 1.0:
        return CorridorSurvival(widths.half_width, -1, -1)
    single = single_outage(loop).n
    if single == -1:
        return CorridorSurvival(widths.half_width, -1, -1)
    longest = min(_LONGEST if one is None else one for one in (single, most, _LONGEST))
    n, _ = largest_n(loop, max(0, longest))
    return CorridorSurvival(widths.half_width, single, None if single is None and n == longest and most is None else n)


def deviation_after(scenario: Scenario, n: int) -> float:
    """Largest distance from the reference [m] after one outage of n slots, from anywhere on the lap; inf: diverges."""
    loop = LapLoop(scenario, Widths(1.0, math.inf, math.inf))
    found, _ = loop.excursions(outage(n), max(1, loop.steps // _PLACES))
    largest = float(np.hypot(found.along, found.across).max())
    return largest if math.isfinite(largest) else math.inf


def deviation_of_any(scenario: Scenario, n: int) -> float:
    """Largest distance from the reference [m] that was found in sequences of outages of up to n slots; may be inf."""
    return worst_sequence(LapLoop(scenario, Widths(1.0, math.inf, math.inf)), n).deviation
