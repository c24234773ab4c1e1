"""The policy for SROS2 against the graph of running loops: what a node uses is allowed, and nothing else is."""

from __future__ import annotations

import importlib.util
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest

rclpy = pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")

from rclpy.node import Node
from rclpy.parameter import Parameter

from agv_analysis.runtime.recorder_node import RecorderNode
from agv_cloud.controller_node import ControllerNode
from agv_cloud.error_detector_node import ErrorDetectorNode
from agv_plant.plant_node import PlantNode
from agv_plant.relay_node import RelayNode
from agv_ros.executor import EXECUTORS, spin_for
from agv_ros.node import LoopNode

CONFIG = Path(__file__).parents[1] / "config"

NODES: dict[str, Callable[..., LoopNode[Any]]] = {
    "recorder": RecorderNode,
    "controller": ControllerNode,
    "error_detector": ErrorDetectorNode,
    "relay": RelayNode,
    "plant": PlantNode,
}

LOOPS: tuple[dict[str, dict[str, Any]], ...] = (
    {},
    {
        "plant": {"plan_steps": 3, "noise_xy": 0.001},
        "relay": {"plan_steps": 3},
        "error_detector": {"plan_steps": 3},
        "controller": {"plan_steps": 3},
    },
    {
        "plant": {"clock": "realtime"},
        "error_detector": {"trigger": "timer", "policy": "predict", "track": "path"},
    },
)
"""Parameters by node: together they have all topics that a loop can have."""

Use = tuple[str, str]
"""How a name is used, publish, subscribe, reply or request, and the name in full."""


def allowed() -> dict[str, set[Use]]:
    """What the file allows, by node, its names resolved as sros2 does: absolute, ~ private, others relative."""
    found: dict[str, set[Use]] = {}
    for enclave in ET.parse(CONFIG / "sros2_policy.xml").getroot().iterfind("enclaves/enclave"):
        (profile,) = enclave.iterfind("profiles/profile")
        namespace, node = profile.attrib["ns"], profile.attrib["node"]
        assert enclave.attrib["path"] == f"/agv_ncs/{node}"
        base = namespace.rstrip("/") + "/"
        uses = found.setdefault(node, set())
        for rule in profile:
            for how, word in rule.attrib.items():
                assert word == "ALLOW"
                for name in rule:
                    assert name.text is not None
                    own = base + node + name.text[1:] if name.text.startswith("~") else base + name.text
                    uses.add((how, name.text if name.text.startswith("/") else own))
    return found


def used(parameters: dict[str, dict[str, Any]], bag: Path) -> dict[str, set[Use]]:
    """What the nodes of a loop that runs use."""
    context = rclpy.Context()
    rclpy.init(context=context)
    executor = EXECUTORS["events"](context=context)
    nodes: list[LoopNode[Any]] = []
    recorded = {"bag": str(bag), "params_file": str(CONFIG / "paper.yaml")}
    try:
        for name, kind in NODES.items():
            given = {"use_sim_time": True, **(recorded if name == "recorder" else {"wait_for_subscribers": 2})}
            overrides = [Parameter(key, value=value) for key, value in (given | parameters.get(name, {})).items()]
            nodes.append(kind(parameter_overrides=overrides, context=context, use_global_arguments=False))
            executor.add_node(nodes[-1])
        plant = nodes[-1]
        assert isinstance(plant, PlantNode)
        assert spin_for(executor, lambda: plant.k >= 20, 60.0), "the loop does not run"
        return {node.get_name(): set(uses_of(node)) for node in nodes}
    finally:
        for node in nodes:
            node.destroy_node()
        executor.shutdown()
        context.try_shutdown()


def uses_of(node: Node) -> list[Use]:
    who = (node.get_name(), node.get_namespace())
    named = {
        "publish": node.get_publisher_names_and_types_by_node,
        "subscribe": node.get_subscriber_names_and_types_by_node,
        "reply": node.get_service_names_and_types_by_node,
        "request": node.get_client_names_and_types_by_node,
    }
    return [(how, name) for how, ask in named.items() for name, _ in ask(*who)]


def test_what_the_nodes_use_is_allowed_and_nothing_else(tmp_path: Path) -> None:
    found: dict[str, set[Use]] = defaultdict(set)
    for number, parameters in enumerate(LOOPS):
        for name, uses in used(parameters, tmp_path / str(number)).items():
            found[name] |= uses
    if importlib.util.find_spec("tf2_msgs") is None:  # then no node publishes transforms
        for name in ("plant", "error_detector"):
            found[name].add(("publish", "/tf"))
    permitted = allowed()
    assert set(permitted) == set(NODES)
    for name in NODES:
        assert found[name] - permitted[name] == set(), f"{name}: used and not allowed"
        assert permitted[name] - found[name] == set(), f"{name}: allowed and not used"


def test_a_command_reaches_the_agv_through_the_relay_alone() -> None:
    speakers = defaultdict(set)
    for name, uses in allowed().items():
        for how, topic in uses:
            if how == "publish":
                speakers[topic].add(name)
    assert speakers["/agv/cmd_vel"] == speakers["/agv/slot"] == speakers["/edge/pose"] == {"relay"}
    assert (speakers["/agv/pose"], speakers["/edge/cmd_vel"]) == ({"plant"}, {"controller"})
    assert not {topic for topic, names in speakers.items() if "recorder" in names} & {"/clock", "/tf"}
