"""Channels whose losses depend on where the AGV is when the message is sent.

What such a model knows about the floor, holes or waves, is a table of floats, made once for a run; an outcome is a
scalar function of that table, of two levels that may change while it runs, of the slot's uniform random number and of
the place. The relay knows the place from the poses that it passes on; the downlink takes the one that it saw last.
"""

from __future__ import annotations

import math

from agv_plant.channels.coverage_hole import Table, coverage_hole, is_in_hole
from agv_plant.channels.rayleigh import fading_gain, rayleigh

NOWHERE = (math.nan, math.nan)
"""The place of an AGV whose pose is unknown: in no hole, in no fade."""

EVERYWHERE, COVERAGE_HOLE, RAYLEIGH = range(3)

PLACED = ("", "coverage_hole", "rayleigh")
"""Models by name, each at the place of its number; the first stands for all others."""


def kind_of(model: str) -> int:
    """Number of the model called `model`: EVERYWHERE if it does not depend on the place."""
    return PLACED.index(model) if model in PLACED else EVERYWHERE


def outcome_at(
    kind: int, spatial_table: Table, level: float, other: float, u: float, x: float, y: float
) -> tuple[bool, float]:
    """Is a message lost that is sent at the place (x, y) [m], and the channel's gain there [dB], NaN if it has none.

    `kind` is COVERAGE_HOLE or RAYLEIGH, `level` and `other` are its two levels, `u` is uniform in [0, 1).
    """
    if kind == RAYLEIGH:
        gain = fading_gain(x, y, spatial_table)
        return rayleigh(gain, level), gain
    return coverage_hole(u, is_in_hole(x, y, spatial_table), level, other), math.nan
