"""The settings that the explorer's page shows, and the scenario that they make."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from agv_analysis.explore.sliders import CHOICES, LOOK_AHEAD, LOOKING_AHEAD, SLIDERS, USUAL_LOOK_AHEAD
from agv_analysis.scenario import PART_CHOICES, SCHEMAS, Scenario
from agv_plant.parameters import PlantParameters, RelayParameters
from agv_plant.vehicle.registry import VEHICLES
from agv_ros.parameters import LoopParameters, as_dict

Values = Mapping[str, Any]
"""Value by key of each slider and list, and the text `more` of further settings, one a line."""


def values_of(scenario: Scenario) -> dict[str, Any]:
    """Where sliders and lists stand for a scenario; beyond its end a slider stands at it."""
    values = {node: as_dict(getattr(scenario, node)) for node in SCHEMAS}
    x_r, y_r, theta = scenario.error_detector.track_start
    dx, dy = scenario.plant.initial_pose[0] - x_r, scenario.plant.initial_pose[1] - y_r
    found: dict[str, Any] = {
        "ahead": dx * math.cos(theta) + dy * math.sin(theta),
        "left": dy * math.cos(theta) - dx * math.sin(theta),
    }
    for slider in SLIDERS:
        if slider.target:
            node, _, name = slider.target.partition(".")
            found[slider.key] = slider.scale * values[node][name]
    found[LOOK_AHEAD.key] = found[LOOK_AHEAD.key] or USUAL_LOOK_AHEAD
    for slider in SLIDERS:
        found[slider.key] = round(min(slider.high, max(slider.low, found[slider.key])), 9)
    for key, choice in CHOICES.items():
        node, _, name = choice.target.partition(".")
        found[key] = values[node][name]
    return {**found, "more": ""}


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
    settings += _look_ahead(base, values, LOOK_AHEAD.key in moved)
    return settings + [line.strip() for line in values["more"].splitlines() if line.strip()]


def _look_ahead(base: Scenario, values: Values, moved: bool) -> list[str]:
    """The setting that goes with the law: its slider counts where the law looks ahead, and another law does not."""
    if values["law"] in LOOKING_AHEAD:
        wanted = values[LOOK_AHEAD.key] / LOOK_AHEAD.scale
        return [f"{LOOK_AHEAD.target}={_literal(wanted)}"] if moved or base.controller.steps_ahead == 0 else []
    drops = values["law"] != base.controller.law and base.controller.look_ahead > 0.0
    return [f"{LOOK_AHEAD.target}=0.0"] if drops else []


_TARGETS = {slider.key: slider.target for slider in SLIDERS if slider.target and slider is not LOOK_AHEAD}
_TARGETS |= {key: choice.target for key, choice in CHOICES.items()}

_BY_KEY = {slider.key: slider for slider in SLIDERS}


def _text(key: str, value: Any) -> str:
    if key in CHOICES:
        return str(value)
    slider = _BY_KEY[key]
    if key in ("n", "seed"):
        return _literal(round(value))
    if slider.open_end and value >= slider.high:
        return _literal(math.inf)
    return _literal(float(value) / slider.scale)


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
    "relay.uplink.model=perfect", "controller.law=kanayama", "controller.look_ahead=0.0", "plant.vehicle=unicycle",
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
    kept = {*_KEPT, *(name for vehicle in VEHICLES.usable() for name in PART_CHOICES["plant"].names(vehicle))}
    return [
        f"{node}.{name}={_literal(default)}"
        for node, values in defaults.items()
        for name, default in values.items()
        if changes[node][name] != default and f"{node}.{name}" not in _TARGETS.values() and name not in kept
    ]


_KEPT = (*as_dict(LoopParameters()), "initial_pose", "clock", "duration", "seed")
"""Parameters of the plant's, and of the relay's, that a preset leaves as they are, beside those of vehicles."""


def _literal(value: object) -> str:
    """A value as a setting has it."""
    if isinstance(value, str):
        return value
    if isinstance(value, float) and math.isinf(value):
        return ".inf" if value > 0.0 else "-.inf"
    return json.dumps(value)
