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
    LatestOnlyWorker,
    WorkerDiedError,
    compared_criteria_rows,
    tube_traces,
)
from agv_analysis.explore.guard import check_request, guard, said
from agv_analysis.explore.response import respond
from agv_analysis.explore.settings import PRESETS, Values, preset_values, scenario_of, values_of
from agv_analysis.explore.sliders import (
    CHOICES,
    GAIN_SLIDERS,
    LOOK_AHEAD,
    LOOKING_AHEAD,
    OTHER_SLIDERS,
    SLIDERS,
    Slider,
)
from agv_analysis.scenario import Scenario
from agv_ros.errors import UserError

HOST = "127.0.0.1"

KEYS = (*(slider.key for slider in SLIDERS), *CHOICES, "more")
"""Everything on the page that can be set, in the order in which it comes to a callback."""

STYLE = """
:root { color-scheme: light dark; --paper: #fff; --ink: #1b1f24; --soft: #5b6570; --line: #d9dee3; --bad: #cf222e }
@media (prefers-color-scheme: dark) {
  :root { --paper: #14171a; --ink: #e6e9ec; --soft: #9aa4ae; --line: #343b42; --bad: #ff7b72 }
  :root, .dash-dropdown-content {
    --Dash-Fill-Inverse-Strong: #14171a; --Dash-Text-Primary: #e6e9ec; --Dash-Text-Strong: #e6e9ec;
    --Dash-Text-Weak: #9aa4ae; --Dash-Stroke-Strong: #5b6570; --Dash-Stroke-Weak: #343b42;
    --Dash-Text-Disabled: #9aa4ae; --Dash-Fill-Disabled: #5b6570; --Dash-Fill-Weak: #343b42;
    --Dash-Fill-Primary-Hover: #343b42; --Dash-Fill-Primary-Active: #343b42;
  }
}
body { margin: 0; font: 15px/1.4 system-ui, sans-serif; color: var(--ink); background: var(--paper) }
main { display: flex; flex-wrap: wrap; gap: 1rem; padding: 1rem; max-width: 1400px; margin: auto }
#controls { flex: 1 1 300px; max-width: 420px } #shown { flex: 3 1 560px; min-width: 0 }
#problem { color: var(--bad); min-height: 1.4em; white-space: pre-wrap } h1 { font-size: 1.2rem; margin: 0 0 .5rem }
label { display: block; font-size: .85rem; color: var(--soft); margin-top: .3rem }
button { font: inherit; margin: .2rem .3rem .2rem 0; padding: .25rem .6rem }
th, td { text-align: left; padding: .1rem .8rem .1rem 0; vertical-align: top } textarea { width: 100%; font: inherit }
pre { white-space: pre-wrap } h2 { font-size: 1rem; margin: .8rem 0 .2rem }
table:has(td + td)::before {
  content: "right: the pinned setting"; display: table-caption; text-align: right; font-size: .85rem; color: var(--soft)
}
@media (max-width: 600px) { th, td { padding-right: .4rem; font-size: .85rem } td { overflow-wrap: anywhere } }
#lap.old { opacity: .4 } h2:has(+ #lap.old)::after { content: ": computing …"; color: var(--soft) }
.js-plotly-plot .main-svg text:not(.hovertext *) { fill: var(--ink) !important }
.js-plotly-plot .gridlayer path { stroke: var(--line) !important }
"""


CriteriaRows = Callable[[Scenario, Scenario | None], list[tuple[str, str, str]] | None]
"""As `compared_criteria_rows`; None if the setting was moved on before its turn came."""

TubeTraces = Callable[[Scenario], list[dict[str, Any]] | None]
"""As `tube_traces`; None as of CriteriaRows."""

_REST = 0.3
"""Seconds for which the page has to be left alone before the lap's criteria are computed."""

_AGAIN, _PAUSE = 4, 400
"""How often a page that was loaded is drawn anew, and after how many milliseconds each.

A browser compiles what it has run some times: so it has before a hand moves the first slider.
"""

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
        raise UserError("the explorer needs Dash: pip install dash") from None
    app = dash.Dash(
        "agv_ncs", title="agv_ncs: what if?", update_title=None, assets_folder="no assets", url_base_pathname=path
    )
    app.index_string = app.index_string.replace("{%css%}", "{%css%}<style>" + STYLE + "</style>")
    app.layout = _layout(dash, values_of(base))
    _connect(dash, app, base, criteria, tube)
    return app


def _layout(dash: Any, at_first: dict[str, Any]) -> Any:
    html, dcc = dash.html, dash.dcc
    controls = [html.H1("What if?")]
    controls += [html.Button(preset.title, id=f"preset-{key}") for key, preset in PRESETS.items()]
    controls.append(html.P("", id="story"))
    for key, choice in CHOICES.items():
        controls += [html.Label(choice.label), dcc.Dropdown(list(choice.names), at_first[key], id=key, clearable=False)]

    def of(sliders: tuple[Slider, ...]) -> list[Any]:
        return [part for one in sliders for part in (html.Label(one.label), _slider(dcc, one, at_first[one.key]))]

    styles = dict(zip(SHOWN_FOR_A_LAW, _styles(at_first["law"]), strict=True))
    sliders_of_groups = {**{_group(law): sliders for law, sliders in GAIN_SLIDERS.items()}, _AHEAD: (LOOK_AHEAD,)}
    controls += [html.Div(of(sliders), id=key, style=styles[key]) for key, sliders in sliders_of_groups.items()]
    controls += of(OTHER_SLIDERS)
    example = "further settings, one a line:\nplant.duration=50.0\nrelay.downlink.model=bernoulli"
    controls += [html.Label("more"), dcc.Textarea(id="more", value="", placeholder=example, rows=3)]
    shown = [
        html.Div(
            [
                html.Button("Pin this setting", id="pin"),
                html.Button("Unpin", id="unpin"),
                html.Button("Export", id="export"),
            ]
        ),
        html.Div("", id="problem", role="alert"),
        html.Table([], id="summary"),
        html.H2("Over the whole lap"),
        html.Table([], id="lap"),
        dcc.Graph(id="plot-track", style={"height": "420px"}, config={"displaylogo": False}),
        dcc.Graph(id="plot-time", style={"height": "620px"}, config={"displaylogo": False}),
        html.Pre("", id="exported"),
        dcc.Download(id="file"),
        dcc.Store(id="pinned"),
        dcc.Store(id="tube"),
        dcc.Interval(id="again", interval=_PAUSE, max_intervals=_AGAIN),
    ]
    return html.Main([html.Div(controls, id="controls"), html.Div(shown, id="shown")])


def _group(law: str) -> str:
    """Id of what holds the sliders of a law's gains."""
    return f"gains-of-{law}"


_AHEAD = "sliders-ahead"

SHOWN_FOR_A_LAW = (*map(_group, GAIN_SLIDERS), _AHEAD)
"""Ids of what is shown for some laws only."""


def _styles(law: str) -> list[dict[str, str]]:
    """Whether each of SHOWN_FOR_A_LAW is, where a law is chosen."""
    shown = [*(name == law for name in GAIN_SLIDERS), law in LOOKING_AHEAD]
    return [{} if is_shown else {"display": "none"} for is_shown in shown]


def _slider(dcc: Any, slider: Slider, value: float) -> Any:
    ends = {end: f"{end:g}" for end in (slider.low, slider.high)}
    return dcc.Slider(slider.low, slider.high, slider.step, value=value, marks=ends, id=slider.key, updatemode="drag")


def _connect(dash: Any, app: Any, base: Scenario, criteria: CriteriaRows, tube: TubeTraces) -> None:
    Input, Output, State = dash.Input, dash.Output, dash.State
    inputs, states = [Input(key, "value") for key in KEYS], [State(key, "value") for key in KEYS]

    folder = Path.cwd()

    def values(given: tuple[Any, ...]) -> dict[str, Any]:
        return dict(zip(KEYS, given, strict=True))

    def asked(settings: Values) -> Scenario:
        return check_request(base, scenario_of(base, settings), folder)

    @app.callback(
        Output("plot-track", "figure"), Output("plot-time", "figure"), Output("summary", "children"),
        Output("problem", "children"), Output("lap", "className"),
        *inputs, Input("pinned", "data"), Input("again", "n_intervals"),
    )  # fmt: skip
    def move(*given: Any) -> Any:
        *settings, pinned, _ = given
        try:
            other = None if pinned is None else asked(pinned)
            found = respond(asked(values(tuple(settings))), other)
        except UserError as error:
            return dash.no_update, dash.no_update, dash.no_update, said(error), "old"
        found.track["layout"]["meta"] = _mark(settings)
        return found.track, found.time, _table(dash.html, found.rows), "", "old"

    @app.callback(*(Output(key, "style") for key in SHOWN_FOR_A_LAW), Input("law", "value"), prevent_initial_call=True)
    def show(law: str) -> Any:
        return _styles(law)

    @app.callback(
        Output("lap", "children"), Output("lap", "className", allow_duplicate=True),
        Input("problem", "children"), *states, State("pinned", "data"), prevent_initial_call=True,
    )  # fmt: skip
    def over_the_lap(_: Any, *given: Any) -> Any:  # after `move` has answered, so as not to keep it from that
        *settings, pinned = given
        try:
            scenario = asked(values(tuple(settings)))
            found = criteria(scenario, None if pinned is None else asked(pinned))
        except UserError:  # `move` says why
            return [], ""
        except WorkerDiedError:
            return _table(dash.html, _DIED), ""
        return _table(dash.html, _MOVED_ON if found is None else found), ""

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
        Output("pinned", "data"), Input("pin", "n_clicks"), Input("unpin", "n_clicks"), *states,
        prevent_initial_call=True,
    )  # fmt: skip
    def pin(_: Any, __: Any, *given: Any) -> Any:
        return values(given) if dash.ctx.triggered_id == "pin" else None

    @app.callback(
        *(Output(key, "value") for key in KEYS), Output("story", "children"),
        *(Input(f"preset-{key}", "n_clicks") for key in PRESETS), prevent_initial_call=True,
    )  # fmt: skip
    def preset(*_: Any) -> Any:
        key = dash.ctx.triggered_id.removeprefix("preset-")
        chosen = preset_values(base, key)
        return *(chosen[name] for name in KEYS), PRESETS[key].text

    @app.callback(
        Output("exported", "children"), Output("file", "data"), Input("export", "n_clicks"), *states,
        prevent_initial_call=True,
    )  # fmt: skip
    def export(_: Any, *given: Any) -> Any:
        try:
            text = asked(values(given)).to_yaml()
        except UserError as error:
            return said(error), dash.no_update
        command = "agv-ncs simulate explored.yaml --report explored.html"
        return f"{command}\n\n# explored.yaml\n{text}", {"content": text, "filename": "explored.yaml"}


def _mark(settings: Sequence[Any]) -> str:
    """What tells the figure of one setting from those of others."""
    return json.dumps(list(settings))


_ADD_TUBE = """(tube, figure) => tube && figure && figure.layout.meta === tube.mark
  ? { ...figure, data: figure.data.concat(tube.traces) } : window.dash_clientside.no_update"""
"""Adds a tube to the figure of the track, unless that is another setting's by now: the browser alone knows it."""


def _table(html: Any, rows: list[tuple[str, str, str]]) -> list[Any]:
    """Rows with a third cell only where there is something in it: each cell is felt at every move."""
    return [
        html.Tr([html.Th(name), *(html.Td(cell) for cell in (value, other) if cell)]) for name, value, other in rows
    ]


def serve(base: Scenario, port: int, ready: Callable[[str], None]) -> None:
    """Serve the page until Ctrl-C or SIGTERM; `ready` is told its address. Port 0: any free one.

    Raises UserError if the port is taken or Dash is not installed.
    """
    criteria, tube = LatestOnlyWorker(compared_criteria_rows, rest=_REST), LatestOnlyWorker(tube_traces)
    path = f"/{secrets.token_urlsafe(16)}/"
    app = build(base, criteria, tube, path)
    werkzeug: Any = importlib.import_module("werkzeug.serving")
    lasting = {"log": lambda *_: None, "protocol_version": "HTTP/1.1"}  # which keeps the browser's connections
    quiet = type("Quiet", (werkzeug.WSGIRequestHandler,), lasting)
    try:
        server = werkzeug.make_server(HOST, port, app.server, threaded=True, request_handler=quiet)
    except (OSError, SystemExit) as error:
        raise UserError(f"port {port} of {HOST} cannot be used: {error}: choose another with --port") from None
    guard(app.server, server.server_port)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)
    try:
        ready(f"http://{HOST}:{server.server_port}{path}")
        server.serve_forever()
    except KeyboardInterrupt:
        pass
    finally:
        criteria.close()
        tube.close()
        server.server_close()
