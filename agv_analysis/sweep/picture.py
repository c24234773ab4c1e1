"""A sweep as a picture: a curve over one axis, a heat map over two, with the borders that theory draws."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agv_analysis.output_file import output_file
from agv_analysis.sweep.borders import border_maps, border_places
from agv_analysis.sweep.plan import Axis, Sweep, SweepError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = {"mean square": "#d62728", "almost surely": "#ff9f1c"}
"""Of the borders of stability, by name."""


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
        figure.savefig(output_file(path), dpi=130)
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
            axes.axvline(place, color=COLOURS[name], ls="--", label=f"border: {name}")
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
        axes.contour(*fine, np.ma.masked_invalid(margin), levels=[0.0], colors=COLOURS[name], linestyles="--")
        axes.plot([], [], color=COLOURS[name], ls="--", label=f"border: {name}")
        axes.legend(loc="upper right", fontsize="small")
    axes.set(xlabel=across.label, ylabel=up.label)
    return image


def across_and_up(sweep: Sweep) -> tuple[Axis, Axis]:
    """The axes of a map from left to right and from bottom to top: K_x, if it is varied, lies across."""
    across, up = sorted(sweep.axes, key=lambda axis: axis.name != "controller.kx")
    return across, up
