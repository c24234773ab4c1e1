"""Sliders of the page: gains of the chosen law and parameters of the chosen channel that change at run time."""

from __future__ import annotations

import math
from typing import Any

from agv_analysis.explore.sliders import GAIN_SLIDERS, OTHER_SLIDERS, Slider
from agv_analysis.idle_parameters import idle_parameters
from agv_analysis.scenario import SCHEMAS, Scenario
from agv_ros.parameters import as_dict, parameters_of

_OTHERS = tuple(slider for slider in OTHER_SLIDERS if slider.key in ("v_max", "p", "r", "n"))


def controls_of(scenario: Scenario) -> list[dict[str, Any]]:
    """Sliders for a scenario, each with its label, its target, the values that it can take, and where it stands.

    None among the values, and as the value: no limit.
    """
    sliders, idle = (*GAIN_SLIDERS.get(scenario.controller.law, ()), *_OTHERS), idle_parameters(scenario)
    return [_control(slider, scenario) for slider in sliders if slider.target not in idle and _changes(slider)]


def _changes(slider: Slider) -> bool:
    node, _, name = slider.target.partition(".")
    known = parameters_of(SCHEMAS[node]).get(name)
    return known is not None and known.runtime


def _control(slider: Slider, scenario: Scenario) -> dict[str, Any]:
    node, _, name = slider.target.partition(".")
    low, high, step = slider.positions
    values = [slider.value_at(low + i * step) / slider.scale for i in range(round((high - low) / step) + 1)]
    value = as_dict(getattr(scenario, node))[name]
    is_none = math.isinf(value)
    at = len(values) - 1 if is_none else min(range(len(values)), key=lambda i: abs(values[i] - value))
    return {
        "label": slider.label, "target": slider.target, "at": at, "value": None if is_none else value,
        "values": [*values[:-1], None] if slider.open_end else values,
    }  # fmt: skip
