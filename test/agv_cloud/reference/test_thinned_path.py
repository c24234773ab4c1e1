"""The reference as a latched path: the points of the track, for whoever comes later, and no part of the loop."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from agv_cloud.parameters import ErrorDetectorParameters
from agv_cloud.reference.reference import Reference
from agv_cloud.reference.thinned_path import LONGEST, MOST_POINTS, path_points


@pytest.mark.parametrize("track", ["paper", "line", "circle", "eight", "warehouse"])
def test_points_are_those_of_the_track(track: str) -> None:
    parameters = ErrorDetectorParameters(track=track, lap_time=10.0)
    points = np.array(path_points(Reference(parameters), parameters))
    lap = Reference(parameters).first(2001)
    stride = 5  # 2000 steps on 499 intervals at most
    np.testing.assert_array_equal(points, np.vstack((lap[:-1:stride], lap[-1:])))


@pytest.mark.parametrize("lap_time", [0.08, 2.495, 2.5, 100.0])
def test_there_are_few_points_and_both_ends(lap_time: float) -> None:
    parameters = ErrorDetectorParameters(lap_time=lap_time)
    reference = Reference(parameters)
    points = path_points(reference, parameters)
    assert 2 <= len(points) <= MOST_POINTS
    assert (points[0], points[-1]) == (reference[0], reference[round(lap_time / 0.005)])


def test_of_a_long_lap_there_is_the_beginning() -> None:
    parameters = ErrorDetectorParameters(lap_time=1e6)
    assert path_points(Reference(parameters), parameters)[-1] == Reference(parameters)[LONGEST]


@pytest.fixture
def context() -> Iterator[Any]:
    rclpy = pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    context = rclpy.Context()
    rclpy.init(context=context)
    yield context
    context.try_shutdown()


def test_who_comes_late_gets_it_too(context: Any) -> None:
    from nav_msgs.msg import Path
    from rclpy.node import Node
    from rclpy.parameter import Parameter
    from rclpy.qos import DurabilityPolicy, QoSProfile

    from agv_cloud.error_detector_node import ErrorDetectorNode
    from agv_ros.executor import EXECUTORS, spin_for

    executor = EXECUTORS["events"](context=context)
    overrides = [Parameter("track", value="circle"), Parameter("lap_time", value=20.0)]
    detector: Any = ErrorDetectorNode(parameter_overrides=overrides, context=context, use_global_arguments=False)
    late = Node("late", context=context, use_global_arguments=False)
    executor.add_node(detector)
    executor.add_node(late)
    paths: list[Any] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    late.create_subscription(Path, "edge/reference", paths.append, latched)
    try:
        assert spin_for(executor, lambda: len(paths) == 1, 60.0)
    finally:
        executor.shutdown()
        late.destroy_node()
        detector.destroy_node()
    (path,) = paths
    assert {path.header.frame_id, *(pose.header.frame_id for pose in path.poses)} == {"map"}
    expected = np.array(path_points(Reference(detector.settings), detector.settings))
    found = [(pose.pose.position.x, pose.pose.position.y) for pose in path.poses]
    np.testing.assert_array_equal(found, expected[:, :2])
    turned = [2.0 * np.arctan2(pose.pose.orientation.z, pose.pose.orientation.w) for pose in path.poses]
    np.testing.assert_allclose(np.exp(1j * np.array(turned)), np.exp(1j * expected[:, 2]), atol=1e-12)
