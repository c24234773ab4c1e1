"""Recordings played again to the edge's nodes, and driven again, by the command."""

from __future__ import annotations

import importlib.util
import itertools
import json
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytest
import yaml

from agv_analysis.bags import read_bag
from agv_analysis.recordings.recording import read_run
from agv_analysis.run import Run
from agv_analysis.runtime.edge_comparison import compare, compare_answers
from agv_analysis.runtime.edge_inputs import aligned_answers, inputs_of, read_inputs
from agv_ros.codec import encode_clock, stamp_of
from agv_ros.message_sync import MessageSync
from agv_ros.messages import DELIVERED, Slot, StampedPose
from agv_ros.stamps import Grid

if TYPE_CHECKING:
    from test.conftest import Drive, Start

REPOSITORY = Path(__file__).parents[3]
SAMPLE = REPOSITORY / "bags/sample"
QOS = REPOSITORY / "config/rosbag2_qos.yaml"
AgvNcs = Callable[..., tuple[int, str]]


def test_the_command_says_whether_the_edge_changed(agv_ncs: AgvNcs, tmp_path: Path) -> None:
    status, said = agv_ncs("replay", SAMPLE, "--compare")
    assert (status, said.count("2000 steps compared, equal")) == (0, 2)
    status, said = agv_ncs("replay", SAMPLE, "--compare", "--set", "controller.kx=5.0", "--json", tmp_path / "c.json")
    assert status == 1
    assert "commands: 2000 steps compared, step 0 is the first to differ" in said
    assert json.loads((tmp_path / "c.json").read_text())["differs"] is True


def test_the_command_s_errors_are_one_line(agv_ncs: AgvNcs, tmp_path: Path) -> None:
    for arguments in ((SAMPLE, "--ros"), (SAMPLE, "--outages", tmp_path / "o.csv", "--set", "controller.kx=5.0")):
        assert agv_ncs("replay", *arguments)[0] == 2
    status, said = agv_ncs("replay", tmp_path / "none", "--compare")
    assert status == 1
    assert "Traceback" not in said


# -- on DDS ------------------------------------------------------------------------------------------------------------


def test_what_came_to_the_edge(sample: Run) -> None:
    inputs = read_inputs(SAMPLE, sample.scenario.grid)
    assert [slot.k for slot in inputs.slots] == sample.k.tolist()
    assert [slot.pose is None for slot in inputs.slots] == sample.lost.tolist()
    assert all(slot.is_answered for slot in inputs.slots)


@pytest.mark.parametrize("pace", [["--lockstep"], ["--rate", "4"]])
def test_the_edge_s_nodes_answer_as_they_did(agv_ncs: AgvNcs, pace: list[str], tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    status, said = agv_ncs("replay", SAMPLE, *pace, "--compare", "--bag", tmp_path / "answers")
    assert status == 0, said
    assert "2000 slots played, 2000 errors and 2000 commands came back" in said
    assert said.count("2000 steps compared, equal (largest difference 0.0e+00)") == 2
    assert "everything that was published" in said
    before, after = read_bag(SAMPLE, ()), read_bag(tmp_path / "answers", ())
    loop = [topic for topic in before.topics if topic.startswith(("/agv/", "/edge/"))]
    assert not [topic for topic in loop if after.payloads(topic) != before.payloads(topic)]


def test_a_recorded_replay_is_a_whole_run(sample: Run, agv_ncs: AgvNcs, tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    answers = tmp_path / "answers"
    status, said = agv_ncs("replay", SAMPLE, "--lockstep", "--bag", answers, "--set", "controller.kx=5.0")
    assert status == 0, said
    run = read_run(answers)
    assert run.scenario.controller.kx == 5.0
    assert not run.unexplained
    assert run.notes == (
        f"a replay of {SAMPLE}: errors and commands are new, but the AGV moves as it did there, whatever they are",
    )
    for name in ("k", "pose", "error", "n_ul", "lost", "downlink_lost"):
        assert np.array_equal(getattr(run, name), getattr(sample, name)), name
    gain = sample.scenario.controller.kx
    apart = run.command[:, 0] - sample.command[:, 0] - (5.0 - gain) * sample.error[:, 0]
    assert np.abs(apart).max() < 1e-12
    assert not compare(run, run.scenario).differs
    status, said = agv_ncs("analyse", answers)
    assert status == 0, said


def test_another_gain_in_the_nodes_is_another_gain_in_the_functions(
    sample: Run, agv_ncs: AgvNcs, tmp_path: Path
) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    change = ("--compare", "--set", "controller.kx=5.0", "--json")
    assert agv_ncs("replay", SAMPLE, *change, tmp_path / "functions.json")[0] == 1
    assert agv_ncs("replay", SAMPLE, "--lockstep", *change, tmp_path / "nodes.json")[0] == 1
    functions, nodes = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("functions", "nodes"))
    assert nodes["error"]["first"] is None
    assert nodes["command"] == pytest.approx(functions["command"])


@pytest.mark.parametrize("policy", ["align", "predict"])
def test_policies_and_namespaces_on_dds(drive: Drive, policy: str, tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    from agv_analysis.runtime.replay_node import Pace
    from agv_analysis.runtime.runner import replay_in_process

    run = drive(f"error_detector.policy={policy}", "plant.duration=2.0", config="outages")
    inputs = read_inputs(Path(run.source), run.scenario.grid)._replace(namespace="robot7")
    outcome, errors, commands = replay_in_process(run.scenario, inputs, Pace(lockstep=True), None, lambda _: None)
    assert (outcome.failure, outcome.steps) == ("", 400)
    assert not compare_answers(*aligned_answers(run, inputs, errors, commands)).differs


def test_a_recording_that_begins_in_an_outage(sample: Run) -> None:
    """Its first slots name a pose that is not in it: no answer can be had, none is waited for."""
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    from agv_analysis.runtime.replay_node import Pace
    from agv_analysis.runtime.runner import replay_in_process

    first = int(np.flatnonzero(sample.lost)[0])
    whole = read_inputs(SAMPLE, sample.scenario.grid)
    rest = whole.slots[first : first + 300]
    slots = {slot.k: slot.slot for slot in rest}
    poses = {slot.k: slot.pose for slot in rest if slot.pose is not None}
    inputs = whole._replace(slots=tuple(inputs_of(slots, poses, sample.scenario.grid)))
    outage = int(np.flatnonzero(~sample.lost[first:])[0])
    assert [slot.is_answered for slot in inputs.slots] == [False] * outage + [True] * (300 - outage)
    outcome, errors, commands = replay_in_process(sample.scenario, inputs, Pace(lockstep=True), None, lambda _: None)
    assert outcome.failure == ""
    comparison = compare_answers(*aligned_answers(sample, inputs, errors, commands))
    assert not comparison.differs
    assert comparison.error.compared == 300 - outage < 300


@pytest.mark.parametrize("wait", [0, 3])
def test_nodes_that_run_elsewhere_answer_too(agv_ncs: AgvNcs, start: Start, wait: int, tmp_path: Path) -> None:
    """Whatever number of listeners they wait for, one replay after the other, with a recorder and without."""
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    for node in ("controller", "error_detector"):
        start(
            f"agv_cloud.{node}_node", "--ros-args", "--params-file", str(REPOSITORY / "config/outages.yaml"),
            "-p", "use_sim_time:=true", "-p", f"wait_for_subscribers:={wait}",
        )  # fmt: skip
    played = ("replay", SAMPLE, "--edge", "running", "--lockstep", "--compare")
    for options in ((), ("--bag", tmp_path / "answers")):
        status, said = agv_ncs(*played, *options)
        assert status == 0, said
        assert said.count("2000 steps compared, equal (largest difference 0.0e+00)") == 2
    assert read_run(tmp_path / "answers").unexplained == {}


@pytest.mark.parametrize("first", [0, 7])
def test_a_slot_is_answered_however_often_it_is_sent(first: int) -> None:
    """In whatever order the two topics bring it, and though the next slot follows as soon as there is one answer."""
    grid = Grid(1_000_000_000, 5_000_000)
    now, after = (StampedPose(grid.stamp(k), float(k), 0.0, 0.0) for k in (first, first + 1))
    poses, slots = [now, now, after], [Slot(pose.stamp_ns, pose.stamp_ns, DELIVERED) for pose in (now, now, after)]
    for places in itertools.combinations(range(6), 3):  # of the poses: each topic keeps its order
        pose, slot = iter(poses), iter(slots)
        sent = [next(pose) if i in places else next(slot) for i in range(6)]
        if min(sent.index(after), sent.index(slots[2])) < max(sent.index(now), sent.index(slots[0])):
            continue
        join: MessageSync[StampedPose] = MessageSync(grid.start_ns)
        answers: dict[int, StampedPose | None] = {}
        for message in (*sent, after, slots[2]):
            for found in join.add_slot(message) if isinstance(message, Slot) else join.add_message(message):
                assert answers.setdefault(grid.step(found.slot.stamp_ns), found.message) == found.message
        assert answers == {first: now, first + 1: after}, places


class Edge(NamedTuple):
    """The edge's two nodes on simulated time, each in a process of its own, and one that hears their commands."""

    node: Any
    spin_until: Callable[[Callable[[], bool]], None]
    answers: list[bytes]

    def await_answers(self) -> None:
        """See that the recorded commands come back, byte for byte."""
        wanted = read_bag(SAMPLE).payloads("/edge/cmd_vel")
        self.spin_until(lambda: len(self.answers) >= len(wanted))
        assert not {stamp_of(data) for data in wanted} - {stamp_of(data) for data in self.answers}
        assert not [stamp_of(data) for data, expected in zip(self.answers, wanted, strict=True) if data != expected]


@pytest.fixture
def edge(start: Start) -> Iterator[Edge]:
    rclpy = pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    from geometry_msgs.msg import TwistStamped
    from rclpy.executors import SingleThreadedExecutor

    params = REPOSITORY / "config/outages.yaml"
    for name in ("controller", "error_detector"):
        start(
            f"agv_cloud.{name}_node", "--ros-args", "--params-file", str(params), "-p", "use_sim_time:=true",
            "-p", "wait_for_subscribers:=1",  # else the error detector may answer before the controller hears it
        )  # fmt: skip
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("listener", context=context, use_global_arguments=False)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    answers: list[bytes] = []
    node.create_subscription(TwistStamped, "edge/cmd_vel", answers.append, 1000, raw=True)

    def spin_until(done: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 60.0
        while not done() and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.001)

    yield Edge(node, spin_until, answers)
    node.destroy_node()
    context.try_shutdown()


def test_what_ros2_bag_play_sends_is_answered_as_recorded(edge: Edge) -> None:
    """What `ros2 bag play --clock --topics /edge/pose /edge/slot` sends, with config/rosbag2_qos.yaml."""
    from geometry_msgs.msg import PoseStamped
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from rosgraph_msgs.msg import Clock
    from sensor_msgs.msg import TimeReference

    bag = read_bag(SAMPLE)
    overrides = yaml.safe_load(QOS.read_text())
    topics = {"/edge/pose": PoseStamped, "/edge/slot": TimeReference}
    outputs = {
        topic: edge.node.create_publisher(
            kind, topic, QoSProfile(depth=qos["depth"], reliability=ReliabilityPolicy[qos["reliability"].upper()])
        )
        for (topic, kind), qos in zip(topics.items(), map(overrides.get, topics), strict=True)
    }
    clock = edge.node.create_publisher(Clock, "/clock", 1)
    messages = sorted(
        (int(row["log_time_ns"]), topic, data)
        for topic in topics
        for row, data in zip(bag[topic], bag.payloads(topic), strict=True)
    )
    begun = messages[0][0]
    ticks = [(ns, "/clock", encode_clock(ns)) for ns in range(begun, messages[-1][0], 25_000_000)]  # 40 Hz
    outputs["/clock"] = clock
    edge.spin_until(
        lambda: (
            all(output.get_subscription_count() for output in outputs.values())
            and edge.node.count_publishers("/edge/cmd_vel") == 1
            and edge.node.count_subscribers("/edge/error") == 1
        )
    )
    started = time.monotonic_ns()
    for ns, topic, data in sorted([*messages, *ticks]):
        edge.spin_until(lambda: time.monotonic_ns() - started >= ns - begun)  # noqa: B023, which is over by the next
        outputs[topic].publish(data)
    edge.await_answers()


def test_ros2_bag_play_itself_is_answered_as_recorded(edge: Edge, start: Start) -> None:
    ros2 = shutil.which("ros2")
    if ros2 is None or importlib.util.find_spec("rosbag2_py") is None:
        pytest.skip("needs rosbag2, which is part of ROS 2 and not of its wheels")
    edge.spin_until(lambda: edge.node.count_subscribers("/edge/error") == 1)
    start(
        ros2, "bag", "play", str(SAMPLE), "--clock", "--topics", "/edge/pose", "/edge/slot",
        "--qos-profile-overrides-path", str(QOS), "--delay", "5", stdin=subprocess.DEVNULL,
    )  # fmt: skip
    edge.await_answers()


# -- driven again ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ros", [(), ("--ros",)])
def test_two_runs_in_one_table(agv_ncs: AgvNcs, tmp_path: Path, ros: tuple[str, ...]) -> None:
    if ros:
        pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    status, said = agv_ncs(
        "replay", SAMPLE, "--again", *ros, "--set", "controller.kx=5.0", "--json", tmp_path / "both.json"
    )
    assert status == 0, said
    assert "recorded" in said
    assert "again" in said
    found = json.loads((tmp_path / "both.json").read_text())
    for same in ("steps", "loss_rate", "outage_lengths", "n_ul_max"):
        assert found["recorded"][same] == found["again"][same]
    assert found["recorded"]["settle_2pct_steps"] != found["again"]["settle_2pct_steps"]


@pytest.mark.parametrize(
    "arguments",
    ["--lockstep --rate 2", "--again --compare", "--ros", "--edge running --set controller.kx=5.0", "--rate 0"],
)
def test_options_that_exclude_each_other(agv_ncs: AgvNcs, arguments: str) -> None:
    assert agv_ncs("replay", SAMPLE, *arguments.split())[0] == 2
