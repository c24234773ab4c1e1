"""Panels drawn by matplotlib; as figures for a paper: one column wide, SVG and PDF, with all letters in the file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agv_analysis.output_file import save_figure
from agv_analysis.report.panels import (
    BARS,
    DEVIATIONS,
    DRIVEN,
    HALOS,
    LIMIT,
    LOST,
    MARKERS,
    OTHER,
    PEAK,
    PINNED,
    REFERENCE,
    RINGS,
    STEP,
    Line,
    Panel,
    thinned,
)
from agv_ros.errors import UserError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH = 3.5
"""Width of a column [inch]."""

STYLE: Any = {
    "font.size": 8.0,
    "axes.linewidth": 0.6,
    "pdf.fonttype": 42,  # TrueType, embedded: what journals require
    "svg.fonttype": "path",  # letters as paths: no font is missing anywhere
    "svg.hashsalt": "agv_ncs",  # the same bytes for the same run
}

COLOURS = {
    REFERENCE: "#7f7f7f", DRIVEN: "#1f6fb4", LOST: "#d62728", OTHER: "#e08214", LIMIT: "black", PEAK: "#7b3fb5",
    PINNED: "#e08214",
    **dict(zip(DEVIATIONS, ("#1f6fb4", "#1b7f6d", "#a9861a", "#c85f17", "#b3157f"), strict=True)),
}  # fmt: skip

_COLUMN = 26
"""Letters of a name that fit half the width of a figure."""

_MOST_POINTS = 4000
"""Points of a line: more than a printer can show in a column."""


def draw_figures(panels: Iterable[Panel], folder: Path) -> list[Path]:
    """Draw each panel to `folder`/<key>.svg and .pdf. Raises UserError if that cannot be written to."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    drawn = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for panel in panels:
            with mpl.rc_context(STYLE):
                figure = Figure(figsize=(WIDTH, WIDTH if panel.equal else 0.62 * WIDTH), layout="constrained")
                draw_panel(figure.add_subplot(), panel)
                for suffix in ("svg", "pdf"):
                    drawn.append(folder / f"{panel.key}.{suffix}")
                    save_figure(figure, drawn[-1])
    except OSError as error:
        raise UserError(f"{folder}: cannot be written to: {error.strerror or error}") from None
    return drawn


def draw_panel(axes: Axes, panel: Panel) -> None:
    """Draw a panel on axes of matplotlib."""
    for line in panel.lines:
        _draw_line(axes, thinned(line, _MOST_POINTS))
    axes.set(xlabel=panel.x_label, ylabel=panel.y_label)
    if panel.log:
        axes.set_yscale("log")
    if panel.equal:
        axes.set_aspect("equal", adjustable="datalim")
    if panel.y_range is not None:
        axes.set_ylim(*panel.y_range)
    is_short = all(len(line.name) <= _COLUMN for line in panel.lines)
    legend_above(axes, columns=2 if is_short else 1)


def legend_above(axes: Axes, columns: int = 2, **form: Any) -> None:
    """The legend of axes above them, where it covers nothing."""
    axes.legend(
        fontsize=6.0,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=columns,
        frameon=False,
        borderaxespad=0.2,
        **form,
    )


def _draw_line(axes: Axes, line: Line) -> None:
    colour = COLOURS[line.role]
    if line.style == BARS:
        axes.bar(line.x, line.y, color=colour, label=line.name)
    elif line.style == MARKERS:
        axes.plot(line.x, line.y, ".", color=colour, ms=2.0, label=line.name, rasterized=len(line.x) > _MOST_POINTS)
    elif line.style == HALOS:
        axes.plot(line.x, line.y, ".", color=colour, ms=5.0, mew=0.0, alpha=0.25, zorder=1.0, label=line.name)
    elif line.style == RINGS:
        axes.plot(line.x, line.y, "o", color=colour, ms=6.0, mfc="none", mew=0.8, label=line.name)
    elif line.style == STEP:
        axes.step(line.x, line.y, where="post", color=colour, lw=0.6, label=line.name)
    else:
        dash = "--" if line.role == LIMIT else "-"
        zorder = 1.5 if line.role == OTHER else 2.0  # under the line that matters
        width = 0.6 if line.role == LIMIT else 0.9
        axes.plot(line.x, line.y, dash, color=colour, lw=width, zorder=zorder, label=line.name)
