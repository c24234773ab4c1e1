"""The settings that the explorer's page shows, and the scenario that they make."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from agv_analysis.scenario import Scenario
from agv_cloud.reference.tracks import TRACKS
from agv_cloud.staleness.registry import STALENESS_POLICIES
from agv_plant.channels import MODELS
from agv_plant.parameters import PlantParameters, RelayParameters
from agv_ros.parameters import LoopParameters, as_dict


@dataclass(frozen=True)
class Slider:
    """One slider: what it is called, which values it takes."""

    key: str
    label: str
    low: float
    high: float
    step: float


NO_LIMIT = 20.0
"""At this end of its slider v_max is no limit."""

SLIDERS = (
    Slider("kx", "K_x [1/s]", 0.0, 400.0, 1.0),
    Slider("ky", "K_y [1/m^2]", 0.0, 20.0, 0.1),
    Slider("ktheta", "K_theta [1/m]", 0.0, 20.0, 0.1),
    Slider("ts", "T_s [ms]", 1.0, 50.0, 1.0),
    Slider("v_max", f"v_max [m/s], {NO_LIMIT:g}: none", 0.5, NO_LIMIT, 0.5),
    Slider("ahead", "starts ahead by [m]", -10.0, 10.0, 0.5),
    Slider("left", "starts to the left by [m]", -5.0, 5.0, 0.1),
    Slider("p", "channel: p", 0.0, 1.0, 0.005),
    Slider("r", "channel: r", 0.0, 1.0, 0.01),
    Slider("n", "burst: n lost after each received", 0.0, 60.0, 1.0),
    Slider("delay", "delay of each pose [ms]", 0.0, 500.0, 1.0),
    Slider("seed", "seed of the outages", 1.0, 100.0, 1.0),
)

CHOICES = {
    "model": ("channel", tuple(MODELS)),
    "policy": ("policy", STALENESS_POLICIES.names()),
    "track": ("track", tuple(TRACKS)),
}
"""Drop-down lists by key: label and what there is to choose from."""

Values = Mapping[str, Any]
"""Value by key of each slider and list, and the text `more` of further settings, one a line."""


def values_of(scenario: Scenario) -> dict[str, Any]:
    """Where sliders and lists stand for a scenario; beyond its end a slider stands at it."""
    gains, up, detector = scenario.controller, scenario.relay.uplink, scenario.error_detector
    x_r, y_r, theta = detector.track_start
    dx, dy = scenario.plant.initial_pose[0] - x_r, scenario.plant.initial_pose[1] - y_r
    found: dict[str, Any] = {
        "kx": gains.kx,
        "ky": gains.ky,
        "ktheta": gains.ktheta,
        "ts": 1e3 * scenario.plant.ts,
        "v_max": gains.v_max,
        "ahead": dx * math.cos(theta) + dy * math.sin(theta),
        "left": dy * math.cos(theta) - dx * math.sin(theta),
        "p": up.p,
        "r": up.r,
        "n": up.n,
        "delay": 1e3 * up.delay,
        "seed": scenario.relay.seed,
    }
    for slider in SLIDERS:
        found[slider.key] = round(min(slider.high, max(slider.low, found[slider.key])), 9)
    return {**found, "model": up.model, "policy": detector.policy, "track": detector.track, "more": ""}


def scenario_of(base: Scenario, values: Values) -> Scenario:
    """The base scenario with what is set on the page. Raises ParameterError, whose text says what is allowed."""
    return base.with_settings(settings_of(base, values), "the page")


def settings_of(base: Scenario, values: Values) -> list[str]:
    """What is set on the page as settings `node.parameter=value`; what stands where the base has it is left out.

    A slider shows less than a float holds: untouched, it must not change the base.
    """
    at_first = values_of(base)
    moved = {key for key, value in values.items() if value != at_first[key]}
    settings = [f"{_TARGETS[key]}={_text(key, values[key])}" for key in _TARGETS if key in moved]
    if moved & {"ahead", "left"}:
        settings.append(f"plant.initial_pose={list(_initial_pose(base, values['ahead'], values['left']))}")
    return settings + [line.strip() for line in values["more"].splitlines() if line.strip()]


_TARGETS = {
    "kx": "controller.kx",
    "ky": "controller.ky",
    "ktheta": "controller.ktheta",
    "ts": "plant.ts",
    "v_max": "controller.v_max",
    "p": "relay.uplink.p",
    "r": "relay.uplink.r",
    "n": "relay.uplink.n",
    "delay": "relay.uplink.delay",
    "seed": "relay.seed",
    "model": "relay.uplink.model",
    "policy": "error_detector.policy",
    "track": "error_detector.track",
}


def _text(key: str, value: Any) -> str:
    if key in CHOICES:
        return str(value)
    if key in ("n", "seed"):
        return _literal(round(value))
    if key == "v_max" and value >= NO_LIMIT:
        return _literal(math.inf)
    return _literal(float(value) / 1e3 if key in ("ts", "delay") else float(value))


def _initial_pose(base: Scenario, ahead: float, left: float) -> tuple[float, float, float]:
    x, y, theta = base.error_detector.track_start
    cos, sin = math.cos(theta), math.sin(theta)
    return x + ahead * cos - left * sin, y + ahead * sin + left * cos, base.plant.initial_pose[2]


@dataclass(frozen=True)
class Preset:
    """A setting that tells something, and what."""

    title: str
    text: str
    settings: tuple[str, ...]


_PAPERS = (
    "controller.kx=25.0", "controller.ky=1.0", "controller.ktheta=2.0", "controller.v_max=.inf", "plant.ts=0.005",
    "relay.uplink.model=perfect",
)  # fmt: skip

_LATE = (*_PAPERS, "error_detector.track=line", "relay.uplink.delay=0.065")
"""Each pose is 13 steps old: one more than a straight track bears with these gains."""

PRESETS = {
    "paper": Preset(
        "The paper's optimum",
        "No outages, K_x = 25 1/s: the AGV closes the 5 m and stays on the oval.",
        (*_PAPERS, "error_detector.track=paper", "error_detector.policy=hold", "relay.uplink.delay=0.0"),
    ),
    "missed": Preset(
        "What the eigenvalues miss",
        "A straight line, no pose lost, but each 13 steps (65 ms) old: to the paper's test that is as good as fresh, "
        "its eigenvalues are 0.875, 0.995 and 0.995 at every step, and the error grows.",
        (*_LATE, "error_detector.policy=hold"),
    ),
    "predicted": Preset(
        "The predictor saves it",
        "The same delay, but the edge moves the outdated pose on by the commands sent since.",
        (*_LATE, "error_detector.policy=predict"),
    ),
}


def preset_values(base: Scenario, key: str) -> dict[str, Any]:
    """Where sliders and lists stand for a preset, and what else has to be set for radio and AGV to be the paper's."""
    values = values_of(base.with_settings(PRESETS[key].settings, "the page"))
    return {**values, "more": "\n".join(_back_to_default(base))}


def _back_to_default(base: Scenario) -> list[str]:
    """Settings that undo what a scenario says of its links and of its AGV's body, but for what is on the page."""
    changes = {"plant": as_dict(base.plant), "relay": as_dict(base.relay)}
    defaults = {"plant": as_dict(PlantParameters()), "relay": as_dict(RelayParameters())}
    return [
        f"{node}.{name}={_literal(default)}"
        for node, values in defaults.items()
        for name, default in values.items()
        if changes[node][name] != default and f"{node}.{name}" not in _TARGETS.values() and name not in _KEPT
    ]


_KEPT = (*as_dict(LoopParameters()), "initial_pose", "clock", "duration", "seed")
"""Parameters of the plant's, and of the relay's, that a preset leaves as they are."""


def _literal(value: object) -> str:
    """A value as a setting has it."""
    if isinstance(value, str):
        return value
    if isinstance(value, float) and math.isinf(value):
        return ".inf" if value > 0.0 else "-.inf"
    return json.dumps(value)
