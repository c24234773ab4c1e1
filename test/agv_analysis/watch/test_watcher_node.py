"""The watcher on real DDS: a loop does not count it, and it hears what is published on both sides."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

rclpy = pytest.importorskip("rclpy", reason="needs ROS 2")

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node

from agv_analysis.watch.live_loop import TOPICS
from agv_analysis.watch.watcher_node import WatcherNode
from agv_ros.codec import encode_error, encode_pose, encode_slot
from agv_ros.endpoints import LOOP_QOS, Output
from agv_ros.messages import DELIVERED, Slot, StampedPose, TrackingError


@pytest.fixture
def make() -> Iterator[Callable[[str], Node]]:
    """Nodes of this process."""
    with ExitStack() as stack:
        context = rclpy.Context()
        rclpy.init(context=context)
        stack.callback(context.try_shutdown)

        def node(name: str) -> Node:
            found = rclpy.create_node(name, context=context, use_global_arguments=False)
            stack.callback(found.destroy_node)
            return found

        yield node


@pytest.fixture
def watcher() -> Iterator[WatcherNode]:
    found = WatcherNode()
    yield found
    found.close()


def until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    """`seconds` is only there so that a hanging test ends."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_loop_does_not_count_a_watcher(make: Callable[[str], Node], watcher: WatcherNode) -> None:
    plant = make("plant")
    output = Output(plant.create_publisher(PoseStamped, "agv/pose", LOOP_QOS), False, False, plant)
    until(output.is_watched)
    assert output.is_heard(0)
    assert not output.is_heard(1)
    peers = [make("relay").create_subscription(PoseStamped, "agv/pose", lambda _: None, LOOP_QOS)]
    until(lambda: output.is_heard(1))
    assert not output.is_heard(2)
    peers.append(make("recorder").create_subscription(PoseStamped, "agv/pose", lambda _: None, LOOP_QOS))
    until(lambda: output.is_heard(2))
    assert not output.is_heard(3)


def test_a_watcher_hears_a_robot_s_odometry_in_place_of_poses(
    make: Callable[[str], Node], watcher: WatcherNode
) -> None:
    robot = make("robot")
    odometry = robot.create_publisher(Odometry, "agv/pose", LOOP_QOS)
    data = encode_error(TrackingError(5, 1.0, 2.0, 0.0, 0.0, 0.0))

    def hears() -> bool:
        watcher.look()
        odometry.publish(data)
        return any(TOPICS[heard.topic] == "agv/pose" and heard.data == data for heard in watcher.drain())

    until(hears)
    assert watcher.types()[TOPICS.index("agv/pose")] == "nav_msgs/msg/Odometry"


def test_slots_are_taken_before_the_messages_that_they_are_about(
    make: Callable[[str], Node], watcher: WatcherNode
) -> None:
    from sensor_msgs.msg import TimeReference

    relay = make("relay")
    poses, slots = (
        relay.create_publisher(*what, LOOP_QOS) for what in ((PoseStamped, "agv/pose"), (TimeReference, "edge/slot"))
    )
    outputs = [Output(publisher, False, False, relay) for publisher in (poses, slots)]
    until(lambda: all(output.is_watched() for output in outputs))
    found: list[str] = []

    def has_both() -> bool:
        poses.publish(encode_pose(StampedPose(7, 1.0, 2.0, 0.0)))
        slots.publish(encode_slot(Slot(7, 7, DELIVERED)))
        found[:] = [TOPICS[heard.topic] for heard in watcher.drain()]
        return len(set(found)) == 2

    until(has_both)
    assert found == sorted(found, reverse=True)  # edge/slot, agv/pose
