"""A sweep as a picture: a curve over one axis, a heat map over two, with the borders that theory draws."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.sweep.plan import Axis, Sweep, SweepError, varied

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from agv_analysis.link.markov_channel import Chain

BORDERS = {"mean square": "#d62728", "almost surely": "#ff9f1c"}
"""Borders of stability along a straight track by name, with their colours."""

_BORDER_VALUES = 40


def draw(sweep: Sweep, rows: list[dict[str, Any]], metric: str, path: Path) -> None:
    """Draw a column of the rows to a PNG, SVG or PDF file.

    Raises SweepError for a sweep that has neither one nor two axes of numbers, or if the file cannot be written.
    """
    from matplotlib.figure import Figure

    if not can_draw(sweep):
        raise SweepError(f"{path}: only one or two axes of numbers make a picture, this sweep has {len(sweep.axes)}")
    figure = Figure(figsize=(8.0, 5.5), layout="constrained")
    axes = figure.add_subplot()
    if len(sweep.axes) == 1:
        _curve(axes, sweep, rows, metric)
    else:
        figure.colorbar(_heat_map(axes, sweep, rows, metric), label=_title(metric))
    axes.set_title(f"{_title(metric)}, {max(row['runs'] for row in rows)} seeds a point", fontsize="medium")
    try:
        figure.savefig(path, dpi=130)
    except (OSError, ValueError) as error:
        raise SweepError(f"{path}: cannot be drawn to: {error}") from None


def can_draw(sweep: Sweep) -> bool:
    """Has the sweep one or two axes, of finite numbers?"""
    return len(sweep.axes) in (1, 2) and all(
        isinstance(value, (int, float)) and math.isfinite(value) for axis in sweep.axes for value in axis.values
    )


def _title(metric: str) -> str:
    return "probability of instability" if metric == "instability" else metric


def _curve(axes: Axes, sweep: Sweep, rows: list[dict[str, Any]], metric: str) -> None:
    (axis,) = sweep.axes
    rows = sorted(rows, key=lambda row: float(row[axis.name]))
    x = [row[axis.name] for row in rows]
    axes.plot(x, [row[metric] for row in rows], ".-", color="#1f6fb4", label=_title(metric))
    if metric == "instability":
        low, high = ([row[f"instability_{end}"] for row in rows] for end in ("low", "high"))
        axes.fill_between(x, low, high, color="#1f6fb4", alpha=0.2, label="95 % confidence")
    for name, places in border_places(sweep.base, axis).items():
        for place in places:
            axes.axvline(place, color=BORDERS[name], ls="--", label=f"border: {name}")
    axes.set(xlabel=axis.label, ylabel=_title(metric))
    axes.legend(fontsize="small")


def _heat_map(axes: Axes, sweep: Sweep, rows: list[dict[str, Any]], metric: str) -> Any:
    across, up = across_and_up(sweep)
    x, y = sorted(across.values), sorted(up.values)
    places = {(row[across.name], row[up.name]): row[metric] for row in rows}
    heat = np.array([[places.get((i, j), np.nan) for i in x] for j in y], dtype=np.float64)
    heat[np.isinf(heat)] = np.nan
    low, high = (0.0, 1.0) if metric == "instability" else (None, None)
    image = axes.pcolormesh(x, y, heat, shading="nearest", cmap="viridis", vmin=low, vmax=high)
    *fine, found = border_maps(sweep.base, across, up)
    for name, margin in found.items():
        axes.contour(*fine, np.ma.masked_invalid(margin), levels=[0.0], colors=BORDERS[name], linestyles="--")
        axes.plot([], [], color=BORDERS[name], ls="--", label=f"border: {name}")
        axes.legend(loc="upper right", fontsize="small")
    axes.set(xlabel=across.label, ylabel=up.label)
    return image


def across_and_up(sweep: Sweep) -> tuple[Axis, Axis]:
    """The axes of a map from left to right and from bottom to top: K_x, if it is varied, lies across."""
    across, up = sorted(sweep.axes, key=lambda axis: axis.name != "controller.kx")
    return across, up


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
    from agv_analysis.stability.scenario_loop import straight_loop_of

    chain, loop = _renewals(scenario), straight_loop_of(scenario)
    a = loop.along_gain
    if chain is None or a is None or loop.predicts:
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
