"""Transforms: their bytes as another library reads them, on real DDS beside the poses that the loop sends, or absent.

tf2_msgs is in no wheel. Messages go out serialised, so any type can stand in for theirs on DDS; what is in them is read
by the definition of tf2_msgs/TFMessage.
"""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from agv_analysis.scenario import load_scenario
from agv_cloud.reference import Reference
from agv_ros.transforms import TOPIC
from agv_ros.wire import Pose, decode_pose, encode_transform

REPOSITORY = Path(__file__).parents[1]
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
poses = st.builds(Pose, st.integers(1, 2**31 * NS - 1), numbers, numbers, st.floats(-np.pi, np.pi))
frames = st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=40)


@given(poses, frames)
def test_another_library_reads_what_was_meant(pose: Pose, frame: str) -> None:
    data = encode_transform(pose, frame)
    transform = decoded(data)
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", frame)
    assert stamp_of(transform) == pose.stamp_ns
    x, y, theta = place(transform)
    assert (x, y) == (pose.x, pose.y)
    assert abs(np.exp(1j * theta) - np.exp(1j * pose.theta)) < 1e-12


@given(poses)
def test_the_bytes_are_those_that_another_library_writes(pose: Pose) -> None:
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

    from agv_analysis.runner import NODES, OneProcess
    from agv_ros.executor import EXECUTORS, spin_for
    from agv_ros.node import LOOP_QOS

    settings = (f"plant.frame_prefix={prefix}", "plant.duration=.inf")
    scenario = load_scenario(str(REPOSITORY / "config/outages.yaml"), settings)
    transforms: dict[str, dict[int, Any]] = {f"{prefix}base_link": {}, f"{prefix}reference": {}}
    sent: dict[int, Pose] = {}

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
    from agv_analysis.runner import run_in_process

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
