"""A scenario: the parameters of all nodes of one loop, from the same file that drives `ros2 run`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

from agv_analysis.version import version
from agv_cloud.control.registry import CONTROL_LAWS, KANAYAMA
from agv_cloud.parameters import ControllerParameters, ErrorDetectorParameters
from agv_cloud.staleness.registry import STALENESS_POLICIES
from agv_plant.parameters import PlantParameters, RelayParameters
from agv_plant.vehicle.registry import VEHICLES
from agv_ros.parameters import ParameterError, as_dict
from agv_ros.params_file import parse_sections, read_sections, resolve
from agv_ros.part_registry import Registry
from agv_ros.ros_yaml import dump
from agv_ros.stamps import Grid

SCHEMAS: dict[str, type] = {
    "plant": PlantParameters,
    "relay": RelayParameters,
    "error_detector": ErrorDetectorParameters,
    "controller": ControllerParameters,
}
"""The loop's nodes by name, each with the schema of its parameters."""


class PartChoice(NamedTuple):
    """A node's parameter by which one of several parts is chosen, each with parameters of its own."""

    parameter: str
    registry: Registry
    unprefixed: str = ""
    """The part whose parameters stand without its name before them, if there is one."""

    def names(self, part: str) -> tuple[str, ...]:
        """Names of a part's parameters, as the node has them."""
        prefix = "" if part == self.unprefixed else f"{part}."
        return tuple(prefix + known.name for known in self.registry.find(part).parameters)


PART_CHOICES = {
    "plant": PartChoice("vehicle", VEHICLES),
    "error_detector": PartChoice("policy", STALENESS_POLICIES),
    "controller": PartChoice("law", CONTROL_LAWS, KANAYAMA),
}
"""The parts that are chosen by name, by their node."""


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

    def domain_of(self, node: str) -> int:
        """ROS_DOMAIN_ID that the params file wants for a node, -1 for the usual one; the relay's is the AGV's."""
        at_edge = node in ("error_detector", "controller")
        return self.relay.edge_domain_id if at_edge else self.relay.plant_domain_id

    def with_settings(self, settings: Iterable[str], name: str = "scenario") -> Scenario:
        """The scenario with settings `node.parameter=value` on top of it, called `name` in messages.

        Raises ParameterError.
        """
        return Scenario(**resolve(SCHEMAS, self._sections(), settings, name))

    def with_values(self, values: Mapping[str, Mapping[str, Any]], name: str = "scenario") -> Scenario:
        """The scenario with other values of parameters, by node and name, called `name` in messages.

        Raises ParameterError.
        """
        own = self._sections()
        return Scenario(**resolve(SCHEMAS, {node: own[node] | dict(values.get(node, {})) for node in own}, (), name))

    def to_yaml(self, of_all_parts: bool = False) -> str:
        """The whole scenario as a ROS 2 params file, with every default written out.

        Of vehicles, control laws and policies only the parameters of the chosen ones are in it, or those `of_all_parts`
        that are installed here, which no machine can read that has others.
        """
        sections = self._sections()
        if not of_all_parts:
            for node, choice in PART_CHOICES.items():
                others = set(choice.registry.usable()) - {sections[node][choice.parameter]}
                for name in (name for part in others for name in choice.names(part)):
                    sections[node].pop(name, None)
        return dump({node: {"ros__parameters": values} for node, values in sections.items()})

    def _sections(self) -> dict[str, dict[str, Any]]:
        return {node: _plain(as_dict(getattr(self, node))) for node in SCHEMAS}


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def metadata_of(scenario: Scenario) -> dict[str, str]:
    """What a recording holds of its run, in the record METADATA_NAME of `bags.writer`: version, seed and parameters."""
    return {"version": version(), "seed": str(scenario.relay.seed), "params": scenario.to_yaml()}


def load_scenario(path: str | Path, settings: Iterable[str] = ()) -> Scenario:
    """Scenario from a params file and settings `node.parameter=value`. Raises ParameterError."""
    name = str(path)
    return Scenario(**resolve(SCHEMAS, _own(read_sections(name), name), settings, name))


def parse_scenario(text: str, name: str = "scenario", settings: Iterable[str] = ()) -> Scenario:
    """As `load_scenario`, from the text of a params file called `name` in messages."""
    return Scenario(**resolve(SCHEMAS, _own(parse_sections(text, name), name), settings, name))


def _own(sections: dict[str, dict[str, Any]], path: str) -> dict[str, dict[str, Any]]:
    """Only the sections of the loop's nodes: a file may hold those of other nodes (recorder, RViz) as well.

    Raises ParameterError for a section that looks like a misspelt one: ROS would ignore it, and its gains with it.
    """
    for node in sections:
        meant = get_close_matches(node, SCHEMAS, 1, cutoff=0.8) if node not in SCHEMAS else []
        if meant and not node.startswith(meant[0]):  # relay_2 is another node
            raise ParameterError(f"{path}: no node is called {node!r}: is section {meant[0]!r} meant?")
    return {node: section for node, section in sections.items() if node == "/**" or node in SCHEMAS}
