"""The parameters of a scenario as lines of a params file, and which of them differ from their defaults."""

from __future__ import annotations

from typing import Any, NamedTuple

from agv_analysis.scenario import SCHEMAS, Scenario
from agv_ros.parameters import as_dict


class ParameterLine(NamedTuple):
    """A line of the file; does it set a parameter to another value than its default?"""

    text: str
    is_changed: bool


def changed_parameters(scenario: Scenario) -> dict[str, tuple[Any, Any]]:
    """Value and default of each parameter that has another one, by `node.parameter`."""
    found = {}
    for node, schema in SCHEMAS.items():
        defaults = as_dict(schema())
        for name, value in as_dict(getattr(scenario, node)).items():
            if value != defaults[name]:
                found[f"{node}.{name}"] = value, defaults[name]
    return found


def parameter_lines(scenario: Scenario, text: str) -> list[ParameterLine]:
    """The lines of a scenario's params file `text`."""
    changed, node, lines = changed_parameters(scenario), "", []
    for line in text.splitlines():
        name = line.partition(":")[0].strip()
        if not line.startswith((" ", "-")):
            node = name
        lines.append(ParameterLine(line, f"{node}.{name}" in changed))
    return lines
