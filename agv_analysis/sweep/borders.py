"""Borders of stability that theory draws through a sweep: where a loop along a straight track ceases to be stable."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.sweep.plan import Axis, varied

if TYPE_CHECKING:
    from agv_analysis.stability.criteria.criterion import Border

_BORDER_VALUES = 40
"""Values of an axis for a smooth border."""


@functools.lru_cache(maxsize=8)
def border_places(base: Scenario, axis: Axis) -> dict[str, list[float]]:
    """Where on an axis the borders of stability are crossed, by name of the border, as `margins`.

    Found once for all pictures of a sweep, which change nothing in it.
    """
    fine = _between(axis)
    found = margins(base, (axis,), [(value,) for value in fine])
    crossed = {name: np.flatnonzero(margin[:-1] * margin[1:] < 0.0).tolist() for name, margin in found.items()}
    return {name: [0.5 * (fine[i] + fine[i + 1]) for i in places] for name, places in crossed.items()}


@functools.lru_cache(maxsize=8)
def border_maps(base: Scenario, across: Axis, up: Axis) -> tuple[list[float], list[float], dict[str, Floats]]:
    """Values across (M,) and up (N,), and on their grid (N, M) by name of the border how far a point is from it.

    The border is where that is zero; only those that cross the grid are there. Signs and NaN are those of `margins`.
    Found once for all pictures of a sweep, which change nothing in it.
    """
    x, y = _between(across), _between(up)
    found = margins(base, (across, up), [(i, j) for j in y for i in x])
    maps = {name: margin.reshape(len(y), len(x)) for name, margin in found.items()}
    return x, y, {name: margin for name, margin in maps.items() if _changes_sign(margin)}


def _changes_sign(margin: Floats) -> bool:
    finite = margin[np.isfinite(margin)]
    return bool(finite.size and finite.min() < 0.0 < finite.max())


def _between(axis: Axis) -> list[float]:
    """Values of an axis for a smooth line: its own, if they are whole numbers, else as many as look smooth."""
    if all(isinstance(value, int) for value in axis.values):
        return sorted(axis.values)
    fine: list[float] = np.linspace(min(axis.values), max(axis.values), _BORDER_VALUES).tolist()
    return fine


def margins(base: Scenario, axes: Sequence[Axis], points: Sequence[tuple[Any, ...]]) -> dict[str, Floats]:
    """How far each point is from the borders of stability along a straight track: negative where it is stable.

    By name of the border, shape (points,); NaN where theory is silent: another channel, late messages, losses on the
    downlink, a predicted pose, a loop without an error along the track of its own.
    """
    borders = _borders()
    scenarios = [varied(base, axes, point) for point in points]
    found = np.array([[border.value(scenario) for border in borders] for scenario in scenarios])
    return {border.name: found[:, i] for i, border in enumerate(borders)}


def _borders() -> list[Border]:
    """Those of the criteria that have one."""
    from agv_analysis.stability.criteria import CRITERIA

    return [criterion.border for criterion in CRITERIA if criterion.border is not None]
