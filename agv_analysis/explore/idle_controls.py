"""Which controls of the page have no effect on the setting that it shows, and why."""

from __future__ import annotations

from agv_analysis.explore.sliders import CHOICES, SLIDERS
from agv_analysis.idle_parameters import idle_parameters
from agv_analysis.scenario import Scenario

_TARGETS = {
    **{slider.key: slider.target or "plant.initial_pose" for slider in SLIDERS},
    **{key: choice.target for key, choice in CHOICES.items()},
}
"""The parameter of each slider and list."""

CONTROLS = tuple(_TARGETS)
"""Keys of all sliders and lists."""


def idle_controls(scenario: Scenario, more: str) -> dict[str, str]:
    """Reason by the key of a slider or list; `more` are the page's further settings, which override its controls."""
    idle, further = idle_parameters(scenario), _names(more)
    reasons = {key: "set under more" if name in further else idle.get(name, "") for key, name in _TARGETS.items()}
    return {key: reason for key, reason in reasons.items() if reason}


def idle_lines(scenario: Scenario, more: str) -> str:
    """What of the further settings has no effect, in words; empty if all has."""
    idle = idle_parameters(scenario)
    return "; ".join(f"{name} has no effect: {idle[name]}" for name in _names(more) if name in idle)


def _names(more: str) -> list[str]:
    """Parameters that are set in lines `node.parameter=value`."""
    return [line.partition("=")[0].strip() for line in more.splitlines() if "=" in line]
