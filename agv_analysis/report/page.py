"""The report: one HTML file that needs no network, the verdict first.

Every string goes through the template's escaping, and what goes into a script is JSON without any `<`, or base64. The
page's content security policy forbids loading anything.
"""

from __future__ import annotations

import functools
import importlib
import json
import math
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from agv_analysis.corridor.corridor_of_run import CorridorOfRun
from agv_analysis.output_file import output_file
from agv_analysis.report.cannot_say import cannot_say
from agv_analysis.report.corridor_panels import corridor_panel, edges
from agv_analysis.report.packed import packed_figures, packed_text
from agv_analysis.report.panels import TIME, Panel, panels, to_json, within_reach
from agv_analysis.report.parameter_lines import changed_parameters, parameter_lines
from agv_analysis.report.plotly import MOST_POINTS, aspect, figure, packed_values
from agv_analysis.report.tiles import tiles
from agv_analysis.report.verdict_sentence import sentence
from agv_analysis.run import Run
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.reference import reference_of
from agv_analysis.stability.analysis import GAINS_UNKNOWN, Analysis, Observations
from agv_analysis.version import version
from agv_ros.errors import UserError

_FEW = 2000
"""Points of a line in the numbers that the page offers as JSON."""

_HEIGHT, _HEIGHT_OF_TIME = 460, 860
"""Of plots [pixels]."""

_TRACK_WIDTH = 480
"""Of the track [pixels] where the time panels are beside it."""

_UPRIGHT = 0.6
"""Height over width from which on a track has the time panels beside it, not below."""

_CURSOR_PLACES = 5000
"""Places of a run at which the cursor over time is shown on the track."""


def write_report(analysis: Observations, path: str | Path, within: CorridorOfRun | None = None) -> None:
    """Write the report of a run, and what it says of a corridor.

    Raises UserError if it cannot be written or if plotly or jinja2 is not installed.
    """
    write_page(render(analysis, within), Path(path))


def write_page(html: str, path: Path) -> None:
    """Write a page. Raises UserError if that is not possible."""
    try:
        output_file(path).write_text(html, encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None


def render(analysis: Observations, within: CorridorOfRun | None = None) -> str:
    """The report of a run as HTML. Raises UserError if plotly or jinja2 is not installed."""
    drawn, figures, run = all_panels(analysis, within), dict(_rows(analysis)), analysis.run
    if within is not None:
        figures |= dict(within.rows())
    return fill(
        "report.html.j2",
        figures={key: figure(group) for key, _, group in _groups(drawn)},
        more={"cursor": _cursor(run) | ({} if within is None else _lap_of(within))},
        scenario=run.scenario,
        data=report_json(analysis, drawn) | ({} if within is None else {"corridor": within.to_json()}),
        title=f"agv_ncs: {run.source}",
        verdict=sentence(analysis),
        word=analysis.verdict.word if isinstance(analysis, Analysis) and not run.unexplained else "unknown",
        why=analysis.verdict.reason if isinstance(analysis, Analysis) and not run.unexplained else "",
        tiles=list(tiles(analysis, within)),
        cannot_say=list(cannot_say(analysis, within)),
        analysis=analysis,
        run=run,
        rows=list(figures.items()),
        margins=list(_margins(analysis)),
        sections=list(_sections(drawn)),
        parameters=run.scenario.to_yaml(),
        reproduce=_reproduce(analysis),
    )


def all_panels(analysis: Observations, within: CorridorOfRun | None = None) -> list[Panel]:
    """The panels of a run, with its corridor drawn, if there is one, on the track and over a lap."""
    drawn = list(panels(analysis))
    if within is None or within.expected is None:
        return drawn
    expected = within.expected
    with_edges = (
        replace(panel, lines=(*edges(expected), *panel.lines)) if panel.key == "track" else panel for panel in drawn
    )
    return [*with_edges, corridor_panel(expected)]


def template(name: str) -> Any:
    """A template of this folder. Raises UserError if jinja2 is not installed."""
    with _needed():
        jinja2: Any = importlib.import_module("jinja2")
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    return jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True).get_template(name)


@contextmanager
def _needed() -> Iterator[None]:
    """Around imports of what an extra brings."""
    try:
        yield
    except ImportError as error:
        raise UserError(f"a report needs plotly and jinja2: pip install 'agv_ncs[report]' ({error})") from None


def fill(
    name: str, figures: dict[str, Any], data: dict[str, Any], scenario: Scenario, parameters: str,
    more: dict[str, Any] | None = None, **content: Any,
) -> str:  # fmt: skip
    """A template of this folder, filled. Raises UserError if plotly or jinja2 is not installed.

    `figures` go to plotly.js by the key of their place in the page, `data` is what the page offers to save,
    `parameters` the params file of the scenario; scripts find what is in `more` beside the figures.
    """
    page = template(name)
    with _needed():
        plotly: Any = importlib.import_module("plotly.offline")
    # Library and figures are packed, and the data is a script: JSON in which nothing can end it.
    text: str = page.render(
        library=_library(plotly.get_plotlyjs),
        packed=packed_figures({"figures": figures, **(more or {})}),
        data=_for_script(data),
        versions=versions(),
        parameter_lines=parameter_lines(scenario, parameters),
        changed=len(changed_parameters(scenario)),
        **content,
    )
    return text


@functools.lru_cache(maxsize=1)
def _library(source: Callable[[], str]) -> str:
    """plotly.js, packed: less than half as long."""
    return packed_text(source())


def _cursor(run: Run) -> dict[str, Any]:
    """Time, and where the AGV was, at some steps evenly spread over a run."""
    some = slice(None, None, -(-len(run) // _CURSOR_PLACES))
    x, y = within_reach(run)
    return {name: packed_values(values[some]) for name, values in (("time", run.time), ("x", x), ("y", y))}


def _lap_of(within: CorridorOfRun) -> dict[str, float]:
    """Time of a lap [s], by which the panel of the corridor is drawn, if there is one."""
    return {} if within.expected is None else {"lap": len(within.expected.lap) * within.expected.ts}


def report_json(analysis: Observations, drawn: list[Panel]) -> dict[str, Any]:
    """All that the report shows, by name; its lines thinned to some thousand points."""
    return {
        "sentence": sentence(analysis),
        "analysis": analysis.to_json(),
        "versions": versions(),
        "parameters": analysis.run.scenario.to_yaml(),
        "panels": {panel.key: to_json(panel, _FEW) for panel in drawn},
    }


def _for_script(content: Any) -> str:
    """JSON that can stand in a script: nothing in it ends the script or begins a comment."""
    text = json.dumps(content, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _groups(drawn: list[Panel]) -> Iterator[tuple[str, str, list[Panel]]]:
    """Key, title and panels of each figure: those over time share one, whose axes are linked."""
    over_time = [panel for panel in drawn if panel.x_label == TIME]
    for panel in drawn:
        if panel not in over_time:
            yield panel.key, panel.title, [panel]
        elif panel is over_time[0]:
            yield "time", "Errors, speed, age of information", over_time


def _sections(drawn: list[Panel]) -> Iterator[dict[str, Any]]:
    for key, title, group in _groups(drawn):
        longest = max(len(line.x) for panel in group for line in panel.lines)
        height, of_track = _HEIGHT, aspect(group[0]) if key == "track" else math.nan
        if key == "time":
            height = _HEIGHT_OF_TIME
        elif of_track >= _UPRIGHT:  # the time panels are beside it
            height = int(min(_HEIGHT_OF_TIME, max(_HEIGHT, _TRACK_WIDTH * of_track)))
        is_upright = of_track >= _UPRIGHT
        yield {"key": key, "title": title, "height": height, "thinned": longest > MOST_POINTS, "upright": is_upright}


def _rows(analysis: Observations) -> Iterator[tuple[str, str]]:
    """The figures that the terminal shows, without its colours."""
    from rich.text import Text

    from agv_analysis.report.table import rows

    for name, value in rows(analysis):
        yield name, Text.from_markup(value).plain


def _margins(analysis: Observations) -> Iterator[tuple[str, str]]:
    """Margins over the track of a run, or why there are none."""
    if not isinstance(analysis, Analysis):
        yield "Margins", f"not computed: {GAINS_UNKNOWN}"
        return
    from agv_analysis.report.table import margin_rows

    try:
        if _drives_its_track(analysis.run):
            yield from margin_rows(analysis.run.scenario)
        else:
            yield "Margins", "not computed: the recording's reference is not the track that its parameters name"
    except UserError as error:  # a recording may come without the file of its track
        yield "Margins", f"not computed: {error}"


def _drives_its_track(run: Run) -> bool:
    """Is the run's reference that of the track which its parameters name? A recorded one need not be."""
    expected = reference_of(run.scenario.error_detector, int(run.k[-1]) + 1)[run.k]
    return bool(np.allclose(run.reference[:, :2], expected[:, :2], rtol=0.0, atol=1e-6))


def versions() -> dict[str, str]:
    """What made the page."""
    return {"agv_ncs": version(), "Python": platform.python_version(), "numpy": np.__version__}


def _reproduce(analysis: Observations) -> str:
    """Commands that repeat this run; params.yaml holds the parameters that the page shows."""
    if analysis.run.source == "simulation":
        return "agv-ncs simulate params.yaml --report report.html"
    return "agv-ncs run params.yaml --bag bags/again\nagv-ncs analyse bags/again --report report.html"
