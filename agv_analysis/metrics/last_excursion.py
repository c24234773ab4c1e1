"""The last time that an AGV was away from its reference, and the outage behind it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agv_analysis.metrics.bands import TOLERANCE
from agv_analysis.metrics.outages import longest_outage_between, outage_rows
from agv_analysis.run import Floats, Run


@dataclass(frozen=True)
class LastExcursion:
    """The last stretch of steps at which the distance to the reference was 1 cm or more."""

    seconds: float
    """When it ended [s], from the first step of the run: at the first step below 1 cm, or at the run's last step."""
    is_over: bool
    """Was the AGV within 1 cm when the run ended?"""
    after: int | None
    """Slots of the longest outage, of either link, by which it began or went on; None if there was none."""
    is_initial_error: bool
    """Is it the error that the run began with?"""


def last_excursion(run: Run, distance: Floats, left: Floats | None) -> LastExcursion | None:
    """Of a run with its distance to the reference [m], shape (N,); None if it was below 1 cm throughout.

    `left`, shape (N,), is the part of it [m] that is left of the initial error; None if that is not known.
    """
    outside = np.flatnonzero(~(distance < TOLERANCE))  # so written, NaN is outside
    if not len(outside):
        return None
    last = int(outside[-1])
    inside_before = np.flatnonzero(distance[:last] < TOLERANCE)
    first = int(inside_before[-1]) + 1 if len(inside_before) else 0
    is_over = last + 1 < len(run)
    seconds = float(run.time[last + 1 if is_over else last] - run.time[0])
    outage = longest_outage_between(outage_rows(run), first, last)
    is_initial = first == 0 and outage is None if left is None else bool(left[last] >= 0.5 * distance[last])
    after = None if is_initial or outage is None else outage.slots
    return LastExcursion(seconds, is_over, after, is_initial)
