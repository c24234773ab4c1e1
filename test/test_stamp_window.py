"""A stamp ahead of a loop in lockstep whose nodes are started by hand: it is rejected, whatever `stamp_window` is."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

rclpy = pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")

from geometry_msgs.msg import PoseStamped, TwistStamped
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import TimeReference

from agv_cloud.controller_node import ControllerNode
from agv_cloud.error_detector_node import ErrorDetectorNode
from agv_plant.plant_node import PlantNode
from agv_plant.relay_node import RelayNode
from agv_ros.codec import encode_command, encode_pose, encode_slot
from agv_ros.endpoints import LOOP_QOS
from agv_ros.executor import EXECUTORS, spin_for
from agv_ros.messages import Command, Slot, StampedPose
from agv_ros.node import LoopNode

NODES: tuple[Callable[..., LoopNode[Any]], ...] = (ControllerNode, ErrorDetectorNode, RelayNode, PlantNode)
AHEAD = 100
"""Steps: 0.5 s, within the window that nodes have by themselves."""


ATTACKS: dict[str, tuple[type, Callable[[int], bytes], int]] = {
    "agv/pose": (PoseStamped, lambda ns: encode_pose(StampedPose(ns, 0.0, 0.0, 0.0)), 2),
    "edge/slot": (TimeReference, lambda ns: encode_slot(Slot(ns, ns, "delivered")), 1),
    "edge/cmd_vel": (TwistStamped, lambda ns: encode_command(Command(ns, 0.0, 0.0)), 2),
}
"""Topics with their type, a message of them, and which of NODES has to reject it."""


@pytest.mark.parametrize("topic", ATTACKS)
def test_a_message_ahead_is_rejected_by_a_loop_in_lockstep_whose_nodes_were_started_by_hand(topic: str) -> None:
    context = rclpy.Context()
    rclpy.init(context=context)
    executor = EXECUTORS["events"](context=context)
    stranger = Node("stranger", context=context, use_global_arguments=False)
    nodes: list[LoopNode[Any]] = []
    try:
        for kind in NODES:
            own = {"duration": math.inf, "answer_timeout": 5.0} if kind is PlantNode else {}
            overrides = [Parameter(name, value=value) for name, value in own.items()]
            nodes.append(kind(parameter_overrides=overrides, context=context, use_global_arguments=False))
            executor.add_node(nodes[-1])
        plant = nodes[-1]
        assert isinstance(plant, PlantNode)
        assert spin_for(executor, lambda: plant.k >= 20, 60.0), "the loop does not run"
        kind, message, number = ATTACKS[topic]
        foreign = stranger.create_publisher(kind, topic, LOOP_QOS)  # now: a plant does not begin beside one
        assert spin_for(executor, lambda: foreign.get_subscription_count() > 0, 60.0)
        k = plant.k + AHEAD
        foreign.publish(message(plant.grid.stamp(k)))
        assert spin_for(executor, lambda: plant.finished or plant.k > 2 * k, 60.0)
        assert not plant.finished, plant.failure
        assert nodes[number].rejected[topic] == 1
    finally:
        for node in (*nodes, stranger):
            node.destroy_node()
        executor.shutdown()
        context.try_shutdown()
