"""The explorer's page, made with Dash: it listens on 127.0.0.1 alone, to who knows its address, and loads nothing."""

from __future__ import annotations

import importlib
import json
import secrets
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from agv_analysis.corridor.widths import widths_of
from agv_analysis.explore.background_criteria import (
    SURE,
    WHY,
    WORD,
    LatestOnlyWorker,
    WorkerDiedError,
    compared_criteria_rows,
    tube_traces,
)
from agv_analysis.explore.guard import check_request, guard, said
from agv_analysis.explore.idle_controls import CONTROLS, idle_controls, idle_lines
from agv_analysis.explore.page_layout import SHOWN_FOR_A_LAW, STYLE, layout, reason_text, styles_of
from agv_analysis.explore.page_server import page_server
from agv_analysis.explore.positions import difference, from_hash, position_of, to_hash, value_of
from agv_analysis.explore.response import respond
from agv_analysis.explore.settings import PRESETS, Values, preset_values, scenario_of, values_of
from agv_analysis.explore.sliders import CHOICES, GAIN_SLIDERS, SLIDERS
from agv_analysis.scenario import Scenario
from agv_ros.errors import UserError

HOST = "127.0.0.1"

KEYS = (*(slider.key for slider in SLIDERS), *CHOICES, "more")
"""Everything on the page that can be set, in the order in which it comes to a callback."""

CriteriaRows = Callable[[Scenario, Scenario | None], list[tuple[str, str, str]] | None]
"""As `compared_criteria_rows`; None if the setting was moved on before its turn came."""

TubeTraces = Callable[[Scenario], list[dict[str, Any]] | None]
"""As `tube_traces`; None as of CriteriaRows."""

_REST = 0.3
"""Seconds for which the page has to be left alone before the lap's criteria are computed."""

_DIED = [("Not computed", "the process that computes it ended; the next move starts another", "")]

_MOVED_ON = [("Not computed", "the page was moved on", "")]


def build(
    base: Scenario, criteria: CriteriaRows = compared_criteria_rows, tube: TubeTraces = tube_traces, path: str = "/"
) -> Any:
    """The page as a Dash app at a path; `criteria` and `tube` may take their time.

    Raises UserError if Dash is not installed.
    """
    try:
        dash: Any = importlib.import_module("dash")
    except ImportError:
        raise UserError("the explorer needs Dash: pip install 'agv_ncs[explore]'") from None
    app = dash.Dash(
        "agv_ncs", title="agv_ncs: what if?", update_title=None, assets_folder="no assets", url_base_pathname=path
    )
    app.index_string = app.index_string.replace("{%css%}", "{%css%}<style>" + STYLE + "</style>")
    app.layout = layout(dash, values_of(base), idle_controls(base, ""))
    _connect(dash, app, base, criteria, tube)
    return app


def _connect(dash: Any, app: Any, base: Scenario, criteria: CriteriaRows, tube: TubeTraces) -> None:
    Input, Output, State = dash.Input, dash.Output, dash.State
    inputs, states = [Input(key, "value") for key in KEYS], [State(key, "value") for key in KEYS]

    folder, at_first = Path.cwd(), values_of(base)
    presets = {key: preset_values(base, key) for key in PRESETS}

    def values(given: tuple[Any, ...]) -> dict[str, Any]:
        return {key: value_of(key, at, at_first) for key, at in zip(KEYS, given, strict=True)}

    def asked(settings: Values) -> Scenario:
        return check_request(base, scenario_of(base, settings), folder)

    @app.callback(
        Output("plot-track", "figure"), Output("plot-time", "figure"), Output("summary", "children"),
        Output("problem", "children"), Output("lap", "className"), Output("badge-word", "className"),
        *(Output(f"badge-{part}", "children") for part in _BADGE), Output("pinned-name", "children"),
        Output("story", "children"), Output("setting", "data"),
        *(Output(f"{slider.key}-value", "children") for slider in _LOG_SLIDERS),
        *inputs, Input("pinned", "data"), Input("again", "n_intervals"),
    )  # fmt: skip
    def move(*given: Any) -> Any:
        *settings, pinned, _ = given
        now = values(tuple(settings))
        story = next((PRESETS[key].text for key, preset in presets.items() if preset == now), "")
        chosen = GAIN_SLIDERS.get(now["law"], ())
        of_setting = (
            "" if pinned is None else difference(now, pinned), story, to_hash(now, at_first),
            *(f"{now[slider.key]:g}" if slider in chosen else dash.no_update for slider in _LOG_SLIDERS),
        )  # fmt: skip
        try:
            found = respond(asked(now), None if pinned is None else asked(pinned))
        except UserError as error:
            return *[dash.no_update] * 3, said(error), "old", "old", *[dash.no_update] * len(_BADGE), *of_setting
        found.track["layout"]["meta"] = _mark(settings)
        rows = _table(dash.html, found.rows, pinned is not None)
        return found.track, found.time, rows, "", "old", "old", *(found.badge[part] for part in _BADGE), *of_setting

    @app.callback(*(Output(key, "style") for key in SHOWN_FOR_A_LAW), Input("law", "value"), prevent_initial_call=True)
    def show(law: str) -> Any:
        return styles_of(law)

    @app.callback(
        *(Output(slider.key, "disabled") for slider in SLIDERS),
        *(Output(f"of-{key}", "className") for key in CONTROLS),
        *(Output(f"why-{key}", "children") for key in CONTROLS),
        Output("idle-lines", "children"),
        *(Input(key, "value") if key in _DECIDING else State(key, "value") for key in KEYS), prevent_initial_call=True,
    )  # fmt: skip
    def grey(*given: Any) -> Any:
        now = values(given)
        try:
            scenario = asked(now)
        except UserError:  # `move` says why
            return [dash.no_update] * (len(SLIDERS) + 2 * len(CONTROLS) + 1)
        idle = idle_controls(scenario, now["more"])
        greyed = ["off" if key in idle else "" for key in CONTROLS]
        reasons = [reason_text(idle.get(key, "")) for key in CONTROLS]
        return *(one.key in idle for one in SLIDERS), *greyed, *reasons, idle_lines(scenario, now["more"])

    app.clientside_callback(_TO_URL, Output("in-url", "data"), Input("setting", "data"), prevent_initial_call=True)
    app.clientside_callback(
        _FORGET_EXPORT, Output("exported", "children", allow_duplicate=True),
        Output("export-said", "children", allow_duplicate=True), Input("setting", "data"),
        State("exported-of", "data"), prevent_initial_call=True,
    )  # fmt: skip
    app.clientside_callback(_DRAWER, Output("drawer", "open"), Input("url", "pathname"))

    @app.callback(
        *(Output(key, "value", allow_duplicate=True) for key in KEYS), Input("url", "hash"),
        prevent_initial_call="initial_duplicate",
    )  # fmt: skip
    def from_url(text: str | None) -> Any:
        found = {**at_first, **from_hash(text or "", at_first)}
        return [position_of(key, found[key]) for key in KEYS]

    @app.callback(
        Output("lap", "children"), Output("lap", "className", allow_duplicate=True), Output("badge-word", "children"),
        Output("badge-word", "className", allow_duplicate=True), Output("badge-sure", "children"),
        Output("badge-why", "children"), Input("problem", "children"), *states, State("pinned", "data"),
        prevent_initial_call=True,
    )  # fmt: skip
    def over_the_lap(_: Any, *given: Any) -> Any:  # after `move` has answered, so as not to keep it from that
        *settings, pinned = given
        try:
            scenario = asked(values(tuple(settings)))
            found = criteria(scenario, None if pinned is None else asked(pinned))
        except UserError:  # `move` says why
            return [], "", "…", "", "", ""
        except WorkerDiedError:
            return _table(dash.html, _DIED, False), "", "…", "", "", ""
        if found is None:
            return _table(dash.html, _MOVED_ON, False), "", *[dash.no_update] * 4
        rows = {name: value for name, value, _ in found}
        word = rows.get(WORD, "…")
        why = f"Why: {rows[WHY]}." if WHY in rows else ""
        return _table(dash.html, found, pinned is not None), "", word, word, rows.get(SURE, ""), why

    @app.callback(Output("tube", "data"), Input("lap", "children"), *states, prevent_initial_call=True)
    def find_tube(_: Any, *given: Any) -> Any:  # after the criteria
        try:
            scenario = asked(values(given))
            found = None if widths_of(scenario.error_detector) is None else tube(scenario)
        except (UserError, WorkerDiedError):  # `move` and the criteria say why
            found = None
        return {"mark": _mark(given), "traces": found} if found else dash.no_update

    app.clientside_callback(
        _ADD_TUBE, Output("plot-track", "figure", allow_duplicate=True), Input("tube", "data"),
        State("plot-track", "figure"), prevent_initial_call=True,
    )  # fmt: skip

    @app.callback(
        Output("pinned", "data"), Output("unpin", "disabled"), Input("pin", "n_clicks"), Input("unpin", "n_clicks"),
        *states, prevent_initial_call=True,
    )  # fmt: skip
    def pin(_: Any, __: Any, *given: Any) -> Any:
        return (values(given), False) if dash.ctx.triggered_id == "pin" else (None, True)

    @app.callback(
        *(Output(key, "value") for key in KEYS),
        *(Input(f"preset-{key}", "n_clicks") for key in PRESETS), prevent_initial_call=True,
    )  # fmt: skip
    def preset(*_: Any) -> Any:
        key = dash.ctx.triggered_id.removeprefix("preset-")
        return [position_of(name, presets[key][name]) for name in KEYS]

    @app.callback(
        Output("exported", "children"), Output("file", "data"), Output("export-said", "children"),
        Output("exported-of", "data"), Input("export", "n_clicks"), *states, prevent_initial_call=True,
    )  # fmt: skip
    def export(_: Any, *given: Any) -> Any:
        now = values(given)
        of = to_hash(now, at_first)
        try:
            text = asked(now).to_yaml()
        except UserError as error:
            return said(error), dash.no_update, "", of
        command = "agv-ncs simulate explored.yaml --report explored.html"
        shown = f"{command}\n\n# explored.yaml\n{text}"
        where = "explored.yaml is among your browser's downloads, and at the end of this page"
        return shown, {"content": text, "filename": "explored.yaml"}, where, of


def _mark(settings: Sequence[Any]) -> str:
    """What tells the figure of one setting from those of others."""
    return json.dumps(list(settings))


_ADD_TUBE = """(tube, figure) => tube && figure && figure.layout.meta === tube.mark
  ? { ...figure, data: figure.data.concat(tube.traces) } : window.dash_clientside.no_update"""
"""Adds a tube to the figure of the track, unless that is another setting's by now: the browser alone knows it."""


def _table(html: Any, rows: list[tuple[str, str, str]], is_pinned: bool) -> list[Any]:
    """Rows with a third cell only where there is something in it: each cell costs time at every move."""
    head = [html.Tr([html.Th(""), html.Th("now"), html.Th("pinned")])] if is_pinned else []
    return head + [
        html.Tr([html.Th(name), *(html.Td(cell) for cell in (value, other) if cell)]) for name, value, other in rows
    ]


_DECIDING = (*CHOICES, "delay", "more")
"""Controls that decide which others have an effect."""

_BADGE = ("deviation", "when", "losses", "outage")
"""Parts of the badge that each move changes."""

_LOG_SLIDERS = tuple(slider for slider in SLIDERS if slider.is_log)

_TO_URL = """function(text) {
  history.replaceState(history.state, "", location.pathname + location.search + (text ? "#" + text : ""));
  return text;
}"""
"""The address of the page holds its setting, and going back does not go through every move."""

_FORGET_EXPORT = """(setting, exported) => exported == null || setting === exported
  ? [dash_clientside.no_update, dash_clientside.no_update] : ["", ""]"""
"""What was exported is shown as long as the page shows the setting of it."""

_DRAWER = "function() { return innerWidth > 900; }"
"""On a phone the drawer is closed at first."""


def serve(base: Scenario, port: int, ready: Callable[[str], None]) -> None:
    """Serve the page until Ctrl-C or SIGTERM; `ready` receives its address. Port 0: any free one.

    Raises UserError if the port is taken or Dash is not installed.
    """
    criteria, tube = LatestOnlyWorker(compared_criteria_rows, rest=_REST), LatestOnlyWorker(tube_traces)
    path = f"/{secrets.token_urlsafe(16)}/"
    app = build(base, criteria, tube, path)
    server = page_server(app.server, HOST, port)
    guard(app.server, server.port)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)
    try:
        ready(f"http://{HOST}:{server.port}{path}")
        server.serve_forever()
    except KeyboardInterrupt:
        pass
    finally:
        criteria.close()
        tube.close()
        server.server_close()
