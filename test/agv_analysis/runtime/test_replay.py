"""Recordings played again: what the edge would answer, and outages for other runs."""

from __future__ import annotations

import dataclasses
import importlib.util
import itertools
import json
import math
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
from agv_analysis.runtime.replay import (
    compare,
    compare_answers,
    inputs_of,
    on_steps,
    read_inputs,
    with_outages_of,
    with_settings,
    write_outages,
)
from agv_analysis.scenario import SCHEMAS
from agv_analysis.simulation.single import simulate
from agv_plant.channels.trace import load_trace
from agv_ros.codec import encode_clock, stamp_of
from agv_ros.errors import UserError
from agv_ros.message_sync import MessageSync
from agv_ros.messages import DELIVERED, Slot, StampedPose
from agv_ros.stamps import Grid

if TYPE_CHECKING:
    from test.conftest import Drive, Start

REPOSITORY = Path(__file__).parents[3]
SAMPLE = REPOSITORY / "bags/sample"
QOS = REPOSITORY / "config/rosbag2_qos.yaml"
AgvNcs = Callable[..., tuple[int, str]]


@pytest.fixture(scope="module")
def sample() -> Run:
    return read_run(SAMPLE)


def without(run: Run, *rows: int) -> Run:
    """The run with some of its steps missing."""
    names = ("k", "pose", "reference", "error", "command", "n_ul", "lost", "downlink_lost")
    return dataclasses.replace(run, **{name: np.delete(getattr(run, name), rows, axis=0) for name in names})


# -- compare -----------------------------------------------------------------------------------------------------------


def test_an_unchanged_edge_answers_as_it_did(sample: Run) -> None:
    comparison = compare(sample, sample.scenario)
    assert not comparison.differs
    assert comparison.error.compared == comparison.command.compared == comparison.steps == len(sample)
    assert max(comparison.error.largest, comparison.command.largest) < 1e-12


@pytest.mark.parametrize(
    "settings",
    [
        ("controller.kx=250.0", "controller.v_max=6.0", "relay.uplink.model=burst", "relay.uplink.n=14"),
        ("relay.uplink.model=gilbert_elliott", "relay.uplink.p=0.1", "relay.uplink.r=0.2",
         "relay.downlink.model=bernoulli", "relay.downlink.p=0.3", "error_detector.track=eight"),
        ("plant.integration=arc", "plant.initial_pose=[0.0, 0.0, 20.0]"),
    ],
)  # fmt: skip
def test_the_nodes_answers_follow_from_poses_and_slots(settings: tuple[str, ...], drive: Drive) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    run = drive("plant.duration=2.0", *settings)
    comparison = compare(run, run.scenario)
    assert not comparison.differs, comparison
    assert comparison.command.compared == len(run) == 400


def test_another_gain_differs_by_its_share_of_the_command(sample: Run) -> None:
    """v = v_r cos(theta_e) + K_x x_e is linear in K_x."""
    assert sample.scenario.controller.v_max == math.inf
    gain = sample.scenario.controller.kx
    comparison = compare(sample, with_settings(sample.scenario, [f"controller.kx={gain + 2.0}"]))
    expected = np.abs(2.0 * sample.error[:, 0])
    assert comparison.error.first is None
    assert comparison.command.first == 0
    assert comparison.command.first_size == pytest.approx(expected[0], abs=1e-12)
    assert comparison.command.largest == pytest.approx(expected.max(), abs=1e-12)
    assert comparison.command.largest_at == np.argmax(expected)


def test_another_reference_differs_in_the_error(sample: Run) -> None:
    """A reference that begins 0.25 m further on along the heading of the AGV."""
    start = sample.scenario.error_detector.track_start
    moved = [start[0], start[1] + 0.25, start[2]]
    comparison = compare(sample, with_settings(sample.scenario, [f"error_detector.track_start={moved}"]))
    assert comparison.error.first == 0
    assert comparison.error.first_size == pytest.approx(0.25, abs=1e-9)


def test_the_first_difference_is_found(sample: Run) -> None:
    command = sample.command.copy()
    command[700:, 1] += 2e-9 * np.maximum(1.0, np.abs(command[700:]).max(axis=1))
    command[300, 0] += 1e-10
    comparison = compare(dataclasses.replace(sample, command=command), sample.scenario)
    assert (comparison.error.first, comparison.command.first) == (None, 700)


def test_an_answer_that_is_no_number_differs(sample: Run) -> None:
    pose = sample.pose.copy()
    pose[~sample.lost & (sample.k == 100)] = np.nan
    comparison = compare(dataclasses.replace(sample, pose=pose), sample.scenario)
    assert comparison.differs
    assert comparison.command.first_size == math.inf
    assert json.loads(json.dumps(comparison.to_json(), allow_nan=False))["command"]["first_size"] is None


def test_steps_without_the_held_pose_are_left_out(sample: Run) -> None:
    row = int(np.flatnonzero(sample.lost)[0]) - 1  # the pose that is held during the first outage
    outage = int(np.flatnonzero(~sample.lost[row + 1 :])[0])
    comparison = compare(without(sample, row), sample.scenario)
    assert not comparison.differs
    assert (comparison.steps, comparison.error.compared) == (len(sample) - 1, len(sample) - 1 - outage)


def test_nothing_to_compare_is_said(sample: Run) -> None:
    silent = dataclasses.replace(sample, command=np.full_like(sample.command, np.nan))
    with pytest.raises(UserError, match="nothing to compare, no step has both edge/cmd_vel"):
        compare(silent, sample.scenario)


def test_the_grid_is_the_recording_s(sample: Run) -> None:
    with pytest.raises(UserError, match="ts and start_time are those of the recording"):
        with_settings(sample.scenario, [f"{node}.ts=0.01" for node in SCHEMAS])


# -- outages -----------------------------------------------------------------------------------------------------------


def test_outages_of_a_recording_are_read_back(sample: Run, tmp_path: Path) -> None:
    assert write_outages(tmp_path / "lost.csv", sample) == sample.lost.sum() > 0
    assert load_trace(str(tmp_path / "lost.csv")) == tuple(sample.lost.tolist())


def test_recorded_outages_drive_a_run_with_other_gains(sample: Run, tmp_path: Path, drive: Drive) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    write_outages(tmp_path / "lost.csv", sample)
    trace = ("relay.uplink.model=trace", f"relay.uplink.trace_file={tmp_path / 'lost.csv'}")
    run = drive("plant.duration=5.0", "controller.kx=5.0", *trace)
    assert (run.lost == sample.lost[: len(run)]).all()
    assert np.abs(simulate(run.scenario).pose - run.pose).max() < 1e-9


def test_the_downlink_s_outages(tmp_path: Path, drive: Drive) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    run = drive("plant.duration=0.5", "relay.downlink.model=burst", "relay.downlink.n=3")
    write_outages(tmp_path / "lost.csv", run, downlink=True)
    assert load_trace(str(tmp_path / "lost.csv")) == (False, True, True, True) * 25


def test_missing_slots_are_refused(sample: Run, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="2 slots of edge/slot are missing"):
        write_outages(tmp_path / "lost.csv", without(sample, 5, 9))
    assert not (tmp_path / "lost.csv").exists()


def test_a_path_that_cannot_be_written(sample: Run, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot be written"):
        write_outages(tmp_path, sample)


# -- the command -------------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("policy", ["align", "predict"])
def test_an_edge_with_a_staleness_policy_gives_the_same_answers_again(drive: Drive, policy: str) -> None:
    run = drive(f"error_detector.policy={policy}", "plant.duration=2.0", "plant.speed_scale=1.05", config="outages")
    assert run.n_ul.max() > 3
    found = compare(run, run.scenario)
    assert found.error.first is None
    assert found.command.first is None


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
    assert not compare_answers(*on_steps(run, inputs, errors, commands)).differs


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
    comparison = compare_answers(*on_steps(sample, inputs, errors, commands))
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


def test_the_recorded_outages_and_gains_give_the_recorded_run(sample: Run, tmp_path: Path) -> None:
    again = simulate(with_outages_of(sample, sample.scenario, tmp_path))
    assert (again.lost == sample.lost).all()
    assert np.abs(again.pose - sample.pose).max() < 1e-9


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


def test_a_recording_without_its_beginning_is_not_driven_again(sample: Run, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="begins with step 3"):
        with_outages_of(without(sample, 0, 1, 2), sample.scenario, tmp_path)


@pytest.mark.parametrize(
    "arguments",
    ["--lockstep --rate 2", "--again --compare", "--ros", "--edge running --set controller.kx=5.0", "--rate 0"],
)
def test_options_that_exclude_each_other(agv_ncs: AgvNcs, arguments: str) -> None:
    assert agv_ncs("replay", SAMPLE, *arguments.split())[0] == 2
