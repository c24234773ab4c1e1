"""Panels as figures of plotly.js: plain dictionaries, as they go into its JSON."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.report.panels import (
    BARS,
    DRIVEN,
    LIMIT,
    LOST,
    MARKERS,
    OTHER,
    PEAK,
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
}
"""Each is seen on white and on black."""

MOST_POINTS = 20_000
"""Points of one line in a report; longer runs are thinned."""

MOST_MARKERS = 5000
"""Single points: each is an element of the page, and costs as much as many points of a line."""

_LONGEST_CAUSE = 60
"""Letters of a cause that are shown, at most."""

_GAP = 0.22
"""Share of a row that is left free above it, for its legend."""


def figure(panels: Sequence[Panel], most: int = MOST_POINTS, markers: int = MOST_MARKERS) -> dict[str, Any]:
    """A figure of panels one below the other on one common x axis, which zooms all of them.

    Lines are drawn as vectors: without a graphics card WebGL takes seconds for what they take a tenth of one, and in
    print they stay sharp.
    """
    rows = len(panels)
    found: list[dict[str, Any]] = []
    layout: dict[str, Any] = {
        "margin": {"l": 60, "r": 12, "t": 32, "b": 44},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "modebar": {"bgcolor": "rgba(0,0,0,0)"},
        "hovermode": "closest" if panels[0].equal else "x",
        "uirevision": panels[0].key,
        "xaxis": {
            "title": {"text": panels[0].x_label}, "anchor": f"y{rows if rows > 1 else ''}", "zeroline": False,
        },
    }  # fmt: skip
    for row, panel in enumerate(panels):
        number = str(row + 1) if row else ""
        top = 1.0 - row / rows - (_GAP / rows if rows > 1 else 0.0)
        bottom = 1.0 - (row + 1) / rows
        layout[f"yaxis{number}"] = {"domain": [max(0.0, bottom), top], **_y_axis(panel)}
        layout[f"legend{number}"] = {"orientation": "h", "x": 0.0, "y": top, "yanchor": "bottom"}
        of_row = {"yaxis": f"y{number}", "legend": f"legend{number}"}
        found += [_trace(line, most, markers) | of_row for line in panel.lines]
    return {"data": found, "layout": layout}


def traces(lines: Sequence[Line], most: int = MOST_POINTS) -> list[dict[str, Any]]:
    """Lines to be added to a figure of one panel."""
    return [_trace(line, most, MOST_MARKERS) | {"yaxis": "y", "legend": "legend"} for line in lines]


def _y_axis(panel: Panel) -> dict[str, Any]:
    axis: dict[str, Any] = {"title": {"text": panel.y_label}, "zeroline": False, "exponentformat": "power"}
    if panel.log:
        axis["type"] = "log"
    if panel.equal:
        axis |= {"scaleanchor": "x", "scaleratio": 1}
    if panel.y_range is not None:
        axis["range"] = list(panel.y_range)
    return axis


def _trace(line: Line, most: int, markers: int) -> dict[str, Any]:
    line = thinned(line, markers if line.style == MARKERS else most)
    colour = COLOURS[line.role]
    trace: dict[str, Any] = {"name": line.name, "x": _packed(line.x), "y": _packed(line.y), "showlegend": True}
    if line.style == BARS:
        return {**trace, "type": "bar", "marker": {"color": colour}}
    trace["type"] = "scatter"
    if line.style == MARKERS:
        why = {} if line.slots is None else _why(line.slots)
        return {**trace, "mode": "markers", "marker": {"color": colour, "size": 4}, **why}
    if line.style == RINGS:
        ring = {"symbol": "circle-open", "size": 14, "color": colour, "line": {"width": 2}}
        return {**trace, "mode": "markers", "marker": ring}
    dash = {"dash": "dash"} if line.role == LIMIT else {}
    shape = {"shape": "hv"} if line.style == STEP else {}
    return {**trace, "mode": "lines", "line": {"color": colour, "width": 1.5, **dash, **shape}}


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


def _packed(values: Floats) -> dict[str, str]:
    """Numbers as plotly.js takes them in binary, in single precision, which is finer than a pixel."""
    largest = float(np.finfo(np.float32).max)
    return _binary(np.clip(values, -largest, largest).astype("<f4"), "f4")


def _binary(values: NDArray[Any], dtype: str) -> dict[str, str]:
    return {"dtype": dtype, "bdata": base64.b64encode(values.tobytes()).decode("ascii")}
