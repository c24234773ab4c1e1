"""Parameters that have no effect on a simulated run of a scenario, each with the reason.

A parameter whose description begins with the name of a choice, as in `gilbert_elliott: probability of bad to good`, is
read only where one of the choices so named is made. The rest depends on values, and stands here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from agv_analysis.scenario import PART_CHOICES, SCHEMAS, Scenario
from agv_plant.channels.registry import CHANNELS, TRACE
from agv_plant.parameters import ChannelParameters
from agv_ros.parameters import Parameter, as_dict, parameters_of

_LINKS = ("uplink", "downlink")

_WITHOUT_CHANCE = ("perfect", "burst", TRACE)
"""Channel models whose outcomes no seed changes."""

_WITH_A_SPEED = ("line", "circle", "eight", "warehouse", "path")


def idle_parameters(scenario: Scenario) -> dict[str, str]:
    """The reason why a parameter has no effect, by its name `node.parameter`; the others are absent."""
    found: dict[str, str] = {}
    for node, schema in SCHEMAS.items():
        values = as_dict(getattr(scenario, node))
        reasons = {**dict(_of_other_choices(parameters_of(schema), values)), **dict(_of_other_parts(node, values))}
        found |= {f"{node}.{name}": reason for name, reason in reasons.items()}
    return found | dict(_by_values(scenario))


def _of_other_parts(node: str, values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Parameters of the control laws, vehicles or policies that are not chosen."""
    if node in PART_CHOICES:
        choice = PART_CHOICES[node]
        chosen = values[choice.parameter]
        for part in choice.registry.usable():
            if part != chosen:
                yield from ((name, f"{choice.parameter} is {chosen}") for name in choice.names(part))


def _of_other_choices(known: Mapping[str, Parameter], values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Parameters that say in their descriptions for which choice, or with which switch on, they are."""
    for name, parameter in known.items():
        group = name.rpartition(".")[0]
        readers = [clause.partition(": ")[0] for clause in parameter.description.split("; ") if ": " in clause]
        if not readers or (parameter.choices and readers[0] in parameter.choices):
            continue
        for other, selector in known.items():
            if other.rpartition(".")[0] != group or other == name:
                continue
            is_switch = selector.kind == "bool" and other.rpartition(".")[2] == readers[0]
            if (is_switch and not values[other]) or (readers[0] in selector.choices and values[other] not in readers):
                yield name, f"{other} is {str(values[other]).lower() if is_switch else values[other]}"


def _by_values(scenario: Scenario) -> Iterator[tuple[str, str]]:
    """Parameters that have no effect at the values of others."""
    plant, relay, edge = scenario.plant, scenario.relay, scenario.error_detector
    links = {name: getattr(relay, name) for name in _LINKS}
    for name, link in links.items():
        if link.model in (*CHANNELS.own, *CHANNELS.reserved):
            yield f"relay.{name}.arguments", f"{name}.model is {link.model}"
        if not link.delays:
            yield f"relay.{name}.lifetime", f"no message of the {name} is late"
    if not any(map(_is_random, links.values())):
        yield "relay.seed", "no outcome of the links is random"
    if plant.slip_noise == 0.0:
        yield "plant.track_width", "both wheels slip alike"
    if plant.slip_noise == 0.0 and not plant.is_noisy:
        yield "plant.seed", "neither the pose nor the slip is noisy"
    if edge.track not in _WITH_A_SPEED:
        yield "error_detector.speed", f"track is {edge.track}"
    if edge.track != "csv":
        yield "error_detector.track_file", f"track is {edge.track}"
    if edge.track != "path":
        yield "error_detector.corner", f"track is {edge.track}"
    if relay.uplink.model == "perfect" and relay.uplink.is_direct and not relay.uplink.entries:
        yield "error_detector.policy", "every pose arrives at once, so none is outdated"


def _is_random(link: ChannelParameters) -> bool:
    has_parts_by_seed = link.model == TRACE and link.trace_window > 0.0
    late_by_chance = link.jitter > 0.0 or link.duplicate > 0.0 or any(e.name == "jitter" for e in link.entries)
    return link.model not in _WITHOUT_CHANCE or has_parts_by_seed or late_by_chance
