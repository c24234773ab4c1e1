"""The report of a sweep: how likely the loop is unstable, point by point."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agv_analysis.metrics.distance_text import metres
from agv_analysis.report.heat_map import colour_scale, heat_map_layout
from agv_analysis.report.page import fill, versions, write_page
from agv_analysis.report.panels import DRIVEN, LIMIT, Line, Panel, distance, plain, thinned
from agv_analysis.report.plotly import figure, packed_values
from agv_analysis.report.sweep_table import number, sweep_table
from agv_analysis.report.tiles import Tile
from agv_analysis.simulation.single import simulate, steps_of
from agv_analysis.sweep.axis_words import axis_words
from agv_analysis.sweep.borders import border_maps, border_places
from agv_analysis.sweep.picture import INSTABILITY_COLOURS, across_and_up, border_colour, can_draw, draw
from agv_analysis.sweep.plan import Axis, Sweep, varied
from agv_analysis.sweep.sweep_sentence import Rows, best_point, is_calm, sweep_reason, sweep_sentence
from agv_analysis.sweep.verdicts import NOT_GREEN, not_green, words_said
from agv_ros.counted import counted
from agv_ros.errors import UserError

_MOST_ROWS = 500

_MOST_LAP_STEPS = 10_000_000
"""Steps of all laps that are simulated again for the page, some seconds; of a sweep that has more none is."""

_MOST_LAPS = 400
"""Points with a lap in the page."""

_LAP_POINTS = 300
"""Points of a lap in the page: the lowest and the highest of each two pixels."""


def write_sweep_report(sweep: Sweep, rows: Rows, path: Path, command: str) -> None:
    """Write the report of a sweep; `command` repeats it. Raises UserError as `write_report`."""
    drawn = {"instability": sweep_figure(sweep, rows)} if rows and can_draw(sweep) else {}
    plain = [{name: _plain(value) for name, value in row.items()} for row in rows]
    parameters = sweep.base.to_yaml(of_all_parts=True)
    heads, cells = sweep_table(sweep, rows)
    laps = list(_laps(sweep, rows))
    html = fill(
        "sweep.html.j2",
        figures=drawn,
        more={"laps": laps},
        data={
            "sentence": sweep_sentence(rows, *sweep.axes),
            "words": words_said(rows),
            "reason": sweep_reason(rows, *sweep.axes),
            "axes": [axis.name for axis in (across_and_up(sweep) if len(sweep.axes) == 2 else sweep.axes)],
            "points": plain,
            "commands": [_command_of(sweep, row) for row in rows],
            "parameters": parameters,
            "versions": versions(),
        },
        title="agv_ncs: sweep",
        verdict=sweep_sentence(rows, *sweep.axes),
        word="unknown",
        words=words_said(rows),
        why=_why(rows),
        reason=sweep_reason(rows, *sweep.axes),
        tiles=list(_tiles(sweep, rows)),
        sections=[{"key": key, "title": "Probability of instability", "height": 520} for key in drawn],
        axes=[(axis.name, axis_words(axis, sweep.base)) for axis in sweep.axes],
        has_laps=any(laps),
        chosen=rows.index(best_point(rows)) if rows else -1,
        heads=heads,
        rows=cells[:_MOST_ROWS],
        left_out=max(0, len(plain) - _MOST_ROWS),
        columns=len(plain[0]) if plain else 0,
        scenario=sweep.base,
        parameters=parameters,
        reproduce=command,
    )
    write_page(html, path)


def _why(rows: Rows) -> str:
    """What the page's reason is one for."""
    calm = sum(map(is_calm, rows))
    if calm in (0, len(rows)):
        return "Why" if calm else "Why none is"
    return f"Why the other {counted(len(rows) - calm, 'point is', 'points are')} not"


def _tiles(sweep: Sweep, rows: Rows) -> Iterator[Tile]:
    """What is asked first of a sweep."""
    if not rows:
        return
    calm = [row for row in rows if is_calm(row)]
    yield Tile(
        "stable",
        "Stable",
        f"{len(calm)} of {counted(len(rows), 'point')}",
        "in all runs" + " and by the verdict" * ("verdict" in rows[0]),
    )
    if calm:
        best = best_point(rows)
        where = ", ".join(f"{axis.name} {number(best[axis.name])}" for axis in sweep.axes)
        yield Tile("deviation", "Smallest worst deviation", metres(best["deviation_max_p50"]), f"at {where} (median)")
        sure = max(row["instability_high"] for row in calm)
        said = f"by {counted(calm[0]['runs'], 'run')} at each point, with 95 % confidence"
        yield Tile("sure", "How sure", f"below {100.0 * sure:.3g} % unstable", said)


def _laps(sweep: Sweep, rows: Rows) -> Iterator[dict[str, Any] | None]:
    """The distance to the reference over the run of each point's first seed; None where it is left out."""
    scenarios = [varied(sweep.base, sweep.axes, [row[axis.name] for axis in sweep.axes]) for row in rows]
    if len(rows) > _MOST_LAPS or sum(map(steps_of, scenarios)) > _MOST_LAP_STEPS:
        return
    for scenario in scenarios:
        try:
            line = thinned(distance(simulate(scenario)).lines[0], _LAP_POINTS)
        except UserError:  # the sweep's own runs have said why
            yield None
        else:
            yield {"time": packed_values(line.x), "distance": packed_values(line.y)}


def _command_of(sweep: Sweep, row: dict[str, Any]) -> str:
    settings = " ".join(f"--set {axis.name}={_literal(row[axis.name])}" for axis in sweep.axes)
    return f"agv-ncs simulate params.yaml {settings} --report lap.html"


def _literal(value: Any) -> str:
    return ".inf" if value == math.inf else str(value)


def sweep_figure(sweep: Sweep, rows: Rows) -> dict[str, Any]:
    """Probability of instability: with its confidence over one axis, as a heat map over two; with theory's borders."""
    if len(sweep.axes) == 1:
        return _curve(sweep, sweep.axes[0], rows)
    return _heat_map(sweep, rows)


def _curve(sweep: Sweep, axis: Axis, rows: Rows) -> dict[str, Any]:
    rows = sorted(rows, key=lambda row: float(row[axis.name]))
    x = np.array([row[axis.name] for row in rows], dtype=np.float64)
    names = (
        ("instability", "probability of instability", DRIVEN), ("instability_low", "at least, 95 % confidence", LIMIT),
        ("instability_high", "at most, 95 % confidence", LIMIT),
    )  # fmt: skip
    lines = tuple(Line(label, x, np.array([row[name] for row in rows]), role) for name, label, role in names)
    words = axis_words(axis, sweep.base)
    found = figure([Panel("instability", "Instability", words, "probability", lines, y_range=(-0.02, 1.02))])
    found["data"][0]["mode"] = "lines+markers"
    found["data"] += _marks([(row[axis.name], row["instability"]) for row in not_green(rows)])
    for name, places in border_places(sweep.base, axis).items():
        if places:
            x_border = [x for place in places for x in (place, place, None)]
            found["data"].append(_border(name, "scatter", x_border, [0.0, 1.0, None] * len(places)) | {"mode": "lines"})
    return found


def _heat_map(sweep: Sweep, rows: Rows) -> dict[str, Any]:
    across, up = across_and_up(sweep)
    x_values, y_values = sorted(across.values), sorted(up.values)
    found = {(row[across.name], row[up.name]): row for row in rows}
    cells = [[found.get((i, j), {}) for i in x_values] for j in y_values]
    words = axis_words(across, sweep.base), axis_words(up, sweep.base)
    heat = {
        "type": "heatmap", "x": x_values, "y": y_values, "zmin": 0.0, "zmax": 1.0,
        "colorscale": colour_scale(INSTABILITY_COLOURS),
        "z": [[_plain(cell.get("instability")) for cell in line] for line in cells],
        "text": [[cell.get("verdict", "") for cell in line] for line in cells],
        "hovertemplate": f"{words[0]}: %{{x}}<br>{words[1]}: %{{y}}<br>probability of instability: %{{z}}<br>%{{text}}"
        "<extra></extra>",
        "colorbar": {"title": {"text": "probability of instability", "side": "right"}, "thickness": 14},
    }  # fmt: skip
    marks = _marks([(row[across.name], row[up.name]) for row in not_green(rows)])
    return {"data": [heat, *_borders(sweep, across, up), *marks], "layout": heat_map_layout(*words)}


def _marks(places: Sequence[tuple[float, float]]) -> Iterator[dict[str, Any]]:
    """Points whose verdict is not green, whatever share of their runs was unstable."""
    if places:
        x, y = zip(*places, strict=True)
        yield {
            "type": "scatter", "mode": "markers", "name": NOT_GREEN, "x": list(x), "y": list(y), "hoverinfo": "skip",
            "marker": {"symbol": "x-thin", "size": 9, "line": {"width": 2, "color": "#5f5f5f"}},
        }  # fmt: skip


def _borders(sweep: Sweep, across: Axis, up: Axis) -> Iterator[dict[str, Any]]:
    """Contours of zero: left of them, or below, the loop is stable along a straight track."""
    x, y, maps = border_maps(sweep.base, across, up)
    for name, margin in maps.items():
        at_zero = {"start": 0.0, "end": 0.0, "size": 1.0, "coloring": "none"}
        z = [plain(row) for row in margin]
        yield _border(name, "contour", x, y) | {"z": z, "contours": at_zero, "showscale": False}


def _border(name: str, kind: str, x: Any, y: Any) -> dict[str, Any]:
    line = {"color": border_colour(name), "dash": "dash", "width": 2}
    return {
        "type": kind, "name": f"border: {name}", "x": x, "y": y, "line": line, "showlegend": True, "hoverinfo": "skip",
    }  # fmt: skip


def draw_sweep_figures(sweep: Sweep, rows: Rows, folder: Path) -> None:
    """Draw the probability of instability to `folder`, as SVG and PDF. Raises UserError if that is not possible."""
    import matplotlib as mpl

    from agv_analysis.report.matplotlib_figures import STYLE, WIDTH

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be written to: {error.strerror}") from None
    with mpl.rc_context(STYLE):
        for suffix in ("svg", "pdf"):
            draw(sweep, rows, "instability", folder / f"instability.{suffix}", (WIDTH, 0.8 * WIDTH))


def _plain(value: Any) -> Any:
    """JSON has neither infinity nor NaN."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
