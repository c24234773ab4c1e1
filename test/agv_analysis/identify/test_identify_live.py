"""`agv-ncs identify --live`: topics that another process publishes on DDS, into a bag and then into numbers."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")

from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosbags.highlevel import AnyReader

from agv_ros.messages import quaternion_of_yaw

COMMAND, POSE = "/robot/cmd_vel", "/robot/odom"
START = 1_700_000_000_000_000_000  # [ns]
DEAD_TIME = 0.2  # [s]
SPEED_SHARE = 0.9  # of the commanded one that the robot drives

AgvNcs = Callable[..., tuple[int, str]]


@pytest.fixture
def robot() -> Iterator[Node]:
    context = Context()
    rclpy.init(context=context)
    node = Node("robot", context=context, use_global_arguments=False)
    yield node
    node.destroy_node()
    context.try_shutdown()


def header_of(message: Any, seconds: float) -> Any:
    stamp = START + round(seconds * 1e9)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    return message


def _stamp(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def drive(commands: Any, poses: Any) -> None:
    """Publish 40 s of a robot that does 0.2 s later 0.9 of what it was told, as fast as they can be sent."""
    rng = np.random.default_rng(3)
    x = y = theta = 0.0
    v, w = np.repeat(rng.uniform((0.1, -1.0), (0.9, 1.0), (40, 2)), 20, axis=0).T
    for step in range(len(v)):
        command = header_of(TwistStamped(), 0.05 * step)
        command.twist.linear.x, command.twist.angular.z = float(v[step]), float(w[step])
        commands.publish(command)
        pose = header_of(Odometry(), 0.05 * step)
        pose.pose.pose.position.x, pose.pose.pose.position.y = x, y
        pose.pose.pose.orientation.z, pose.pose.pose.orientation.w = quaternion_of_yaw(theta)
        poses.publish(pose)
        late = max(0, step - round(DEAD_TIME / 0.05))
        turned = 0.05 * SPEED_SHARE * float(w[late])
        x += 0.05 * SPEED_SHARE * float(v[late]) * float(np.cos(theta + turned / 2))
        y += 0.05 * SPEED_SHARE * float(v[late]) * float(np.sin(theta + turned / 2))
        theta += turned


def test_a_running_robot_is_recorded_and_identified(robot: Node, start: Callable[..., Any], tmp_path: Path) -> None:
    """Odometry of best effort and stamped commands: what is in the bag is what was sent, and the numbers are right."""
    commands = robot.create_publisher(TwistStamped, COMMAND, 2000)
    poses = robot.create_publisher(Odometry, POSE, QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT))
    words = ["identify", str(tmp_path / "bag"), "--live", "2", "--pose-topic", POSE, "--command-topic", COMMAND]
    words += ["--json", str(tmp_path / "robot.json")]
    child = start("agv_analysis.cli", *words)
    while not (commands.get_subscription_count() and poses.get_subscription_count()):
        assert child.process.poll() is None, child.process.communicate()
    drive(commands, poses)
    said, _ = child.process.communicate(timeout=300.0)
    assert child.process.returncode == 0, said
    assert "bag: " in said
    found = json.loads((tmp_path / "robot.json").read_text())
    for speed in ("v", "w"):
        assert found[speed]["dead_time_s"]["value"] == pytest.approx(DEAD_TIME, abs=0.01)
        assert found[speed]["gain"]["value"] == pytest.approx(SPEED_SHARE, abs=0.01)
    with AnyReader([tmp_path / "bag"]) as bag:
        sent = [_stamp(bag.deserialize(data, one.msgtype)) for one, _, data in bag.messages() if one.topic == COMMAND]
    assert sent == [START + 50_000_000 * i for i in range(800)]


def test_a_topic_that_is_not_published_is_named(
    agv_ncs: AgvNcs, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """After some seconds without a publisher: which topic, no bag, no traceback."""
    monkeypatch.setattr("agv_analysis.runtime.topic_recorder_node._PATIENCE", 0.5)
    status, said = agv_ncs(
        "identify", tmp_path / "bag", "--live", "2", "--pose-topic", POSE, "--command-topic", COMMAND
    )
    assert status == 1
    assert f"{POSE} is not published; {COMMAND} is not published" in said
    assert not (tmp_path / "bag").exists()
