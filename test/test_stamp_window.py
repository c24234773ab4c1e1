"""A stamp ahead of a loop in lockstep whose nodes are started by hand: what `stamp_window` makes of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

rclpy = pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")

from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.parameter import Parameter

from agv_cloud.controller_node import ControllerNode
from agv_cloud.error_detector_node import ErrorDetectorNode
from agv_plant.plant_node import PlantNode
from agv_plant.relay_node import RelayNode
from agv_ros.codec import encode_pose
from agv_ros.endpoints import LOOP_QOS
from agv_ros.executor import EXECUTORS, spin_for
from agv_ros.messages import StampedPose
from agv_ros.node import LoopNode

NODES: tuple[Callable[..., LoopNode[Any]], ...] = (ControllerNode, ErrorDetectorNode, RelayNode, PlantNode)
AHEAD = 100
"""Steps: 0.5 s, within the window that nodes have by themselves."""


@pytest.mark.parametrize(("parameters", "is_stalled"), [({}, True), ({"stamp_window": 0.01}, False)])
def test_a_pose_ahead_stalls_a_loop_by_hand_unless_its_window_is_that_of_lockstep(
    parameters: dict[str, float], is_stalled: bool
) -> None:
    context = rclpy.Context()
    rclpy.init(context=context)
    executor = EXECUTORS["events"](context=context)
    stranger = Node("stranger", context=context, use_global_arguments=False)
    nodes: list[LoopNode[Any]] = []
    try:
        for kind in NODES:
            own = {"duration": math.inf, "answer_timeout": 1.0} if kind is PlantNode else {}
            overrides = [Parameter(name, value=value) for name, value in (own | parameters).items()]
            nodes.append(kind(parameter_overrides=overrides, context=context, use_global_arguments=False))
            executor.add_node(nodes[-1])
        relay, plant = nodes[2:]
        assert isinstance(plant, PlantNode)
        assert spin_for(executor, lambda: plant.k >= 20, 60.0), "the loop does not run"
        foreign = stranger.create_publisher(PoseStamped, "agv/pose", LOOP_QOS)  # now: a plant does not begin beside one
        assert spin_for(executor, lambda: foreign.get_subscription_count() > 0, 60.0)
        k = plant.k + AHEAD
        foreign.publish(encode_pose(StampedPose(plant.grid.stamp(k), 0.0, 0.0, 0.0)))
        assert spin_for(executor, lambda: plant.finished or (not is_stalled and plant.k > 2 * k), 60.0)
        assert plant.finished == is_stalled, plant.failure
        assert ("no answer to step" in plant.failure) == is_stalled
        assert relay.rejected["agv/pose"] == (0 if is_stalled else 1)
    finally:
        for node in (*nodes, stranger):
            node.destroy_node()
        executor.shutdown()
        context.try_shutdown()
