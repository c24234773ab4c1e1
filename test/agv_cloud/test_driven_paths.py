"""A reference from nav_msgs/Path on real DDS: driven, replaced, refused, and known from the recording afterwards."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")

from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import TimeReference

from agv_analysis.recordings.recording import read_run
from agv_analysis.report.page import render
from agv_analysis.run import Run
from agv_analysis.runtime.edge_comparison import compare
from agv_analysis.runtime.one_process import OneProcess
from agv_analysis.runtime.parameters import RecorderParameters
from agv_analysis.runtime.recorder_node import RecorderNode
from agv_analysis.runtime.runner import NODES
from agv_analysis.scenario import load_scenario
from agv_analysis.stability.analysis import analyse
from agv_cloud.controller_node import ControllerNode
from agv_cloud.error_detector_node import ErrorDetectorNode
from agv_cloud.parameters import ErrorDetectorParameters
from agv_cloud.reference.reference import Reference
from agv_ros.errors import UserError
from agv_ros.executor import EXECUTORS, spin_for
from test.test_nodes import Bench, pose

if TYPE_CHECKING:
    AgvNcs = Callable[..., tuple[int, str]]

REPOSITORY = Path(__file__).parents[2]
PLANNER = QoSProfile(depth=1)
"""As Nav2's planner publishes: reliable, volatile. Source: nav2_planner, planner_server.cpp, `plan`."""
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

Points = Sequence[tuple[float, float]]


def path_of(points: Points, stamp: int = 0, frame: str = "map") -> PathMessage:
    path = PathMessage()
    path.header.frame_id, path.header.stamp.sec = frame, stamp
    for x, y in points:
        place = PoseStamped()
        place.header.frame_id = frame
        place.pose.position.x, place.pose.position.y, place.pose.orientation.w = x, y, 1.0
        path.poses.append(place)
    return path


@pytest.fixture
def bench() -> Iterator[Bench]:
    made = Bench("events")
    yield made
    made.close()


class Edge:
    """An error detector along paths, slot by slot, with a controller behind it."""

    def __init__(self, bench: Bench, latched: PathMessage | None = None, **parameters: Any) -> None:
        self.bench = bench
        self.paths = bench.probe.create_publisher(PathMessage, "edge/path", PLANNER if latched is None else LATCHED)
        if latched is not None:
            self.paths.publish(latched)
        self.detector = bench.add(ErrorDetectorNode, track="path", speed=2.0, **parameters)
        bench.add(ControllerNode)
        self.errors, self.commands = (
            bench.received(Odometry, "edge/error"),
            bench.received(TwistStamped, "edge/cmd_vel"),
        )
        self.references = bench.received(PoseStamped, "edge/reference_pose")
        self._poses = bench.publisher(PoseStamped, "edge/pose")
        self._slots = bench.publisher(TimeReference, "edge/slot")
        bench.until(lambda: self.paths.get_subscription_count() > 0)

    def step(self, k: int, x: float = 0.0, y: float = 0.0, lost_since: int | None = None) -> tuple[float, ...]:
        """Reference x, y and speed that the edge answers a slot with, and the speed that is commanded."""
        count, slot = len(self.errors), TimeReference()
        slot.header.stamp, slot.time_ref = (
            pose(k).header.stamp,
            pose(k if lost_since is None else lost_since).header.stamp,
        )
        slot.source = "delivered" if lost_since is None else "lost"
        if lost_since is None:
            self._poses.publish(pose(k, x, y))
        self._slots.publish(slot)
        for messages in (self.errors, self.commands, self.references):
            self.bench.until_count(messages, count + 1)
        place = self.references[-1].pose.position
        return place.x, place.y, self.errors[-1].twist.twist.linear.x, self.commands[-1].twist.linear.x

    def send(self, path: PathMessage, paths: int, refused: int = 0) -> None:
        """Publish a path and wait until it is taken or refused."""
        self.paths.publish(path)
        self.bench.until(lambda: (self.taken(), self.detector.rejected["edge/path"]) == (paths, refused))

    def taken(self) -> int:
        return int(self.detector.facts()["paths"])


def test_the_agv_stands_until_a_path_comes_and_follows_each_from_its_beginning(bench: Bench) -> None:
    edge = Edge(bench)
    assert [edge.step(k, 3.0, 4.0) for k in (0, 1)] == [(3.0, 4.0, 0.0, 0.0)] * 2
    edge.send(path_of([(3.0, 4.0), (5.0, 4.0)]), paths=1)
    assert edge.step(2, 3.0, 4.0)[:3] == pytest.approx((3.0, 4.0, 2.0))
    assert edge.step(3, 3.0, 4.0)[:3] == pytest.approx((3.01, 4.0, 2.0))
    assert edge.commands[-1].twist.linear.x == pytest.approx(2.0 + 25.0 * 0.01)
    edge.send(path_of([(3.0, 4.0), (3.0, 9.0)]), paths=2)
    assert edge.step(7, 3.0, 4.0)[:3] == pytest.approx((3.0, 4.0, 2.0))
    assert edge.step(10, 3.0, 4.0)[:3] == pytest.approx((3.0, 4.03, 2.0))
    for stamp in (5, 6):  # the planner plans again, and finds nothing new
        edge.paths.publish(path_of([(3.0, 4.0), (3.0, 9.0)], stamp))
    edge.send(path_of([]), paths=2, refused=1)
    assert edge.step(11, 3.0, 4.0)[:3] == pytest.approx((3.0, 4.04, 2.0))
    assert edge.step(2000, 3.0, 9.0) == pytest.approx((3.0, 9.0, 0.0, 0.0), abs=1e-12)


def test_a_bad_path_is_refused_and_the_old_one_holds(bench: Bench) -> None:
    edge = Edge(bench)
    good = [(0.0, 0.0), (9.0, 0.0)]
    edge.send(path_of(good), paths=1)
    assert edge.step(0)[:3] == pytest.approx((0.0, 0.0, 2.0))
    elsewhere = path_of([(1.0, 1.0), (2.0, 2.0)])
    elsewhere.poses[1].header.frame_id = "odom"
    bad = [
        path_of([(1.0, 1.0)] * 4), path_of([(1.0, 1.0), (math.nan, 2.0)]), path_of([(1.0, 1.0), (2.0, 2.0)], 0, "odom"),
        elsewhere,
    ]  # fmt: skip
    for count, path in enumerate(bad, 1):
        edge.send(path, paths=1, refused=count)
        assert edge.step(count)[:3] == pytest.approx((0.01 * count, 0.0, 2.0))
    edge.send(path_of([(0.0, 0.0), (0.0, 9.0)]), paths=2, refused=4)
    assert edge.step(5)[:3] == pytest.approx((0.0, 0.0, 2.0))


def test_what_was_latched_before_is_driven_too_and_replaced_once(bench: Bench) -> None:
    edge = Edge(bench, latched=path_of([(0.0, 0.0), (9.0, 0.0)]))
    bench.until(lambda: edge.taken() == 1)
    assert edge.step(0)[:3] == pytest.approx((0.0, 0.0, 2.0))
    edge.paths.publish(path_of([(0.0, 0.0), (0.0, 9.0)]))
    bench.until(lambda: edge.taken() == 2)
    edge.paths.publish(path_of([]))
    bench.until(lambda: edge.detector.rejected["edge/path"] > 0)
    assert edge.step(1)[:3] == pytest.approx((0.0, 0.0, 2.0))
    assert edge.step(2)[:3] == pytest.approx((0.0, 0.01, 2.0))
    assert edge.taken() == 2


def test_an_outdated_pose_is_aligned_with_the_path_of_its_instant(bench: Bench) -> None:
    edge = Edge(bench, policy="align")
    edge.send(path_of([(0.0, 0.0), (9.0, 0.0)]), paths=1)
    edge.step(0)
    edge.step(1, 0.007)
    edge.send(path_of([(0.5, 0.0), (0.5, 9.0)]), paths=2)
    assert edge.step(2, lost_since=1)[:3] == pytest.approx((0.5, 0.0, 2.0))
    error = edge.errors[-1].pose.pose.position
    assert (error.x, error.y) == pytest.approx((0.003, 0.0))


def test_a_run_that_begins_anew_begins_its_path_anew(bench: Bench) -> None:
    edge = Edge(bench)
    edge.send(path_of([(0.0, 0.0), (9.0, 0.0)]), paths=1)
    assert [edge.step(k)[0] for k in (0, 7, 0, 1)] == pytest.approx([0.0, 0.07, 0.0, 0.01])


def test_what_is_no_path_is_refused(bench: Bench) -> None:
    edge = Edge(bench)
    edge.paths.publish(b"\x00\x01\x00\x00" + b"\xff" * 60)
    bench.until(lambda: edge.detector.rejected["edge/path"] == 1)
    assert edge.step(0, 1.0) == (1.0, 0.0, 0.0, 0.0)


def test_an_edge_with_a_clock_of_its_own_drives_a_path_too(bench: Bench) -> None:
    edge = bench.add(
        ErrorDetectorNode, track="path", trigger="timer", begin="first_pose", ts=0.02, pose_type="odometry"
    )
    paths = bench.publisher(PathMessage, "edge/path")
    errors, references = bench.received(Odometry, "edge/error"), bench.received(PoseStamped, "edge/reference_pose")
    odometry, there = bench.publisher(Odometry, "edge/pose"), Odometry()
    there.header.stamp.sec, there.pose.pose.position.x, there.pose.pose.orientation.w = 1_700_000_000, 3.0, 1.0
    odometry.publish(there)
    bench.until(lambda: len(references) > 5)
    assert {(place.pose.position.x, place.pose.position.y) for place in references} == {(3.0, 0.0)}
    assert {error.twist.twist.linear.x for error in errors} == {0.0}
    paths.publish(path_of([(3.0, 0.0), (3.0, 1000.0)]))
    bench.until(lambda: errors[-1].twist.twist.linear.x == pytest.approx(1.0) and references[-1].pose.position.y > 0.1)
    assert references[-1].pose.position.x == pytest.approx(3.0)
    assert edge.facts()["paths"] == "1"


# -- whole runs -------------------------------------------------------------------------------------------------------


SETTINGS = (
    "error_detector.track=path", "error_detector.speed=0.8", "plant.duration=8.0", "plant.initial_pose=[0.0, 0.1, 0.0]",
)  # fmt: skip


def drive_along(points: Points, bag: Path, *settings: str) -> Run:
    """Run on DDS along a path that is there from the first step on, recorded."""
    scenario = load_scenario(str(REPOSITORY / "config/outages.yaml"), (*SETTINGS, *settings))
    params = bag.with_suffix(".yaml")
    params.write_text(scenario.to_yaml())
    with OneProcess() as process:
        executor = EXECUTORS["events"](context=process.context)

        def add(kind: Any, settings: Any) -> Any:
            node = process.add(kind, dataclasses.replace(settings, wait_for_subscribers=2))
            executor.add_node(node)
            return node

        detector = add(NODES["error_detector"], scenario.error_detector)
        planner = rclpy.create_node("planner", context=process.context, use_global_arguments=False)
        paths = planner.create_publisher(PathMessage, "edge/path", LATCHED)
        paths.publish(path_of(points))
        assert spin_for(executor, lambda: detector.facts()["paths"] == "1", 60.0)
        others = [add(NODES[name], getattr(scenario, name)) for name in ("controller", "relay")]
        recorder = add(RecorderNode, RecorderParameters(bag=str(bag), params_file=str(params)))
        plant = add(NODES["plant"], scenario.plant)
        assert spin_for(executor, lambda: plant.finished, 120.0)
        assert plant.failure == ""
        for node in (plant, *others, detector):
            node.close()
        assert spin_for(executor, recorder.is_settled, 60.0)
        recorder.close()
        assert recorder.failure == ""
        executor.shutdown()
        planner.destroy_node()
    return read_run(bag)


def circle(r: float, m: int) -> Points:
    return [(r * math.sin(2.0 * math.pi * i / m), r * (1.0 - math.cos(2.0 * math.pi * i / m))) for i in range(m + 1)]


@pytest.mark.parametrize("policy", ["hold", "align", "predict"])
def test_a_circle_is_driven_as_the_same_one_from_a_file(policy: str, tmp_path: Path) -> None:
    """Once on the arc, both are the plant's recursion from one posture with the same constant speeds."""
    r, m, speed = 1.5, 90, 0.8
    run = drive_along(circle(r, m), tmp_path / "bag", f"error_detector.policy={policy}")
    assert len(run) == 1600
    assert [note for note in run.notes if "edge/reference_pose" in note or "not in the recording" in note] == []
    first = math.ceil(r * math.sin(math.pi / m) / (speed * run.ts))
    v, w = (float(run.reference[first, column]) for column in (3, 4))
    assert w == pytest.approx(speed / (r * math.cos(math.pi / m)), rel=1e-9)
    (tmp_path / "arc.csv").write_text(f"t,v,w\n0.0,{v!r},{w!r}\n20.0,{v!r},{w!r}\n")
    begin = tuple(run.reference[first, :3].tolist())
    file = ErrorDetectorParameters(track="csv", track_file=str(tmp_path / "arc.csv"), track_start=begin)
    expected = Reference(file).first(len(run) - first)
    np.testing.assert_allclose(run.reference[first:], expected, rtol=0.0, atol=1e-9)
    assert np.hypot(*(run.reference[-1, :2] - run.pose[-1, :2])) < (0.2 if policy == "hold" else 0.02)
    found = compare(run, run.scenario)
    assert not found.differs
    assert found.error.compared > 1500


def test_a_recording_along_a_path_is_analysed_by_the_recorded_reference(tmp_path: Path, agv_ncs: AgvNcs) -> None:
    bag = tmp_path / "bag"
    run = drive_along([(0.0, 0.0), (2.0, 0.0)], bag, "relay.uplink.p=0.0")
    k = np.arange(len(run))
    line = np.minimum(0.8 * 0.005 * k, 2.0)
    np.testing.assert_allclose(run.reference[:, :3], np.column_stack([line, 0.0 * k, 0.0 * k]), atol=1e-12)
    np.testing.assert_array_equal(run.reference[500:, 3:], 0.0)
    analysis = analyse(run)
    assert run.pose[-1, 0] == pytest.approx(2.0, abs=0.01)  # where the path ends
    assert analysis.convergence.y.final < 0.1
    assert "not computed: error_detector.track is path" in render(analysis)
    status, said = agv_ncs("analyse", bag)
    assert (status, "Traceback" in said) == (0, False), said[-500:]
    status, said = agv_ncs("replay", bag, "--lockstep")
    assert status == 1
    assert said.splitlines()[-1].endswith("only --compare works, with the recorded reference")


def test_a_recording_without_its_reference_cannot_be_analysed(tmp_path: Path) -> None:
    params = tmp_path / "params.yaml"
    params.write_text(load_scenario(str(REPOSITORY / "config/paper.yaml"), ["error_detector.track=path"]).to_yaml())
    with pytest.raises(UserError, match="nothing of it is on edge/reference_pose"):
        read_run(REPOSITORY / "bags/sample", params)


@pytest.mark.parametrize(
    "command",
    [("simulate",), ("stability",), ("sweep", "--vary", "controller.kx=5,25"), ("stability", "--map", "kx,ts")],
)
def test_nothing_is_worked_out_along_a_path_that_nobody_knows_yet(command: tuple[str, ...], agv_ncs: AgvNcs) -> None:
    name, *options = command
    status, said = agv_ncs(name, "config/paper.yaml", "--set", "error_detector.track=path", *options)
    assert status == 1, said[-300:]
    assert "error_detector.track is path: the reference comes on edge/path" in said.splitlines()[-1], said[-300:]
    assert "Traceback" not in said
