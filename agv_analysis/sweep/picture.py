"""A sweep as a picture: a curve over one axis, a heat map over two, with the borders that theory draws."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agv_analysis.output_file import save_figure
from agv_analysis.report.matplotlib_figures import legend_above
from agv_analysis.sweep.axis_words import axis_words
from agv_analysis.sweep.borders import border_maps, border_places
from agv_analysis.sweep.plan import Axis, Sweep, SweepError
from agv_analysis.sweep.verdicts import NOT_GREEN, not_green
from agv_ros.counted import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = ("#8a8a8a", "#0a8f6a", "#b8860b", "#2f6fdb", "#7b3fb5", "#d6249f")

INSTABILITY_COLOURS = ("#d8efe0", "#f3c77a", "#c0392b")
"""From a probability of instability of 0 to 1: the lines of all borders are seen on each, and each is seen in grey."""


_SHEET = (8.0, 5.5)
"""Size of a picture that stands by itself [inch]."""


def border_colour(name: str) -> str:
    """Colour of a border of stability, by the place of its criterion among those that have one."""
    from agv_analysis.stability.criteria import CRITERIA

    names = [criterion.border.name for criterion in CRITERIA if criterion.border is not None]
    return _COLOURS[names.index(name) % len(_COLOURS)]


def draw(sweep: Sweep, rows: list[dict[str, Any]], metric: str, path: Path, size: tuple[float, float] = _SHEET) -> None:
    """Draw a column of the rows to a PNG, SVG or PDF file of this size [inch].

    Raises SweepError for a sweep that has neither one nor two axes of numbers, or if the file cannot be written.
    """
    from matplotlib.figure import Figure

    if not can_draw(sweep):
        raise SweepError(f"{path}: only one or two axes of numbers make a picture, this sweep has {len(sweep.axes)}")
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot()
    if len(sweep.axes) == 1:
        _curve(axes, sweep, rows, metric)
    else:
        figure.colorbar(_heat_map(axes, sweep, rows, metric), label=_title(metric))
    if size == _SHEET:  # in a paper the caption says it
        runs = counted(max(row["runs"] for row in rows), "seed")
        figure.suptitle(f"{_title(metric)}, {runs} a point", fontsize="medium")
    try:
        save_figure(figure, path, dpi=130)
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
        _mark(axes, [(row[axis.name], row[metric]) for row in not_green(rows)])
    for name, places in border_places(sweep.base, axis).items():
        for place in places:
            axes.axvline(place, color=border_colour(name), ls="--", label=f"border: {name}")
    axes.set(xlabel=axis_words(axis, sweep.base), ylabel=_title(metric))
    legend_above(axes)


def _mark(axes: Axes, places: list[tuple[float, float]]) -> None:
    if places:
        axes.plot(*zip(*places, strict=True), "x", color="#3a3a3a", ms=4, label=NOT_GREEN)


def _heat_map(axes: Axes, sweep: Sweep, rows: list[dict[str, Any]], metric: str) -> Any:
    from matplotlib.colors import LinearSegmentedColormap

    across, up = across_and_up(sweep)
    x, y = sorted(across.values), sorted(up.values)
    places = {(row[across.name], row[up.name]): row[metric] for row in rows}
    heat = np.array([[places.get((i, j), np.nan) for i in x] for j in y], dtype=np.float64)
    heat[np.isinf(heat)] = np.nan
    low, high = (0.0, 1.0) if metric == "instability" else (None, None)
    colours: Any = "viridis"
    if metric == "instability":
        colours = LinearSegmentedColormap.from_list("instability", INSTABILITY_COLOURS)
    image = axes.pcolormesh(x, y, heat, shading="nearest", cmap=colours, vmin=low, vmax=high)
    *fine, found = border_maps(sweep.base, across, up)
    for name, margin in found.items():
        axes.contour(*fine, np.ma.masked_invalid(margin), levels=[0.0], colors=border_colour(name), linestyles="--")
        axes.plot([], [], color=border_colour(name), ls="--", label=f"border: {name}")
    marked = not_green(rows) if metric == "instability" else []
    _mark(axes, [(row[across.name], row[up.name]) for row in marked])
    if found or marked:
        legend_above(axes)
    axes.set(xlabel=axis_words(across, sweep.base), ylabel=axis_words(up, sweep.base))
    return image


def across_and_up(sweep: Sweep) -> tuple[Axis, Axis]:
    """The axes of a map from left to right and from bottom to top: K_x, if it is varied, lies across."""
    across, up = sorted(sweep.axes, key=lambda axis: axis.name != "controller.kx")
    return across, up
