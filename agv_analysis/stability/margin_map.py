"""Margins over a grid of any two of the control law's gains, T_s, v and the curvature of the track, at constant speed.

Where the loop has a closed form all points of the grid are computed at once; elsewhere each is a linear loop of its
own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.stability.criteria import CRITERIA
from agv_analysis.stability.criteria.criterion import MapColumn
from agv_analysis.stability.derived_loop import has_closed_form, linear_loop
from agv_analysis.stability.error_dynamics import NoNominalMotionError
from agv_analysis.stability.margin_map_points import Point
from agv_analysis.stability.scenario_loop import lap_of
from agv_cloud.control.registry import CONTROL_LAWS, KANAYAMA
from agv_ros.errors import UserError

Ints = NDArray[np.int64]

TS, SPEED, CURVATURE = "ts", "v", "curvature"
"""Axes beside the gains."""


def map_columns() -> tuple[MapColumn, ...]:
    """Of the criteria that can be mapped."""
    return tuple(criterion.map_column for criterion in CRITERIA if criterion.map_column is not None)


@dataclass(frozen=True)
class MarginMap:
    """Margins over a grid; row i belongs to `first[i]`, column j to `second[j]`; -1: unstable without outages."""

    axes: tuple[str, str]
    labels: tuple[str, str]
    """The axes with their units."""
    first: Floats
    second: Floats
    margins: dict[str, NDArray[Any]]
    """By the criterion's column, each of shape (rows, columns)."""


def axes_of(scenario: Scenario) -> dict[str, tuple[float, str]]:
    """Value and unit of each axis that a scenario's map can have; v is the track's highest speed."""
    law, controller = CONTROL_LAWS.find(scenario.controller.law), scenario.controller
    found = {
        known.name: (value, known.unit) for known, value in zip(law.parameters, controller.gains, strict=True)
    }  # fmt: skip
    found |= {TS: (scenario.plant.ts, "s"), SPEED: (float(np.abs(lap_of(scenario)[:, 3]).max()), "m/s")}
    return found | {CURVATURE: (0.0, "1/m")}


def ranges_of(scenario: Scenario, axes: Sequence[str], points: int) -> list[Floats]:
    """Values of each axis about a scenario: from a tenth to ten times its own, from 0 to 1 where that is 0.

    Raises UserError for an axis that does not exist.
    """
    return [_range(_known(scenario, axis)[0], points) for axis in axes]


def _range(value: float, points: int) -> Floats:
    return np.linspace(0.0, 1.0, points) if value == 0.0 else value * np.logspace(-1.0, 1.0, points)


def _known(scenario: Scenario, axis: str) -> tuple[float, str]:
    known = axes_of(scenario)
    if axis not in known:
        raise UserError(f"a map has no axis {axis!r}: choose two of {', '.join(known)}")
    return known[axis]


def margin_map(
    scenario: Scenario, axes: tuple[str, str], first: Floats, second: Floats,
    progress: Callable[[int], None] = lambda done: None,
) -> MarginMap:  # fmt: skip
    """Margins where the axes take the values `first`, shape (rows,), and `second`, (columns,); all else is as it is.

    `progress` receives the number of points done. Raises UserError for axes that do not exist or are the same.
    """
    units = [_known(scenario, axis)[1] for axis in axes]
    if axes[0] == axes[1]:
        raise UserError(f"a map needs two different axes, got {axes[0]} twice")
    at_first = {name: value for name, (value, _) in axes_of(scenario).items()}
    places = [{**at_first, axes[0]: x, axes[1]: y} for x in first.tolist() for y in second.tolist()]
    labels = [f"{axis} [{unit}]" if unit else axis for axis, unit in zip(axes, units, strict=True)]
    fastest = max(places, key=lambda place: abs(place[SPEED]))
    v, w = np.array([fastest[SPEED]]), np.array([fastest[SPEED] * fastest[CURVATURE]])
    if scenario.error_detector.policy != "predict" and has_closed_form(scenario, v, w):
        points = [Point(**place) for place in places]
        progress(len(points))
        found = {column.name: column.of_points(points) for column in map_columns()}
    else:
        rows = []
        for place in places:
            rows.append(_of_place(scenario, place))
            progress(len(rows))
        found = {column.name: np.array([row[i] for row in rows]) for i, column in enumerate(map_columns())}
    shape = (len(first), len(second))
    return MarginMap(
        axes, (labels[0], labels[1]), first, second, {name: n.reshape(shape) for name, n in found.items()}
    )  # fmt: skip


def _of_place(scenario: Scenario, place: Mapping[str, float]) -> list[int]:
    """The margins of one point; -1 where the loop does not settle even without losses."""
    v = place[SPEED]
    try:
        loop = linear_loop(scenario_at(scenario, place), np.array([v]), np.array([v * place[CURVATURE]]))
    except NoNominalMotionError:
        return [-1] * len(map_columns())
    return [column.of_loop(loop) for column in map_columns()]


def scenario_at(scenario: Scenario, place: Mapping[str, float]) -> Scenario:
    """The scenario with the gains and the period of a point of its map; its track is as it was."""
    law = scenario.controller.law
    prefix = "controller" if law == KANAYAMA else f"controller.{law}"
    gains = [f"{prefix}.{known.name}={place[known.name]!r}" for known in CONTROL_LAWS.find(law).parameters]
    return scenario.with_settings([*gains, f"plant.ts={place[TS]!r}"], "the map")
