"""Borders of stability that theory draws through a sweep: where a loop along a straight track ceases to be stable."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.sweep.plan import Axis, varied

if TYPE_CHECKING:
    from agv_analysis.link.markov_channel import Chain

BORDERS = ("mean square", "almost surely")
"""Names of the borders."""

_BORDER_VALUES = 40
"""Values of an axis for a smooth border."""


def border_places(base: Scenario, axis: Axis) -> dict[str, list[float]]:
    """Where on an axis the borders of stability are crossed, by name of the border, as `margins`."""
    fine = _between(axis)
    found = margins(base, (axis,), [(value,) for value in fine])
    crossed = {name: np.flatnonzero(margin[:-1] * margin[1:] < 0.0).tolist() for name, margin in found.items()}
    return {name: [0.5 * (fine[i] + fine[i + 1]) for i in places] for name, places in crossed.items()}


def border_maps(base: Scenario, across: Axis, up: Axis) -> tuple[list[float], list[float], dict[str, Floats]]:
    """Values across (M,) and up (N,), and on their grid (N, M) by name of the border how far a point is from it.

    The border is where that is zero; only those that cross the grid are there. Signs and NaN are those of `margins`.
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
    downlink, a predicted pose. T_s K_x is that of the AGV's true speed.

    mean square:    T_s K_x (E[n_ul] + 1/2) - 1, for independent lengths of outages
    almost surely:  the Lyapunov exponent E[log|1 - T_s K_x L|] / E[L], L steps from one reception to the next
    """
    found = np.array([_margins(varied(base, axes, point)) for point in points]).reshape(-1, 2)
    return dict(zip(BORDERS, found.T, strict=True))


def _margins(scenario: Scenario) -> tuple[float, float]:
    from agv_analysis.stability.almost_sure import exponent_along

    chain, a = _renewals(scenario), scenario.plant.ts * scenario.controller.kx * scenario.plant.speed_scale
    if chain is None or scenario.error_detector.policy == "predict":
        return math.nan, math.nan
    return a * (chain.mean_age + 0.5) - 1.0, exponent_along(a, chain)


def _renewals(scenario: Scenario) -> Chain | None:
    """The uplink as a chain whose outages have independent lengths.

    None if it is none, if its messages come late, or if the downlink does anything to its own.
    """
    from agv_analysis.link.markov_channel import chain_of

    uplink, downlink = scenario.relay.uplink, scenario.relay.downlink
    is_late = any(link.delay > 0.0 or link.jitter > 0.0 for link in (uplink, downlink))
    if is_late or downlink.model != "perfect" or downlink.schedule:
        return None
    if uplink.model == "gilbert_elliott" and (uplink.h, uplink.k) != (0.0, 1.0):
        return None
    return chain_of(uplink)
