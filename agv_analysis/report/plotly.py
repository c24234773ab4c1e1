"""Panels as figures of plotly.js: plain dictionaries, as they go into its JSON."""

from __future__ import annotations

import base64
import html
import math
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    Slots,
    thinned,
)
from agv_analysis.run import Floats

COLOURS = {
    REFERENCE: "#8a8a8a",
    DRIVEN: "#3b8bd0",
    LOST: "#e0453c",
    OTHER: "#e39a2d",
    LIMIT: "#8a8a8a",
    PEAK: "#a06cd5",
    PINNED: "#e39a2d",
    **dict(zip(DEVIATIONS, ("#3b8bd0", "#1f9e89", "#c9a227", "#e0762a", "#d6249f"), strict=True)),
}
"""Each is seen on white and on black."""

MOST_POINTS = 20_000
"""Points of one line in a report; longer runs are thinned."""

MOST_MARKERS = 5000
"""Single points: each is an element of the page, and costs as much as many points of a line."""

_LONGEST_CAUSE = 60
"""Letters of a cause that are shown, at most."""

_LONGEST = 4.0
"""A track that is more times as long as broad has axes that show more than it."""

_FEW_LINES = 5
"""Lines whose names fit above a panel."""

_LEGEND = {"orientation": "h", "x": 0.0}
_LEGEND_BELOW = {
    **_LEGEND, "yref": "container", "y": 0.0, "yanchor": "bottom", "entrywidth": 0.5, "entrywidthmode": "fraction",
    "font": {"size": 11},
}  # fmt: skip
"""In two columns."""

_LEGEND_ROW = 19
"""Its height [pixels]."""

_LEGEND_LINE = 14
"""Height of a further line of one name [pixels]."""

_COLUMN = 22
"""Letters of a name in one line of a column."""

_ROW = 40
"""Letters of a name that has a row of a legend for itself."""

_MODE_BAR = 32
"""Height of the buttons that plotly.js shows on top of a figure [pixels]."""

_SPIKE = {"spikethickness": 1, "spikedash": "solid", "spikecolor": "#8a8a8a"}

_GAP = 0.22
"""Share of a row that is left free above it, for its legend."""


def figure(
    panels: Sequence[Panel], most: int = MOST_POINTS, markers: int = MOST_MARKERS, is_tight: bool = True
) -> dict[str, Any]:
    """A figure of panels one below the other on one common x axis, which zooms all of them.

    `is_tight`: axes of one scale end where the track does, which takes plotly.js some 40 ms longer.

    Lines are drawn as vectors: without a graphics card WebGL takes seconds for what they take a tenth of one, and in
    print they stay sharp.
    """
    is_long = len(panels) == 1 and len(panels[0].lines) > _FEW_LINES
    below = _height_below([line.name for line in panels[0].lines]) if is_long else 0
    rows, is_track = len(panels), panels[0].equal
    above = _MODE_BAR + (0 if is_long else _LEGEND_ROW)
    found: list[dict[str, Any]] = []
    layout: dict[str, Any] = {
        "margin": {"l": 60, "r": 12, "t": above if rows == 1 else 10, "b": 44 + below},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "modebar": {"bgcolor": "rgba(0,0,0,0)"},
        "hovermode": "closest" if is_track else "x",
        "uirevision": panels[0].key,
        "xaxis": {
            "title": {"text": panels[0].x_label}, "anchor": f"y{rows if rows > 1 else ''}", "zeroline": False,
        },
    }  # fmt: skip
    if rows > 1:  # one cursor through all of them
        layout["hoversubplots"] = "axis"
        layout["xaxis"] |= {"showspikes": True, "spikemode": "across", "spikesnap": "hovered data", **_SPIKE}
    is_tight = is_tight and is_track and _is_broad(panels[0])
    if is_tight:
        layout["xaxis"]["constrain"] = "domain"
    for row, panel in enumerate(panels):
        number = str(row + 1) if row else ""
        top = 1.0 - row / rows - (_GAP / rows if rows > 1 else 0.0)
        bottom = 1.0 - (row + 1) / rows
        layout[f"yaxis{number}"] = {"domain": [max(0.0, bottom), top], **_y_axis(panel, is_tight)}
        layout[f"legend{number}"] = _LEGEND_BELOW if is_long else {**_LEGEND, "y": top, "yanchor": "bottom"}
        of_row = {"yaxis": f"y{number}", "legend": f"legend{number}"}
        found += [_trace(line, most, markers) | of_row for line in panel.lines]
    if is_long:
        for trace in found:
            trace["name"] = "<br>".join(_wrapped(trace["name"]))
    return {"data": found, "layout": layout}


def _wrapped(name: str, most: int = _COLUMN) -> list[str]:
    """A name in lines of so many letters; by default they fit a column of a legend, on a phone as well."""
    return textwrap.wrap(name, most, break_long_words=False) or [name]


def _height_below(names: Sequence[str]) -> int:
    """Height of a legend of two columns [pixels]."""
    lines = [len(_wrapped(name)) for name in names]
    further = sum(max(lines[row : row + 2]) - 1 for row in range(0, len(lines), 2))
    return _LEGEND_ROW * -(-len(lines) // 2) + _LEGEND_LINE * further + 8


def traces(lines: Sequence[Line], most: int = MOST_POINTS) -> list[dict[str, Any]]:
    """Lines to be added to a figure of one panel."""
    found = [_trace(line, most, MOST_MARKERS) | {"yaxis": "y", "legend": "legend"} for line in lines]
    return [trace | {"name": "<br>".join(_wrapped(trace["name"], _ROW))} for trace in found]


def aspect(panel: Panel) -> float:
    """Height of what a panel shows over its width; inf of a line upwards, NaN of a point."""
    x, y = (np.concatenate([getattr(line, name) for line in panel.lines]) for name in ("x", "y"))
    width, height = (float(np.nanmax(values) - np.nanmin(values)) for values in (x, y))
    return height / width if width > 0.0 else math.inf if height > 0.0 else math.nan


def _is_broad(panel: Panel) -> bool:
    """Is it so broad and so high that axes of just its size can be read?"""
    return 1.0 / _LONGEST < aspect(panel) < _LONGEST


def _y_axis(panel: Panel, is_tight: bool) -> dict[str, Any]:
    # Of a large linear axis 50k is shorter than 0.5 x 10^5, which would lie over its title.
    axis: dict[str, Any] = {
        "title": {"text": panel.y_label}, "zeroline": False, "exponentformat": "SI", "hoverformat": ".3~r",
    }  # fmt: skip
    if panel.log:
        axis |= {"type": "log", "exponentformat": "power"}
    if panel.equal:
        axis |= {"scaleanchor": "x", "scaleratio": 1} | ({"constrain": "domain"} if is_tight else {})
    if panel.y_range is not None:
        axis["range"] = np.log10(panel.y_range).tolist() if panel.log else list(panel.y_range)
    return axis


def _trace(line: Line, most: int, markers: int) -> dict[str, Any]:
    line = thinned(line, markers if line.style in (MARKERS, HALOS) else most)
    colour = COLOURS[line.role]
    trace: dict[str, Any] = {
        "name": line.name,
        "x": packed_values(line.x),
        "y": packed_values(line.y),
        "showlegend": True,
    }
    if line.style == BARS:
        return {**trace, "type": "bar", "marker": {"color": colour}}
    trace["type"] = "scatter"
    if line.style == HALOS or line.role == OTHER:
        trace["zorder"] = -1  # under the line that matters
    if line.style in (MARKERS, HALOS):
        why = {} if line.slots is None else _why(line.slots)
        marker = {"size": 8, "opacity": 0.2} if line.style == HALOS else {"size": 4}
        return {**trace, "mode": "markers", "marker": {"color": colour, **marker}, **why}
    if line.style == RINGS:
        ring = {"symbol": "circle-open", "size": 14, "color": colour, "line": {"width": 2}}
        return {**trace, "mode": "markers", "marker": ring}
    dash = {"dash": {LIMIT: "dash", PINNED: "dot"}[line.role]} if line.role in (LIMIT, PINNED) else {}
    shape = {"shape": "hv"} if line.style == STEP else {}
    width = 3 if line.role in DEVIATIONS else 1.5
    return {**trace, "mode": "lines", "line": {"color": colour, "width": width, **dash, **shape}}


def _why(slots: Slots) -> dict[str, Any]:
    """What is shown of a slot under the pointer: its step and why its message was lost.

    plotly.js takes some tags and `%{` in a text for its own, so none is left in a cause, which is another's word.
    """
    names, of = np.unique(slots.cause, return_inverse=True)
    causes = [html.escape(cause[:_LONGEST_CAUSE]).replace("%", "&#37;") or "not recorded" for cause in names.tolist()]
    place = "step %{customdata}, (%{x:.3f}, %{y:.3f}) m<br>cause: "
    steps = {"customdata": _binary(slots.k.astype("<f8"), "f8")}
    if len(causes) == 1:
        return {**steps, "hovertemplate": place + causes[0]}
    return {**steps, "text": [causes[i] for i in of.tolist()], "hovertemplate": place + "%{text}"}


def packed_values(values: Floats) -> dict[str, str]:
    """Numbers as plotly.js takes them in binary, in single precision, which is finer than a pixel."""
    largest = float(np.finfo(np.float32).max)
    return _binary(np.clip(values, -largest, largest).astype("<f4"), "f4")


def _binary(values: NDArray[Any], dtype: str) -> dict[str, str]:
    return {"dtype": dtype, "bdata": base64.b64encode(values.tobytes()).decode("ascii")}
