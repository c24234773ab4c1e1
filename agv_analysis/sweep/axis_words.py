"""What an axis of a sweep is called for people: the parameter's meaning, of the chosen channel, with its unit."""

from __future__ import annotations

from agv_analysis.scenario import Scenario
from agv_analysis.sweep.plan import Axis, known_parameters

_ASIDES = (", .inf: none", ", the same on all nodes", "; ")
"""What comes after the meaning in a description."""


def axis_words(axis: Axis, scenario: Scenario) -> str:
    """The meaning of an axis' parameter in a scenario, as `gain K_x of the error along the track [1/s]`.

    A parameter of several channels has the meaning that it has for the scenario's; the name where that does not use it.
    """
    known = known_parameters()[axis.node][axis.parameter]
    link, _, name = axis.parameter.partition(".")
    words = known.description
    if axis.node == "relay" and name:
        model = getattr(scenario.relay, link).model
        of_models = dict(clause.partition(": ")[::2] for clause in words.split("; ") if ": " in clause)
        words = f"{link}: {of_models.get(model, name if of_models else words)}"
    for aside in _ASIDES:
        words = words.partition(aside)[0]
    return f"{words} [{known.unit}]" if known.unit else words
