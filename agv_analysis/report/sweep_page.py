"""The report of a sweep: how likely the loop is unstable, point by point."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from agv_analysis.report.page import fill, versions, write_page
from agv_analysis.report.panels import DRIVEN, LIMIT, Line, Panel, plain
from agv_analysis.report.plotly import figure
from agv_analysis.stability.verdict import GREEN, MEAN_SQUARE
from agv_analysis.sweep.borders import border_maps, border_places
from agv_analysis.sweep.picture import COLOURS, across_and_up, can_draw, draw
from agv_analysis.sweep.plan import Axis, Sweep
from agv_analysis.sweep.verdicts import counted
from agv_ros.errors import UserError

_MOST_ROWS = 500

Rows = list[dict[str, Any]]


def sweep_sentence(rows: Rows) -> str:
    """What a sweep found, in one sentence: a point counts as stable if every run is and its verdict does not object."""
    if not rows:
        return "No point of the sweep was run."
    short = sum(row.get("undecided", 0) > 0 for row in rows)
    calm = sum(row["unstable"] == 0 and not row.get("undecided") and _is_green(row) for row in rows)
    bad = sum(row["unstable"] == row["runs"] for row in rows)
    if calm == len(rows):
        return f"The loop is stable in every run at all {len(rows)} points."
    too_short = f"; at {short} runs are too short to say" if short else ""
    return f"Of {len(rows)} points the loop is stable in every run at {calm}, and in none at {bad}{too_short}."


def _is_green(row: dict[str, Any]) -> bool:
    return row.get("verdict", MEAN_SQUARE) in GREEN


def write_sweep_report(sweep: Sweep, rows: Rows, path: Path, command: str) -> None:
    """Write the report of a sweep; `command` repeats it. Raises UserError as `write_report`."""
    drawn = {"instability": sweep_figure(sweep, rows)} if rows and can_draw(sweep) else {}
    plain = [{name: _plain(value) for name, value in row.items()} for row in rows]
    parameters = sweep.base.to_yaml(of_all_parts=True)
    html = fill(
        "sweep.html.j2",
        figures=drawn,
        data={
            "sentence": sweep_sentence(rows),
            "words": counted(rows),
            "points": plain,
            "parameters": parameters,
            "versions": versions(),
        },
        title="agv_ncs: sweep",
        verdict=sweep_sentence(rows),
        word="unknown",
        words=counted(rows),
        sections=[{"key": key, "title": "Probability of instability", "height": 520} for key in drawn],
        columns=list(plain[0]) if plain else [],
        rows=plain[:_MOST_ROWS],
        left_out=max(0, len(plain) - _MOST_ROWS),
        scenario=sweep.base,
        parameters=parameters,
        reproduce=command,
    )
    write_page(html, path)


def sweep_figure(sweep: Sweep, rows: Rows) -> dict[str, Any]:
    """Probability of instability: with its confidence over one axis, as a heat map over two; with theory's borders."""
    if len(sweep.axes) == 1:
        return _curve(sweep, sweep.axes[0], rows)
    return _heat_map(sweep, rows)


def _curve(sweep: Sweep, axis: Axis, rows: Rows) -> dict[str, Any]:
    rows = sorted(rows, key=lambda row: float(row[axis.name]))
    x = np.array([row[axis.name] for row in rows], dtype=np.float64)
    names = (("instability", DRIVEN), ("instability_low", LIMIT), ("instability_high", LIMIT))
    lines = tuple(Line(name, x, np.array([row[name] for row in rows]), role) for name, role in names)
    found = figure([Panel("instability", "Instability", axis.label, "probability", lines, y_range=(-0.02, 1.02))])
    for name, places in border_places(sweep.base, axis).items():
        if places:
            x_border = [x for place in places for x in (place, place, None)]
            found["data"].append(_border(name, "scatter", x_border, [0.0, 1.0, None] * len(places)) | {"mode": "lines"})
    return found


def _heat_map(sweep: Sweep, rows: Rows) -> dict[str, Any]:
    across, up = across_and_up(sweep)
    x_values, y_values = sorted(across.values), sorted(up.values)
    places = {(row[across.name], row[up.name]): _plain(row["instability"]) for row in rows}
    z = [[places.get((i, j)) for i in x_values] for j in y_values]
    heat = {"type": "heatmap", "x": x_values, "y": y_values, "z": z, "zmin": 0.0, "zmax": 1.0}
    layout = {
        "xaxis": {"title": {"text": across.label}}, "yaxis": {"title": {"text": up.label}},
        "paper_bgcolor": "rgba(0,0,0,0)", "plot_bgcolor": "rgba(0,0,0,0)",
        "margin": {"l": 60, "r": 12, "t": 32, "b": 44},
        "legend": {"orientation": "h", "x": 0.0, "y": 1.0, "yanchor": "bottom"},
    }  # fmt: skip
    return {"data": [{**heat, "colorscale": "Viridis"}, *_borders(sweep, across, up)], "layout": layout}


def _borders(sweep: Sweep, across: Axis, up: Axis) -> Iterator[dict[str, Any]]:
    """Contours of zero: left of them, or below, the loop is stable along a straight track."""
    x, y, maps = border_maps(sweep.base, across, up)
    for name, margin in maps.items():
        at_zero = {"start": 0.0, "end": 0.0, "size": 1.0, "coloring": "none"}
        z = [plain(row) for row in margin]
        yield _border(name, "contour", x, y) | {"z": z, "contours": at_zero, "showscale": False}


def _border(name: str, kind: str, x: Any, y: Any) -> dict[str, Any]:
    line = {"color": COLOURS[name], "dash": "dash", "width": 2}
    return {
        "type": kind, "name": f"border: {name}", "x": x, "y": y, "line": line, "showlegend": True, "hoverinfo": "skip",
    }  # fmt: skip


def draw_sweep_figures(sweep: Sweep, rows: Rows, folder: Path) -> None:
    """Draw the probability of instability to `folder`, as SVG and PDF. Raises UserError if that is not possible."""
    import matplotlib as mpl

    from agv_analysis.report.matplotlib_figures import STYLE

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be written to: {error.strerror}") from None
    with mpl.rc_context(STYLE):
        for suffix in ("svg", "pdf"):
            draw(sweep, rows, "instability", folder / f"instability.{suffix}")


def _plain(value: Any) -> Any:
    """JSON has neither infinity nor NaN."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
