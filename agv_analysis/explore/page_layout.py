"""What is on the explorer's page, and where: results first, controls beside them or, on a phone, in a drawer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agv_analysis.explore.settings import PRESETS
from agv_analysis.explore.sliders import (
    CHOICES,
    GAIN_SLIDERS,
    LOOK_AHEAD,
    LOOKING_AHEAD,
    OTHER_SLIDERS,
    Slider,
)

STYLE = """
:root {
  color-scheme: light dark; --paper: #fff; --ink: #1b1f24; --soft: #5b6570; --line: #d9dee3;
  --good: #1a7f37; --fair: #9a6700; --bad: #cf222e;
}
@media (prefers-color-scheme: dark) {
  :root {
    --paper: #14171a; --ink: #e6e9ec; --soft: #9aa4ae; --line: #343b42;
    --good: #4ac26b; --fair: #d4a72c; --bad: #ff7b72;
  }
  :root, .dash-dropdown-content {
    --Dash-Fill-Inverse-Strong: #14171a; --Dash-Text-Primary: #e6e9ec; --Dash-Text-Strong: #e6e9ec;
    --Dash-Text-Weak: #9aa4ae; --Dash-Stroke-Strong: #5b6570; --Dash-Stroke-Weak: #343b42;
    --Dash-Text-Disabled: #9aa4ae; --Dash-Fill-Disabled: #5b6570; --Dash-Fill-Weak: #343b42;
    --Dash-Fill-Primary-Hover: #343b42; --Dash-Fill-Primary-Active: #343b42;
  }
}
body { margin: 0; font: 15px/1.4 system-ui, sans-serif; color: var(--ink); background: var(--paper) }
main { display: flex; flex-wrap: wrap; gap: 1rem; padding: 1rem; max-width: 1500px; margin: auto }
#drawer { flex: 1 1 300px; max-width: 420px } #shown { flex: 3 1 560px; min-width: 0 }
#drawer > summary { display: none }
h1 { font-size: 1.2rem; margin: 0 0 .5rem } h2 { font-size: 1rem; margin: .8rem 0 .2rem }
label { display: block; font-size: .85rem; color: var(--soft); margin-top: .3rem } label b { color: var(--ink) }
.off { opacity: .45 } .why { font-style: italic } #idle-lines { font-size: .8rem; color: var(--soft) }
button { font: inherit; margin: .2rem .3rem .2rem 0; padding: .25rem .6rem }
th, td { text-align: left; padding: .1rem .8rem .1rem 0; vertical-align: top } textarea { width: 100%; font: inherit }
pre { white-space: pre-wrap }
/* Of one height whatever is in it, so that the plots below stay where they are. */
#badge { display: grid; grid-template-columns: repeat(3, 1fr); gap: .6rem; height: 5.8rem; overflow: hidden }
#badge > div {
  border: 1px solid var(--line); border-radius: .4rem; padding: .3rem .6rem; font-size: .8rem; color: var(--soft);
}
#badge b {
  display: block; font-size: 1.15rem; color: var(--ink); white-space: nowrap; overflow: hidden; text-overflow: ellipsis;
}
#badge .asymptotic, #badge .mean-square { color: var(--good) }
#badge .unstable, #badge .infeasible { color: var(--bad) }
#badge .bounded, #badge .undecided, #badge .unknown { color: var(--fair) } #badge .old { opacity: .4 }
#plots { display: grid; grid-template-columns: minmax(0, 2fr) minmax(0, 3fr) }
#plot-track, #plot-time { height: 620px }
/* Lines for the longest usual reason, some 240 letters. */
#badge-why { height: 2.8em; overflow: auto; font-size: .9rem; color: var(--soft); margin-top: .2rem }
@media (max-width: 1200px) {
  #plots { display: block } #plot-track { height: 400px } #badge-why { height: 5.6em } #badge { height: 7rem }
}
#pinned-name, #problem { height: 1.4em; overflow: auto; white-space: pre-wrap; font-size: .9rem; color: var(--soft) }
#problem { color: var(--bad) }
/* Where an answer takes a second, as when a vehicle is first compiled, the page still shows the one before. */
#badge b[data-dash-is-loading=true], #summary[data-dash-is-loading=true] { opacity: .4; transition: opacity 0s 1s }
#lap.old { opacity: .4 } h2:has(+ #lap.old)::after { content: ": computing …"; color: var(--soft) }
.js-plotly-plot .main-svg text:not(.hovertext *) { fill: var(--ink) !important }
.js-plotly-plot .gridlayer path { stroke: var(--line) !important }
@media (max-width: 900px) {
  main { display: block; padding: .5rem .5rem 4rem }
  #drawer {
    position: fixed; left: 0; right: 0; bottom: 0; max-width: none; z-index: 5; padding: .3rem .8rem;
    background: var(--paper); border-top: 2px solid var(--line);
  }
  #drawer > summary { display: block; padding: .4rem 0; font-weight: 600; cursor: pointer }
  #controls { max-height: 45vh; overflow-y: auto }
  .modebar-container { display: none } /* no room: it would lie on the names of the lines */
  #badge-why { height: 7em; font-size: .8rem }
  #badge b { font-size: .95rem } #badge > div { padding: .2rem .4rem; font-size: .72rem } #badge { height: 7.6rem }
  th, td { padding-right: .4rem; font-size: .85rem } td { overflow-wrap: anywhere }
}
"""


def layout(dash: Any, at_first: dict[str, Any], idle: Mapping[str, str]) -> Any:
    """The page where lists stand as in `at_first` and sliders at the positions of its values.

    `idle`: why a control has no effect, by its key.
    """
    html, dcc = dash.html, dash.dcc
    shown = [
        html.Div(
            [
                html.Div(["Verdict", html.B("…", id="badge-word"), html.Span("", id="badge-sure")]),
                html.Div(["Worst deviation", html.B("…", id="badge-deviation"), html.Span("", id="badge-when")]),
                html.Div(["Losses", html.B("…", id="badge-losses"), html.Span("", id="badge-outage")]),
            ],
            id="badge",
        ),
        html.Div("", id="badge-why"),
        html.Div(
            [
                html.Button("Pin this setting", id="pin"),
                html.Button("Unpin", id="unpin", disabled=True),
                html.Button("Export", id="export"),
                html.Span("", id="export-said"),
            ]
        ),
        html.Div("", id="pinned-name"),
        html.Div("", id="problem", role="alert"),
        html.Div(
            [
                dcc.Graph(id="plot-track", config={"displaylogo": False}),
                dcc.Graph(id="plot-time", config={"displaylogo": False}),
            ],
            id="plots",
        ),
        html.Table([], id="summary"),
        html.H2("Over the whole lap"),
        html.Table([], id="lap"),
        html.Pre("", id="exported"),
        dcc.Download(id="file"),
        dcc.Store(id="pinned"),
        dcc.Store(id="tube"),
        dcc.Store(id="setting"),
        dcc.Store(id="in-url"),
        dcc.Store(id="exported-of"),
        dcc.Location(id="url", refresh=False),
        dcc.Interval(id="again", interval=PAUSE, max_intervals=AGAIN),
    ]
    drawer = html.Details(
        [html.Summary("Change the setting"), html.Div(_controls(dash, at_first, idle), id="controls")],
        id="drawer",
        open=True,
    )
    return html.Main([drawer, html.Div(shown, id="shown")])


AGAIN, PAUSE = 4, 400
"""How often a page that was loaded is drawn anew, and after how many milliseconds each.

A browser compiles what it has run some times: so it has before a hand moves the first slider.
"""


def _controls(dash: Any, at_first: dict[str, Any], idle: Mapping[str, str]) -> list[Any]:
    html, dcc = dash.html, dash.dcc
    controls = [html.H1("What if?")]
    controls += [html.Button(preset.title, id=f"preset-{key}") for key, preset in PRESETS.items()]
    controls.append(html.P("", id="story"))
    for key, choice in CHOICES.items():
        names = dcc.Dropdown(list(choice.names), at_first[key], id=key, clearable=False)
        controls.append(_greyable(dash, key, [choice.label], names, idle))

    def of(sliders: tuple[Slider, ...]) -> list[Any]:
        return [_labelled(dash, one, at_first, idle) for one in sliders]

    styles = dict(zip(SHOWN_FOR_A_LAW, styles_of(at_first["law"]), strict=True))
    sliders_of_groups = {**{_group(law): sliders for law, sliders in GAIN_SLIDERS.items()}, _AHEAD: (LOOK_AHEAD,)}
    controls += [html.Div(of(sliders), id=key, style=styles[key]) for key, sliders in sliders_of_groups.items()]
    controls += of(OTHER_SLIDERS)
    example = "further settings, one a line:\nplant.duration=50.0\nrelay.downlink.model=bernoulli"
    further = dcc.Textarea(id="more", value="", placeholder=example, rows=3)
    return [*controls, html.Label("more"), further, html.Div("", id="idle-lines")]


def _greyable(dash: Any, key: str, label: list[Any], control: Any, idle: Mapping[str, str]) -> Any:
    """A control under its label, greyed where it has no effect, with the reason."""
    html = dash.html
    why = html.Span(reason_text(idle.get(key, "")), id=f"why-{key}", className="why")
    return html.Div([html.Label([*label, why]), control], id=f"of-{key}", className="off" if key in idle else "")


def reason_text(reason: str) -> str:
    """A reason as it stands behind a label."""
    return f" (no effect: {reason})" if reason else ""


def _labelled(dash: Any, slider: Slider, at_first: dict[str, Any], idle: Mapping[str, str]) -> Any:
    html, dcc = dash.html, dash.dcc
    value = at_first[slider.key]
    ends = {slider.position_of(end): f"{end:g}" for end in (slider.low, slider.high)}
    low, high, step = slider.positions
    label = [slider.label]
    options: dict[str, Any] = {}
    if slider.is_log:
        label += [": ", html.B(f"{value:g}", id=f"{slider.key}-value")]
        options["allow_direct_input"] = False  # a position is not a value
    moved = dcc.Slider(
        low, high, step, value=slider.position_of(value), marks=ends, id=slider.key, updatemode="drag",
        disabled=slider.key in idle,
        **{name: on for name, on in options.items() if name in dcc.Slider().available_properties},
    )  # fmt: skip
    return _greyable(dash, slider.key, label, moved, idle)


def _group(law: str) -> str:
    """Id of what holds the sliders of a law's gains."""
    return f"gains-of-{law}"


_AHEAD = "sliders-ahead"

SHOWN_FOR_A_LAW = (*map(_group, GAIN_SLIDERS), _AHEAD)
"""Ids of what is shown for some laws only."""


def styles_of(law: str) -> list[dict[str, str]]:
    """Whether each of SHOWN_FOR_A_LAW is, where a law is chosen."""
    shown = [*(name == law for name in GAIN_SLIDERS), law in LOOKING_AHEAD]
    return [{} if is_shown else {"display": "none"} for is_shown in shown]
