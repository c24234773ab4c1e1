"""Recordings of other robots, written with rosbags from a simulated run whose truth is known."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from agv_analysis.metrics.convergence import wrapped
from agv_analysis.recordings.other_robots import read_robot_run
from agv_analysis.recordings.recording import read_run
from agv_analysis.recordings.robot_topics import RobotTopics, read_topics
from agv_analysis.run import Run
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.stability.analysis import analyse, observe
from agv_ros.errors import UserError

REPOSITORY = Path(__file__).parents[3]
STORE = get_typestore(Stores.ROS2_JAZZY)
START, TS = 1_700_000_000_250_000_000, 20_000_000  # [ns]
LATENCY = 3_000_000
"""From a pose's stamp to its log time [ns]; the clock of the log is another one, an hour ahead."""
LOG = LATENCY + 3_600_000_000_000

PAPER = str(REPOSITORY / "config/paper.yaml")
SETTINGS = (
    "plant.ts=0.02", "plant.duration=8.0", "controller.kx=5.0", "relay.uplink.model=bernoulli", "relay.uplink.p=0.2",
    "plant.initial_pose=[0.5, 1.0, 1.5]",
)  # fmt: skip
ALL = RobotTopics("/odom", "/cmd_vel", "/plan")


def make(kind: str, **fields: Any) -> Any:
    return STORE.types[kind](**fields)


def header(stamp: int, frame: str = "odom") -> Any:
    time = make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
    return make("std_msgs/msg/Header", stamp=time, frame_id=frame)


def vector(x: float, y: float, z: float = 0.0) -> Any:
    return make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def twist(v: float, w: float) -> Any:
    return make("geometry_msgs/msg/Twist", linear=vector(v, 0.0), angular=vector(0.0, 0.0, w))


def posture(x: float, y: float, theta: float) -> Any:
    q = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=np.sin(theta / 2), w=np.cos(theta / 2))
    return make("geometry_msgs/msg/Pose", position=make("geometry_msgs/msg/Point", x=x, y=y, z=0.0), orientation=q)


def odometry(stamp: int, pose: Any, v: float = 0.0, w: float = 0.0, frame: str = "odom") -> Any:
    covariance = np.zeros(36)
    return make(
        "nav_msgs/msg/Odometry",
        header=header(stamp, frame),
        child_frame_id="base_link",
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance),
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist(v, w), covariance=covariance),
    )


def with_covariance(stamp: int, pose: Any) -> Any:
    inner = make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36))
    return make("geometry_msgs/msg/PoseWithCovarianceStamped", header=header(stamp), pose=inner)


def stamped(stamp: int, pose: Any, frame: str = "odom") -> Any:
    return make("geometry_msgs/msg/PoseStamped", header=header(stamp, frame), pose=pose)


def twist_stamped(stamp: int, v: float, w: float) -> Any:
    return make("geometry_msgs/msg/TwistStamped", header=header(stamp), twist=twist(v, w))


def unstamped(stamp: int, v: float, w: float) -> Any:
    return twist(v, w)


def path_of(truth: Run, steps: range, times: bool = True) -> Any:
    poses = [stamped(START + k * TS if times else 0, posture(*truth.reference[k, :3])) for k in steps]
    return make("nav_msgs/msg/Path", header=header(START), poses=poses)


class Recording:
    """Messages of a bag: (topic, log time, message)."""

    def __init__(self) -> None:
        self.messages: list[tuple[str, int, Any]] = []

    def add(self, topic: str, log_time: int, message: Any) -> None:
        self.messages.append((topic, log_time, message))

    def write(self, path: Path, plugin: StoragePlugin = StoragePlugin.MCAP) -> Path:
        with Writer(path, version=9, storage_plugin=plugin) as writer:
            connections: dict[str, Any] = {}
            for topic, log_time, message in sorted(self.messages, key=lambda entry: entry[1]):
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
                writer.write(connections[topic], log_time, STORE.serialize_cdr(message, kind))
        return path


@pytest.fixture(scope="module")
def truth() -> Run:
    run = simulate(load_scenario(PAPER, SETTINGS))
    assert not run.lost[0]
    assert run.lost.any()
    return run


Make = Callable[..., Any]


def recording(
    truth: Run, pose: Make = odometry, command: Make = unstamped, reference: str = "path", jitter: int = 0
) -> Recording:
    """What was received of the run, by a robot of these types, with other topics in the way."""
    made, shifts = Recording(), np.random.default_rng(1).integers(-jitter, jitter + 1, len(truth))
    text = make("std_msgs/msg/String", data="hello")
    transform = make("geometry_msgs/msg/Transform", translation=vector(1.0, 2.0), rotation=posture(0, 0, 0).orientation)
    for k, received in enumerate(~truth.lost):
        stamp = START + k * TS + (int(shifts[k]) if k else 0)
        made.add("/chatter", stamp + LOG, text)
        one = make("geometry_msgs/msg/TransformStamped", header=header(stamp), child_frame_id="base_link",
                   transform=transform)  # fmt: skip
        made.add("/tf", stamp + LOG, make("tf2_msgs/msg/TFMessage", transforms=[one] * (k % 3)))
        if received:
            made.add("/odom", stamp + LOG, pose(stamp, posture(*truth.pose[k])))
        made.add("/cmd_vel", stamp + LOG + 2_000_000, command(stamp + 2_000_000, *truth.command[k]))
        if reference == "odometry":
            x, y, theta, v, w = truth.reference[k]
            made.add("/plan", stamp + LOG - LATENCY, odometry(START + k * TS, posture(x, y, theta), v, w))
    if reference == "path":
        made.add("/plan", START, path_of(truth, range(len(truth))))
    return made


def assert_is_the_truth(run: Run, truth: Run, tolerance: float = 1e-9) -> None:
    """As far as the last pose that came."""
    n = int(np.flatnonzero(~truth.lost)[-1]) + 1
    assert len(run) == n
    np.testing.assert_array_equal(run.lost, truth.lost[:n])
    np.testing.assert_array_equal(run.n_ul, truth.n_ul[:n])
    came = ~run.lost
    np.testing.assert_allclose(run.pose[came, :2], truth.pose[:n][came, :2], rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(wrapped(run.pose[came, 2] - truth.pose[:n][came, 2]), 0.0, atol=tolerance)
    np.testing.assert_allclose(run.command[came], truth.command[:n][came], rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(run.reference[:, :2], truth.reference[:n, :2], rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(wrapped(run.reference[:, 2] - truth.reference[:n, 2]), 0.0, atol=tolerance)


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("pose", [odometry, with_covariance, stamped])
@pytest.mark.parametrize("command", [unstamped, twist_stamped])
def test_the_run_comes_back_whatever_the_types(
    tmp_path: Path, truth: Run, plugin: StoragePlugin, pose: Make, command: Make
) -> None:
    run = read_robot_run(recording(truth, pose, command).write(tmp_path / "bag", plugin), ALL)
    assert run.ts == pytest.approx(0.02, abs=1e-15)
    assert not run.gains_known
    assert_is_the_truth(run, truth)


def test_our_own_recording_tells_the_same_without_its_slots(tmp_path: Path) -> None:
    """What arrived at the edge, and when, is enough for the outages; the slots, which say them, are not read."""
    expected, config = read_run(REPOSITORY / "bags/sample"), tmp_path / "params.yaml"
    config.write_text(expected.scenario.to_yaml())
    topics = RobotTopics("/edge/pose", "/edge/cmd_vel")
    run = read_robot_run(REPOSITORY / "bags/sample", topics, None, config)
    for name in ("k", "lost", "n_ul", "command", "reference"):
        np.testing.assert_array_equal(getattr(run, name), getattr(expected, name)[: len(run)])
    np.testing.assert_allclose(run.pose[~run.lost], expected.pose[~run.lost], rtol=0.0, atol=1e-12)


def test_lost_poses_lie_between_those_that_came(tmp_path: Path, truth: Run) -> None:
    run = read_robot_run(recording(truth).write(tmp_path / "bag"), ALL)
    k = int(np.flatnonzero(run.lost & ~np.roll(run.lost, 1) & ~np.roll(run.lost, -1))[0])
    np.testing.assert_allclose(run.pose[k], (run.pose[k - 1] + run.pose[k + 1]) / 2, atol=1e-12)
    assert any("count as lost" in note for note in run.notes)


def test_speeds_of_a_path_are_those_that_drew_it(tmp_path: Path, truth: Run) -> None:
    """The reference is an Euler recursion, of which the differences are exactly the speeds."""
    run = read_robot_run(recording(truth).write(tmp_path / "bag"), ALL)
    np.testing.assert_allclose(run.reference[:-1, 3:], truth.reference[: len(run) - 1, 3:], rtol=0.0, atol=1e-9)


def test_reference_from_odometry(tmp_path: Path, truth: Run) -> None:
    run = read_robot_run(recording(truth, reference="odometry").write(tmp_path / "bag"), ALL)
    assert_is_the_truth(run, truth)
    np.testing.assert_allclose(run.reference[:, 3:], truth.reference[: len(run), 3:], rtol=0.0, atol=1e-12)


def test_a_plan_is_followed_until_the_next_one_begins(tmp_path: Path, truth: Run) -> None:
    made, wrong = recording(truth, reference="none"), truth.reference.copy()
    wrong[200:, :2] += 7.0
    stale = path_of(truth, range(200))
    stale.poses.extend(stamped(START + k * TS, posture(*wrong[k, :3])) for k in range(200, len(truth)))
    made.add("/plan", START, stale)
    made.add("/plan", START + 200 * TS, path_of(truth, range(200, len(truth))))
    made.add("/plan", START + 201 * TS, make("nav_msgs/msg/Path", header=header(START), poses=[]))
    assert_is_the_truth(read_robot_run(made.write(tmp_path / "bag"), ALL), truth)


def driven(poses: Any, *plans: tuple[int, Any]) -> Recording:
    """Poses (x, y, theta) one period apart, and plans (step, points) whose poses have no times."""
    made = Recording()
    for k, pose in enumerate(poses):
        made.add("/odom", START + k * TS + LOG, odometry(START + k * TS, posture(*pose)))
    for k, points in plans:
        places = [stamped(0, posture(x, y, 0.0)) for x, y in points]
        made.add("/plan", START + k * TS + LOG, make("nav_msgs/msg/Path", header=header(START + k * TS), poses=places))
    return made


def test_of_a_plan_without_times_the_nearest_point_counts(tmp_path: Path) -> None:
    x = np.linspace(0.5, 8.5, 401)  # 1 m/s
    poses = np.column_stack([x, 0.3 * np.cos(x), np.zeros(401)])
    made = driven(poses, (0, [(0.0, 0.0), (0.0, 0.0), (4.0, 0.0), (10.0, 0.0)]), (300, [(0.0, 1.0), (10.0, 1.0)]))
    run = read_robot_run(made.write(tmp_path / "bag"), RobotTopics("/odom", None, "/plan"))
    y = np.where(np.arange(401) < 300, 0.0, 1.0)
    np.testing.assert_allclose(run.reference[:, :3], np.column_stack([x, y, np.zeros(401)]), atol=1e-12)
    np.testing.assert_allclose(run.reference[:, 3:], np.tile([1.0, 0.0], (401, 1)), atol=1e-9)
    assert any("errors are those across the path" in note for note in run.notes)


def test_where_a_path_crosses_itself_the_nearest_point_keeps_to_its_branch(tmp_path: Path) -> None:
    t = np.linspace(0.0, 2.0 * np.pi, 1001)
    poses = np.column_stack(
        [5.0 * np.sin(t), 2.5 * np.sin(2.0 * t), np.arctan2(5.0 * np.cos(2.0 * t), 5.0 * np.cos(t))]
    )
    run = read_robot_run(
        driven(poses, (0, poses[::5, :2])).write(tmp_path / "bag"), RobotTopics("/odom", None, "/plan")
    )
    np.testing.assert_allclose(run.reference[:, :2], poses[:, :2], atol=0.01)
    np.testing.assert_allclose(wrapped(run.reference[:, 2] - poses[:, 2]), 0.0, atol=0.03)


@settings(deadline=None, derandomize=True, max_examples=15)
@given(lost=st.lists(st.booleans(), min_size=30, max_size=120), seed=st.integers(0, 2**32 - 1))
def test_every_loss_is_found_from_the_stamps(
    tmp_path_factory: pytest.TempPathFactory, lost: list[bool], seed: int
) -> None:
    """With up to half of the poses lost, and stamps that are up to a tenth of a period early or late."""
    kept = [k for k in range(len(lost)) if not lost[k] or k % 4 < 2]
    jitter = np.random.default_rng(seed).integers(-TS // 10, TS // 10, len(lost), endpoint=True)
    made = Recording()
    for k in kept:
        stamp = START + k * TS + int(jitter[k])
        made.add("/odom", stamp + LOG, odometry(stamp, posture(0.1 * k, 0.0, 0.0)))
    plan = [stamped(0, posture(x, 0.0, 0.0)) for x in (0.0, 100.0)]
    made.add("/plan", START, make("nav_msgs/msg/Path", header=header(START - 10 * TS), poses=plan))
    bag = made.write(tmp_path_factory.mktemp("jitter") / "bag")
    run = read_robot_run(bag, RobotTopics("/odom", None, "/plan"))
    assert np.flatnonzero(~run.lost).tolist() == [k - kept[0] for k in kept]
    assert run.ts == pytest.approx(TS * 1e-9, rel=0.2 / (len(run) - 1) + 1e-9)


def track_file(path: Path, truth: Run) -> Path:
    rows = [f"{k * truth.ts!r},{v!r},{w!r}" for k, (v, w) in enumerate(truth.reference[:, 3:].tolist())]
    path.write_text("\n".join(["t,v,w", *rows]) + "\n")
    return path


def test_reference_from_a_track_file(tmp_path: Path, truth: Run) -> None:
    bag, track = recording(truth, reference="none").write(tmp_path / "bag"), track_file(tmp_path / "track.csv", truth)
    topics = ALL._replace(reference=None)
    run = read_robot_run(bag, topics, track)
    np.testing.assert_allclose(run.reference[0, :3], truth.pose[0])  # nobody says where the track begins
    config = tmp_path / "params.yaml"
    config.write_text(truth.scenario.to_yaml())
    assert_is_the_truth(read_robot_run(bag, topics, track, config), truth)
    assert_is_the_truth(read_robot_run(bag, topics, None, config), truth, 1e-8)


def transform(stamp: int, parent: str, child: str, x: float, y: float, theta: float) -> Any:
    where = make("geometry_msgs/msg/Transform", translation=vector(x, y), rotation=posture(0, 0, theta).orientation)
    one = make(
        "geometry_msgs/msg/TransformStamped", header=header(stamp, parent), child_frame_id=child, transform=where
    )
    return make("tf2_msgs/msg/TFMessage", transforms=[one])


def test_the_pose_from_transforms_is_that_of_odometry(tmp_path: Path, truth: Run) -> None:
    """The truth as base_link in odom, which lies turned and moved in map; and a laser that is fixed to the robot."""
    made = recording(truth)
    made.messages = [entry for entry in made.messages if entry[0] != "/tf"]
    map_to_odom, cos, sin = (3.0, -1.0, 0.7), np.cos(0.7), np.sin(0.7)
    made.add("/tf_static", START - 1, transform(START - 1, "base_link", "laser", 0.2, 0.0, 0.1))
    for k, received in enumerate(~truth.lost):
        stamp = START + k * TS
        if k % 10 == 0:
            made.add("/tf", stamp + LOG - 1, transform(stamp, "map", "odom", *map_to_odom))
        if received:
            made.add("/tf", stamp + LOG, transform(stamp, "odom", "base_link", *truth.pose[k]))
    bag = made.write(tmp_path / "bag")
    topics = ALL._replace(pose="/tf")
    assert_is_the_truth(read_robot_run(bag, topics, pose_frames=("odom", "base_link")), truth)
    run, laser = (read_robot_run(bag, topics, pose_frames=("map", frame)) for frame in ("base_link", "laser"))
    came, n = ~run.lost, len(run)
    x, y, theta = truth.pose[:n].T
    expected = np.column_stack([3.0 + cos * x - sin * y, -1.0 + sin * x + cos * y])
    np.testing.assert_allclose(run.pose[came, :2], expected[came], atol=1e-9)
    np.testing.assert_allclose(wrapped(run.pose[came, 2] - theta[came] - 0.7), 0.0, atol=1e-9)
    ahead = 0.2 * np.column_stack([np.cos(run.pose[:, 2]), np.sin(run.pose[:, 2])])
    np.testing.assert_allclose(laser.pose[came, :2], (run.pose[:, :2] + ahead)[came], atol=1e-9)
    with pytest.raises(UserError, match="camera has no parent on the way up to map; there are base_link to laser"):
        read_robot_run(bag, topics, pose_frames=("map", "camera"))
    with pytest.raises(UserError, match="--pose-frames map base_link"):
        read_robot_run(bag, topics)


def test_a_track_file_that_is_shorter_ends_the_run(tmp_path: Path, truth: Run) -> None:
    bag, track = recording(truth, reference="none").write(tmp_path / "bag"), track_file(tmp_path / "track.csv", truth)
    rows = track.read_text().splitlines()
    track.write_text("\n".join(rows[:202]) + "\n")  # the header and steps 0 to 200
    run = read_robot_run(bag, ALL._replace(reference=None), track)
    assert run.k[-1] <= 200
    (note,) = (note for note in run.notes if "after the end of the track file" in note)
    after = np.count_nonzero(~truth.lost[201:])
    assert note == f"/odom: {after} poses came after the end of the track file, they are left out"


ACKERMANN = """std_msgs/Header header
AckermannDrive drive
================================================================================
MSG: ackermann_msgs/AckermannDrive
float32 steering_angle
float32 steering_angle_velocity
float32 speed
float32 acceleration
float32 jerk
"""


def test_a_car_s_commands_turn_it_by_its_wheelbase(tmp_path: Path, truth: Run) -> None:
    STORE.register(get_types_from_msg(ACKERMANN, "ackermann_msgs/msg/AckermannDriveStamped"))
    wheelbase = 1.3

    def steered(stamp: int, v: float, w: float) -> Any:
        angle = float(np.arctan2(wheelbase * w, v)) if v > 0.0 else -float(np.arctan2(wheelbase * w, -v))
        drive = make(
            "ackermann_msgs/msg/AckermannDrive", steering_angle=angle, steering_angle_velocity=0.0, speed=v,
            acceleration=0.0, jerk=0.0,
        )  # fmt: skip
        return make("ackermann_msgs/msg/AckermannDriveStamped", header=header(stamp), drive=drive)

    bag = recording(truth, command=steered).write(tmp_path / "bag")
    with pytest.raises(UserError, match=r"plant\.bicycle\.wheelbase with --config"):
        read_robot_run(bag, ALL)
    config = tmp_path / "params.yaml"
    config.write_text(truth.scenario.with_settings([f"plant.bicycle.wheelbase={wheelbase}"]).to_yaml(of_all_parts=True))
    run, plain = read_robot_run(bag, ALL, None, config), read_robot_run(recording(truth).write(tmp_path / "plain"), ALL)
    np.testing.assert_allclose(run.command, plain.command, atol=1e-4)


def test_jitter_is_measured_and_loses_nothing(tmp_path: Path, truth: Run) -> None:
    run = read_robot_run(recording(truth, jitter=4_000_000).write(tmp_path / "bag"), ALL)
    n = len(run)
    assert run.ts * (n - 1) == pytest.approx(0.02 * (n - 1), abs=0.008)  # at either end 4 ms at most
    np.testing.assert_array_equal(run.lost, truth.lost[:n])
    assert any("jitter 3." in note for note in run.notes)  # uniform on 8 ms, twice: 8 ms / sqrt(6) = 3.3 ms


def test_stamps_that_repeat_or_go_backwards_are_counted(tmp_path: Path, truth: Run) -> None:
    made = recording(truth)
    received = [int(k) for k in np.flatnonzero(~truth.lost)]
    again, late = [START + k * TS for k in received[10:13]], [START + k * TS for k in received[20:25]]
    for stamp in again:
        made.add("/odom", stamp + LOG + 1, odometry(stamp, posture(99.0, 99.0, 0.0)))
    for stamp in late:
        made.add("/odom", stamp + LOG + 1, odometry(stamp - TS // 3, posture(99.0, 99.0, 0.0)))
    made.add("/odom", START + LOG + 1, odometry(START + 1, posture(np.nan, 0.0, 0.0)))
    run = read_robot_run(made.write(tmp_path / "bag"), ALL)
    assert "/odom: 3 stamps repeat the one before, their messages are left out" in run.notes
    assert "/odom: 5 stamps go backwards, their messages are left out" in run.notes
    assert "/odom: 1 poses are not finite or have no orientation, their messages are left out" in run.notes
    assert_is_the_truth(run, truth)


def test_without_gains_nothing_is_said_of_stability(tmp_path: Path, truth: Run) -> None:
    bag = recording(truth).write(tmp_path / "bag")
    run = read_robot_run(bag, ALL)
    found = observe(run).to_json()
    assert found["loss_rate"] == pytest.approx(np.mean(truth.lost[: len(run)]))
    assert [found[name] for name in ("paper_stable", "bursts_stable", "mean_square_stable", "verdict")] == [None] * 4
    assert "--config" in found["no_verdict_because"]
    with pytest.raises(UserError, match="gains are not known"):
        analyse(run)


def test_with_gains_the_verdict_is_that_of_the_simulated_run(tmp_path: Path, truth: Run) -> None:
    bag, config = recording(truth).write(tmp_path / "bag"), tmp_path / "params.yaml"
    config.write_text(truth.scenario.to_yaml())
    found, expected = analyse(read_robot_run(bag, ALL, None, config)).to_json(), analyse(truth).to_json()
    assert found["verdict"] == expected["verdict"]
    assert found["no_verdict_because"] is None
    assert found["lifted_radius"] == pytest.approx(expected["lifted_radius"], rel=1e-6)
    assert found["seed"] is None, "the seed of a params file has not drawn the losses of a real radio"
    assert set(found) == set(expected) == set(observe(truth).to_json())


def test_what_does_not_fit_is_said(tmp_path: Path, truth: Run) -> None:
    made = recording(truth, reference="none")
    made.add("/plan", START, path_of(truth, range(1), times=False))
    made.add("/map_plan", START, odometry(START, posture(0, 0, 0), frame="map"))
    made.add("/map_plan", START + 1, odometry(START + 100 * TS, posture(0, 0, 0), frame="map"))
    made.add("/empty", START, path_of(truth, range(0)))
    made.add("/early", START, odometry(1, posture(0, 0, 0)))
    bag = made.write(tmp_path / "bag")
    for topics, message in (
        (ALL, "no path of at least two finite points"),
        (ALL._replace(reference="/empty"), "no path of at least two finite points"),
        (ALL._replace(reference="/early"), "no instant in common"),
        (ALL._replace(pose="/nothing"), "no topic /nothing for the pose; it has .*/odom"),
        (ALL._replace(pose="/chatter"), "is of type std_msgs/msg/String; a pose must be one of"),
        (RobotTopics("/odom", "/odom", "/map_plan"), "a command must be one of geometry_msgs/msg/Twist, "),
        (ALL._replace(reference=None), "no reference: name"),
    ):
        with pytest.raises(UserError, match=message):
            read_robot_run(bag, topics)
    run = read_robot_run(bag, ALL._replace(reference="/map_plan"))
    assert any("'odom', /map_plan in frame 'map'" in note for note in run.notes)
    assert any("poses lie before or after the reference" in note for note in run.notes)
    assert len(run) <= 101


def test_a_wild_stamp_asks_for_no_memory(tmp_path: Path, truth: Run) -> None:
    made = recording(truth, reference="odometry")
    made.add("/odom", START + LOG + 10**12, odometry(START + 4 * 10**8 * 10**9, posture(0, 0, 0)))
    made.add("/plan", START + LOG + 10**12, odometry(START + 4 * 10**8 * 10**9, posture(0, 0, 0)))
    with pytest.raises(UserError, match=r"a gap of .* s is \d+ periods of 0.02 s, .* by one clock"):
        read_robot_run(made.write(tmp_path / "bag"), ALL)


def test_topics_from_a_file(tmp_path: Path) -> None:
    file = tmp_path / "topics.yaml"
    file.write_text("pose: /odom\ncommand: /cmd_vel\n")
    assert read_topics(file, None, "/other", None) == RobotTopics("/odom", "/other", None)
    file.write_text("poses: /odom\n")
    with pytest.raises(UserError, match="found 'poses': '/odom'; allowed are pose, command, reference"):
        read_topics(file, None, None, None)
    with pytest.raises(UserError, match="--pose-topic"):
        read_topics(None, None, "/cmd_vel", None)


def test_command_line(tmp_path: Path, truth: Run, agv_ncs: Callable[..., tuple[int, str]]) -> None:
    bag, report = recording(truth).write(tmp_path / "bag"), tmp_path / "report.json"
    names = ("--pose-topic", "/odom", "--command-topic", "/cmd_vel", "--reference-topic", "/plan")
    status, output = agv_ncs("analyse", bag, *names, "--json", report)
    assert status == 0, output
    assert "not judged" in output
    assert "20 ms" in output
    assert json.loads(report.read_text())["verdict"] is None
    status, output = agv_ncs("analyse", bag, "--pose-topic", "/nothing", "--reference-topic", "/plan")
    assert status == 1
    assert "no topic /nothing" in output
    status, output = agv_ncs("analyse", bag, *names, "--namespace", "robot1")
    assert status == 2
    assert "topics are named in full" in output


def as_gazebo_records(path: Path, plugin: StoragePlugin, sent: int, lost: set[int]) -> Path:
    """A TurtleBot3 in Gazebo: odometry at 30 Hz on whole milliseconds of a slow simulated clock, logged by the wall's.

    Infinite ranges, texts of any length, transforms of many frames, a command without stamp at a third of the rate.
    """
    made, random_numbers, begun = Recording(), np.random.default_rng(3), 1_750_000_000_000_000_000
    covariance = np.diag([1e-5, 1e-5, 1e12, 1e12, 1e12, 1e-3]).ravel()
    for k in range(sent):
        stamp = round((12.345 + k / 30.0) * 1e3) * 1_000_000
        log, pose = (
            begun + int(stamp / 0.97) + int(random_numbers.integers(4_000_000)),
            posture(0.2 * k / 30.0, 0.1, 0.0),
        )
        if k not in lost:
            message = odometry(stamp, pose, 0.2)
            message.pose.covariance[:] = covariance
            made.add("/odom", log, message)
        if k % 3 == 0:
            made.add("/cmd_vel", log + 1_000_000, twist(0.2, 0.0))
        links = ["base_footprint", "wheel_left_link", "caster_back_link"][: 1 + k % 3]
        transform = make("geometry_msgs/msg/Transform", translation=vector(0.2, 0.1), rotation=pose.orientation)
        transforms = [
            make("geometry_msgs/msg/TransformStamped", header=header(stamp), child_frame_id=link, transform=transform)
            for link in links
        ]
        made.add("/tf", log, make("tf2_msgs/msg/TFMessage", transforms=transforms))
        if k % 6 == 0:
            made.add("/scan", log, scan(stamp, np.where(random_numbers.random(360) < 0.2, np.inf, 1.0)))
        if k % 50 == 0:
            made.add("/rosout", log, said(stamp, "x" * int(random_numbers.integers(5, 200))))
    points = [stamped(0, posture(x, 0.0, 0.0)) for x in np.linspace(0.0, 12.0, 60)]
    made.add("/plan", begun + 12 * 10**9, make("nav_msgs/msg/Path", header=header(12 * 10**9), poses=points))
    return made.write(path, plugin)


def scan(stamp: int, ranges: Any) -> Any:
    return make(
        "sensor_msgs/msg/LaserScan", header=header(stamp, "base_scan"), angle_min=0.0, angle_max=6.28,
        angle_increment=0.0175, time_increment=0.0, scan_time=0.0, range_min=0.12, range_max=3.5,
        ranges=ranges.astype(np.float32), intensities=np.zeros(360, np.float32),
    )  # fmt: skip


def said(stamp: int, text: str) -> Any:
    time = header(stamp).stamp
    return make(
        "rcl_interfaces/msg/Log", stamp=time, level=20, name="diff_drive", msg=text, file="a.cpp", function="f", line=3
    )


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_robot_in_gazebo(tmp_path: Path, plugin: StoragePlugin) -> None:
    lost = {7, 50, 51, 52, 200, 431}
    run = read_robot_run(as_gazebo_records(tmp_path / "bag", plugin, 600, lost), ALL)
    assert set(np.flatnonzero(run.lost).tolist()) == lost
    assert run.ts == pytest.approx(1.0 / 30.0, abs=1e-3 / 599)  # stamps are whole milliseconds
    assert run.pose[:, 1] == pytest.approx(0.1)
    assert run.command[5:, 0] == pytest.approx(0.2)
    assert run.reference[:, 1] == pytest.approx(0.0)
    found = observe(run).to_json()
    assert (found["n_ul_max"], found["max_error"]) == (3, pytest.approx(0.1, abs=1e-6))
