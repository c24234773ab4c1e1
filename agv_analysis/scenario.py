"""A scenario: the parameters of all nodes of one loop, from the same file that drives `ros2 run`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import yaml

from agv_cloud.parameters import ControllerParameters, ErrorDetectorParameters
from agv_plant.parameters import PlantParameters, RelayParameters
from agv_ros.parameters import as_dict
from agv_ros.params_file import parse_sections, read_sections, resolve
from agv_ros.stamps import Grid

SCHEMAS: dict[str, type] = {
    "plant": PlantParameters,
    "relay": RelayParameters,
    "error_detector": ErrorDetectorParameters,
    "controller": ControllerParameters,
}
"""The loop's nodes by name, each with the schema of its parameters."""


@dataclass(frozen=True)
class Scenario:
    """Parameters of the four nodes, checked, with equal `ts` and `start_time`."""

    plant: PlantParameters
    relay: RelayParameters
    error_detector: ErrorDetectorParameters
    controller: ControllerParameters

    @property
    def grid(self) -> Grid:
        """The sampling instants."""
        return Grid.of(self.plant.start_time, self.plant.ts)

    def to_yaml(self) -> str:
        """The whole scenario as a ROS 2 params file, with every default written out."""
        return yaml.safe_dump(
            {node: {"ros__parameters": _plain(as_dict(getattr(self, node)))} for node in SCHEMAS}, sort_keys=False
        )


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def load_scenario(path: str, settings: Iterable[str] = ()) -> Scenario:
    """Scenario from a params file and settings `node.parameter=value`. Raises ParameterError."""
    return Scenario(**resolve(SCHEMAS, _own(read_sections(path)), settings, path))


def parse_scenario(text: str, name: str, settings: Iterable[str] = ()) -> Scenario:
    """As `load_scenario`, from the text of a params file called `name` in messages."""
    return Scenario(**resolve(SCHEMAS, _own(parse_sections(text, name)), settings, name))


def _own(sections: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Only the sections of the loop's nodes: a file may hold those of other nodes (recorder, RViz) as well."""
    return {node: section for node, section in sections.items() if node == "/**" or node in SCHEMAS}
