"""Transforms: their bytes as another library reads them, on real DDS beside the poses that the loop sends, or absent.

tf2_msgs is in no wheel. Messages go out serialised, so any type can stand in for theirs on DDS; what is in them is read
by the definition of tf2_msgs/TFMessage.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from agv_analysis.recordings.other_robots import RobotTopics, read_robot_run
from agv_analysis.run import Run
from agv_analysis.scenario import load_scenario
from agv_cloud.reference.reference import Reference
from agv_ros.codec import decode_odometry, decode_pose, encode_transform
from agv_ros.messages import StampedPose
from agv_ros.transforms import TOPIC

REPOSITORY = Path(__file__).parents[2]
STORE = get_typestore(Stores.ROS2_JAZZY)
NS = 1_000_000_000


def decoded(data: bytes) -> Any:
    """The one transform of a message, read by rosbags."""
    message: Any = STORE.deserialize_cdr(data, "tf2_msgs/msg/TFMessage")
    (transform,) = message.transforms
    return transform


def stamp_of(transform: Any) -> int:
    return int(transform.header.stamp.sec * NS + transform.header.stamp.nanosec)


def place(transform: Any) -> tuple[float, float, float]:
    """Where an x axis of one metre goes: its foot, and its direction as an angle [rad] about +z."""
    moved, turned = transform.transform.translation, transform.transform.rotation
    tip = Rotation.from_quat([turned.x, turned.y, turned.z, turned.w]).apply([1.0, 0.0, 0.0])
    assert (moved.z, tip[2]) == (0.0, 0.0)
    return moved.x, moved.y, float(np.arctan2(tip[1], tip[0]))


numbers = st.floats(-1e6, 1e6)
poses = st.builds(StampedPose, st.integers(1, 2**31 * NS - 1), numbers, numbers, st.floats(-np.pi, np.pi))
frames = st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=40)


@given(poses, frames)
def test_another_library_reads_what_was_meant(pose: StampedPose, frame: str) -> None:
    data = encode_transform(pose, frame)
    transform = decoded(data)
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", frame)
    assert stamp_of(transform) == pose.stamp_ns
    x, y, theta = place(transform)
    assert (x, y) == (pose.x, pose.y)
    assert abs(np.exp(1j * theta) - np.exp(1j * pose.theta)) < 1e-12


@given(poses)
def test_the_bytes_are_those_that_another_library_writes(pose: StampedPose) -> None:
    data = encode_transform(pose, "agv1/base_link")
    message = STORE.deserialize_cdr(data, "tf2_msgs/msg/TFMessage")
    again = STORE.serialize_cdr(message, "tf2_msgs/msg/TFMessage")
    # rosbags leaves nothing open between members either, but its first four bytes are its own
    assert bytes(again)[4:] == data[4:]


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Make a package `tf2_msgs` whose module `msg` has this content, seen before any other."""

    def make(content: str) -> Path:
        folder = tmp_path / "packages"
        (folder / "tf2_msgs").mkdir(parents=True)
        (folder / "tf2_msgs/__init__.py").write_text("")
        (folder / "tf2_msgs/msg.py").write_text(content)
        for name in [name for name in sys.modules if name.partition(".")[0] == "tf2_msgs"]:
            monkeypatch.delitem(sys.modules, name)
        monkeypatch.syspath_prepend(folder)
        return folder

    return make


@pytest.fixture
def of_another_type(stand_in: Callable[[str], Path]) -> Any:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    stand_in("from geometry_msgs.msg import TransformStamped as TFMessage\n")
    yield
    for name in ("tf2_msgs", "tf2_msgs.msg"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("prefix", ["", "agv1/"])
def test_whoever_listens_gets_both_frames(of_another_type: None, prefix: str) -> None:
    from geometry_msgs.msg import PoseStamped, TransformStamped
    from rclpy.node import Node

    from agv_analysis.runtime.one_process import OneProcess
    from agv_analysis.runtime.runner import NODES
    from agv_ros.endpoints import LOOP_QOS
    from agv_ros.executor import EXECUTORS, spin_for

    settings = (f"plant.frame_prefix={prefix}", "plant.duration=.inf")
    scenario = load_scenario(str(REPOSITORY / "config/outages.yaml"), settings)
    transforms: dict[str, dict[int, Any]] = {f"{prefix}base_link": {}, f"{prefix}reference": {}}
    sent: dict[int, StampedPose] = {}

    def on_transform(data: bytes) -> None:
        transform = decoded(data)
        transforms[transform.child_frame_id][stamp_of(transform)] = place(transform)

    def on_pose(data: bytes) -> None:
        pose = decode_pose(data)
        sent[pose.stamp_ns] = pose

    def has_enough() -> bool:
        return all(len(found.keys() & sent.keys()) > 100 for found in transforms.values())

    with OneProcess() as process:
        executor = EXECUTORS["events"](context=process.context)
        for name in ("controller", "error_detector", "relay", "plant"):
            executor.add_node(process.add(NODES[name], getattr(scenario, name)))
        listener = Node("listener", context=process.context, use_global_arguments=False)
        executor.add_node(listener)
        listener.create_subscription(TransformStamped, TOPIC, on_transform, LOOP_QOS, raw=True)
        listener.create_subscription(PoseStamped, "agv/pose", on_pose, LOOP_QOS, raw=True)
        try:
            assert spin_for(executor, has_enough, 60.0)
        finally:
            executor.shutdown()
            listener.destroy_node()
    reference = Reference(scenario.error_detector)
    driven, wanted = transforms.values()
    off = [k for k in driven.keys() & sent.keys() if not _close(driven[k], sent[k][1:])]
    assert off == []
    off = [k for k in wanted if not _close(wanted[k], reference[scenario.grid.step(k)][:3])]
    assert off == []


@pytest.fixture(params=["tf2_msgs", "another type"])
def tf_type(request: pytest.FixtureRequest) -> Any:
    """The type of /tf: the real one where it is installed, and one in its place."""
    if request.param == "tf2_msgs":
        return pytest.importorskip("tf2_msgs.msg", reason="needs tf2_msgs, which only ROS 2 itself has").TFMessage
    request.getfixturevalue("of_another_type")
    return importlib.import_module("tf2_msgs.msg").TFMessage


def test_another_robot_s_transform_goes_beside_ours_and_disturbs_no_analysis(tf_type: Any, tmp_path: Path) -> None:
    from nav_msgs.msg import Odometry

    from agv_cloud.error_detector_node import ErrorDetectorNode
    from agv_ros.endpoints import LOOP_QOS
    from test.test_nodes import EDGE_OF_A_ROBOT, ROBOT_S_TOPICS, Bench, Robot

    bench, heard = Bench("events"), []

    def note(topic: str, kind: str) -> Callable[[bytes], None]:
        return lambda data: heard.append((topic, kind, bytes(data)))

    odometry, tf = ("/diff_drive_controller/odom", "nav_msgs/msg/Odometry"), ("/tf", "tf2_msgs/msg/TFMessage")
    bench.probe.create_subscription(Odometry, odometry[0], note(*odometry), LOOP_QOS, raw=True)
    bench.probe.create_subscription(tf_type, tf[0], note(*tf), LOOP_QOS, raw=True)
    robot = Robot(bench.context, True, tf_type)
    bench.executor.add_node(robot)
    bench.nodes.append(robot)
    parameters = {"trigger": "timer", "begin": "first_pose", "pose_type": "odometry"} | EDGE_OF_A_ROBOT
    bench.add(functools.partial(ErrorDetectorNode, cli_args=["--ros-args", *ROBOT_S_TOPICS]), **parameters)

    def places() -> dict[str, dict[int, Any]]:
        """What each pair of frames has, by stamp."""
        found: dict[str, dict[int, Any]] = {}
        for topic, _, data in heard:
            if topic == tf[0]:
                one = decoded(data)
                frames = f"{one.header.frame_id} {one.child_frame_id}"
                found.setdefault(frames, {})[stamp_of(one)] = place(one)
        return found

    try:
        bench.until(lambda: len(places().get("odom base_link", ())) > 5 and "map reference" in places())
    finally:
        bench.close()
    assert set(places()) == {"odom base_link", "map reference"}
    sent = [decode_odometry(data) for topic, _, data in heard if topic == odometry[0]]
    seen = places()["odom base_link"]
    assert [pose.stamp_ns for pose in sent if pose.stamp_ns in seen and not _close(seen[pose.stamp_ns], pose[1:])] == []
    runs: list[Run] = []
    for kept in ([*heard], [message for message in heard if message[0] != tf[0]]):
        bag = tmp_path / f"bag_{len(runs)}"
        write(bag, kept)
        runs.append(read_robot_run(bag, RobotTopics(odometry[0]), None, config_of(tmp_path)))
    for name in ("k", "pose", "reference", "lost", "n_ul"):
        np.testing.assert_array_equal(getattr(runs[0], name), getattr(runs[1], name), name)
    assert runs[0].notes == runs[1].notes


def write(bag: Path, messages: list[tuple[str, str, bytes]]) -> None:
    """A bag of serialised messages, one a millisecond."""
    with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections: dict[str, Any] = {}
        for number, (topic, kind, data) in enumerate(messages):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], NS + number * 1_000_000, data)


def config_of(folder: Path) -> Path:
    path = folder / "line.yaml"
    path.write_text("error_detector: {ros__parameters: {track: line, speed: 0.2, track_start: [0.0, 0.3, 0.0]}}\n")
    return path


def _close(found: tuple[float, float, float], expected: tuple[float, ...]) -> bool:
    turned = abs(np.exp(1j * found[2]) - np.exp(1j * expected[2]))
    return bool(np.allclose(found[:2], expected[:2], rtol=0.0, atol=1e-12) and turned < 1e-12)


def test_without_tf2_msgs_the_nodes_run_and_say_so_once(
    agv_ncs: Callable[..., tuple[int, str]], stand_in: Callable[[str], Path]
) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    folder = stand_in("raise ImportError('no tf2_msgs here')\n")
    path = os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "PYTHONPATH": path}
    status, said = agv_ncs("run", "config/paper.yaml", "--duration", "1.0", env=environment)
    assert status == 0, said[-500:]
    assert said.count("tf2_msgs is not installed") == 1, said[-500:]


def test_the_prefix_is_in_the_loop_s_own_messages(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    from agv_analysis.bags import read_bag
    from agv_analysis.runtime.runner import run_in_process

    scenario = load_scenario(str(REPOSITORY / "config/paper.yaml"), ("plant.duration=0.5",))
    nodes = {
        node.name: dataclasses.replace(getattr(scenario, node.name), frame_prefix="agv1/")
        for node in dataclasses.fields(scenario)
    }
    outcome = run_in_process(type(scenario)(**nodes), tmp_path / "bag", lambda _: None)
    assert (outcome.failure, outcome.recording_failure) == ("", "")
    bag = read_bag(tmp_path / "bag")
    found = {
        (topic, name): set(bag[topic][name].tolist())
        for topic in ("/agv/pose", "/edge/error", "/agv/cmd_vel")
        for name in ("header.frame_id", "child_frame_id")
        if name in (bag[topic].dtype.names or ())
    }
    assert found == {
        ("/agv/pose", "header.frame_id"): {b"map"},
        ("/edge/error", "header.frame_id"): {b"agv1/base_link"},
        ("/edge/error", "child_frame_id"): {b"agv1/reference"},
        ("/agv/cmd_vel", "header.frame_id"): {b"agv1/base_link"},
    }
