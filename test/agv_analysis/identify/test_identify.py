"""Identified robots, held to robots simulated here in small steps of time, which share no code with the fit."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from agv_analysis.identify.bearable_gains import bearable_gains
from agv_analysis.identify.first_order import HeldCommand
from agv_analysis.identify.fit import FirstOrderFit, Increments, Interval, fit_first_order
from agv_analysis.identify.increment_noise import IncrementNoise
from agv_analysis.identify.robot import SPEEDS, IdentifiedRobot, IdentifiedSpeed, identify
from agv_analysis.recordings.posture_track import Track
from agv_analysis.scenario import load_scenario
from agv_ros.errors import UserError

Floats = NDArray[np.float64]
AgvNcs = Callable[..., tuple[int, str]]
STORE = get_typestore(Stores.ROS2_JAZZY)
START = 1_700_000_000_000_000_000  # [ns]
STEP = 1e-3  # of the simulation [s]


class Robot(NamedTuple):
    """Commands (v, w) at instants [s], poses x, y, theta at others, and dead time [s], lag [s], gain of each speed."""

    sent: Floats
    commands: Floats
    seen: Floats
    poses: Floats
    truth: dict[str, tuple[float, float, float]]


def followed(u: Floats, dead_time: float, lag: float, gain: float) -> Floats:
    """Mean speed in each step of a robot that follows u, step by step."""
    late = np.concatenate((np.full(round(dead_time / STEP), u[0]), u))[: len(u)]
    left, state, y = math.exp(-STEP / lag), float(late[0]), np.empty(len(u))
    for i, wanted in enumerate(late.tolist()):
        y[i] = wanted + (state - wanted) * lag / STEP * (1.0 - left)
        state = wanted + (state - wanted) * left
    return gain * y


def simulated(seed: int, duration: float = 40.0, period: float = 0.05, changes_v: bool = True) -> Robot:
    """A robot that is driven about at random; 10 % of its poses are lost, stamps are irregular, poses noisy."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, duration, STEP)
    sent = np.arange(0.0, duration, period)
    sent = np.round(sent + rng.uniform(0.0, 0.3 * period, len(sent)), 3)
    holds = np.cumsum(rng.uniform(0.5, 2.5, int(duration)))
    levels = rng.uniform((0.1, -1.0), (0.9, 1.0), (int(duration), 2))
    commands = levels[np.minimum(np.searchsorted(holds, sent), int(duration) - 1)]
    if not changes_v:
        commands[:, 0] = 0.5
    held = commands[np.maximum(np.searchsorted(sent, t + 1e-6, side="right") - 1, 0)]
    truth = {
        key: (round(rng.uniform(0.0, 0.4), 3), rng.uniform(0.02, 0.4), rng.uniform(0.85, 1.1)) for key in ("v", "w")
    }
    v, w = (followed(held[:, i], *truth[key]) for i, key in enumerate("vw"))
    theta = np.concatenate(([0.0], np.cumsum(w * STEP)))[:-1]
    middle = theta + 0.5 * STEP * w
    x, y = (np.concatenate(([0.0], np.cumsum(v * f(middle) * STEP)))[:-1] for f in (np.cos, np.sin))
    seen = np.arange(0.1, duration - 0.1, period)
    seen = (seen + rng.uniform(-0.2 * period, 0.2 * period, len(seen)))[rng.random(len(seen)) >= 0.1]
    poses = np.column_stack([np.interp(seen, t, column) for column in (x, y, theta)])
    return Robot(sent, commands, seen, poses + rng.normal(0.0, 0.002, poses.shape), truth)


def identified(robot: Robot) -> IdentifiedRobot:
    stamps = START + np.rint(robot.seen * 1e9).astype(np.int64)
    still = np.zeros(len(stamps))
    x, y, theta = robot.poses.T
    poses = Track(stamps, stamps, x, y, theta, still, still, "odom")
    return identify(START + np.rint(robot.sent * 1e9).astype(np.int64), robot.commands, poses, "simulated")


def test_intervals_hold_the_truth() -> None:
    """Of simulated robots 95 % intervals hold dead time, lag and gain, and those of the dead time are short."""
    inside = []
    for seed in range(4):
        robot = simulated(seed)
        found = identified(robot)
        for speed in found.speeds:
            assert speed.fit is not None, speed.reason
            fit, truth = speed.fit, robot.truth[speed.named.key]
            inside += [
                part.low <= true <= part.high
                for part, true in zip((fit.dead_time, fit.lag, fit.gain), truth, strict=True)
            ]
            assert fit.dead_time.width < found.pose_period
            assert abs(fit.dead_time.value - truth[0]) < 0.5 * found.pose_period
            assert speed.slip is not None
            assert speed.slip.value == pytest.approx(1.0 - fit.gain.value)
    assert len(inside) == 24
    assert sum(inside) >= 20  # of 24 at 95 %: fewer have a probability of 0.2 % if independent


def test_what_was_not_excited_has_no_number() -> None:
    """A speed whose command does not change has no dead time; the rate of turn still has."""
    found = identified(simulated(5, changes_v=False))
    assert found["v"].fit is None
    assert "not excited" in found["v"].reason
    assert found["w"].fit is not None
    assert found.to_json()["v"]["dead_time_s"] is None
    assert bearable_gains(found) is None


def test_commands_of_another_robot_have_no_number() -> None:
    """Commands that the robot did not follow are refused, not fitted."""
    robot, other = simulated(6), simulated(7)
    found = identified(robot._replace(commands=other.commands[: len(robot.sent)]))
    assert found["v"].fit is None
    assert found["w"].fit is None


def test_a_robot_without_noise_or_delay_is_found_in_few_rounds() -> None:
    """Where rounding alone is left the likelihood has no one best place to move a grid to."""
    t = np.arange(0.0, 20.0, 0.02)
    v = np.repeat(np.random.default_rng(1).uniform(0.0, 1.0, 50), 20)
    found = fit_first_order(HeldCommand(t, v), Increments(t, 0.02 * v[:-1]), 0.0, False)
    assert found is not None
    assert [one.value for one in (found.dead_time, found.lag, found.gain)] == pytest.approx([0.0, 0.0, 1.0], abs=1e-6)


def test_a_recording_too_short_is_refused() -> None:
    """Too few poses under commands are an error that says how many there are."""
    robot = simulated(8)
    with pytest.raises(UserError, match="at least 100 are needed"):
        identified(robot._replace(seen=robot.seen[:60], poses=robot.poses[:60]))


def test_positions_are_those_of_small_steps() -> None:
    """The sums in closed form agree with stepping the lag through the same commands."""
    rng = np.random.default_rng(3)
    u: Floats = rng.uniform(-1.0, 1.0, 40)
    sent = (np.sort(rng.integers(0, 3000, 40)) * STEP).astype(np.float64)
    t = np.arange(0.0, 4.0, STEP)
    held = u[np.maximum(np.searchsorted(sent, t + 1e-6, side="right") - 1, 0)]
    stepped = np.concatenate(([0.0], np.cumsum(followed(held, 0.117, 0.08, 1.0) * STEP)))[:-1]
    s = HeldCommand(sent, u).positions(t, 0.08, np.array([0.117]))[0]
    assert s - s[0] == pytest.approx(stepped, abs=1e-9)


@pytest.mark.parametrize("white", [0.0, 0.6, 0.999])
def test_increments_are_made_white(white: float) -> None:
    """The filter is the inverse of a Cholesky factor of the covariance, as numpy computes it."""
    dt = np.random.default_rng(4).uniform(0.02, 0.1, 60)
    covariance = np.diag((1.0 - white) * dt / dt.mean() + 2.0 * white)
    covariance -= white * (np.eye(60, k=1) + np.eye(60, k=-1))
    factor, noise = np.linalg.cholesky(covariance), IncrementNoise(dt, white)
    assert noise.whitened(factor.T) == pytest.approx(np.eye(60), abs=1e-9)
    assert noise.log_determinant == pytest.approx(2.0 * np.log(np.diag(factor)).sum())


def test_largest_gain_is_that_of_a_delayed_integrator() -> None:
    """Without a lag z^n (z - 1) + T_s K_x is stable up to T_s K_x = 2 sin(pi / (4 n + 2)) (Levin and May, 1976)."""
    nothing = Interval(0.0, 0.0, 0.0)
    fit = FirstOrderFit(Interval(0.11, 0.1, 0.13), nothing, Interval(1.0, 1.0, 1.0), True, 0.0, 0.0, 1.0, 1.0)
    robot = IdentifiedRobot("by hand", tuple(IdentifiedSpeed(named, fit) for named in SPEEDS), 0.05, 0.05, 1.0)
    gains = bearable_gains(robot)
    assert gains is not None
    assert gains.dead_time == pytest.approx(0.15)
    assert gains.kx == pytest.approx(2.0 * math.sin(math.pi / 14.0) / 0.05, rel=1e-6)


def message(kind: str, **fields: Any) -> Any:
    return STORE.types[kind](**fields)


def twist(v: float, w: float) -> Any:
    linear, angular = (
        message("geometry_msgs/msg/Vector3", x=x, y=0.0, z=z) for x, z in ((float(v), 0.0), (0.0, float(w)))
    )
    return message("geometry_msgs/msg/Twist", linear=linear, angular=angular)


def odometry(stamp: int, x: float, y: float, theta: float) -> Any:
    time = message("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
    pose = message(
        "geometry_msgs/msg/Pose",
        position=message("geometry_msgs/msg/Point", x=x, y=y, z=0.0),
        orientation=message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(theta / 2), w=math.cos(theta / 2)),
    )
    nothing = np.zeros(36)
    return message(
        "nav_msgs/msg/Odometry",
        header=message("std_msgs/msg/Header", stamp=time, frame_id="odom"),
        child_frame_id="base_link",
        pose=message("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=nothing),
        twist=message("geometry_msgs/msg/TwistWithCovariance", twist=twist(0.0, 0.0), covariance=nothing),
    )


def test_command_reads_a_robots_bag(agv_ncs: AgvNcs, tmp_path: Path) -> None:
    """A bag of Odometry and Twist, written by rosbags: what is printed and written, and the params file."""
    robot = simulated(1, duration=25.0)
    messages = [
        *(("/cmd_vel", START + round(t * 1e9), twist(*u)) for t, u in zip(robot.sent, robot.commands, strict=True)),
        *(
            ("/odom", stamp, odometry(stamp, *pose))
            for stamp, pose in zip(
                (START + np.rint(robot.seen * 1e9).astype(int)).tolist(), robot.poses.tolist(), strict=True
            )
        ),
    ]
    with Writer(tmp_path / "robot", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        kinds = {topic: kind.__msgtype__ for topic, _, kind in messages}
        topics = {topic: writer.add_connection(topic, kind, typestore=STORE) for topic, kind in kinds.items()}
        for topic, log_time, content in sorted(messages, key=lambda entry: entry[1]):
            writer.write(topics[topic], log_time, STORE.serialize_cdr(content, kinds[topic]))
    words = ["identify", str(tmp_path / "robot"), "--pose-topic", "/odom", "--command-topic", "/cmd_vel"]
    files = ["--json", str(tmp_path / "robot.json"), "--params", str(tmp_path / "robot.yaml")]
    status, said = agv_ncs(*words, *files)
    assert status == 0, said
    assert "dead time" in said
    assert "K_x below" in said
    written = json.loads((tmp_path / "robot.json").read_text())
    for key, (dead_time, _, gain) in robot.truth.items():
        assert written[key]["dead_time_s"]["value"] == pytest.approx(dead_time, abs=0.02)
        assert written[key]["gain"]["value"] == pytest.approx(gain, abs=0.02)
    scenario = load_scenario(tmp_path / "robot.yaml")
    assert scenario.plant.speed_scale == pytest.approx(written["v"]["gain"]["value"], abs=1e-6)
    assert scenario.controller.kx == pytest.approx(written["gains"]["kx_max_per_s"] / 2.0, rel=1e-3)
    longest = max(written[key]["dead_time_s"]["value"] for key in "vw")
    assert scenario.relay.uplink.delay == pytest.approx(longest, abs=1e-6)
    status, said = agv_ncs("identify", tmp_path / "robot", "--pose-topic", "/odom")
    assert status == 1
    assert "no topic /agv/cmd_vel for the command" in said


def test_a_robot_that_is_driven_faster_than_any_reference_is_refused_in_a_line(agv_ncs: AgvNcs) -> None:
    """The sample begins 5 m off its track, and is commanded 124.5 m/s."""
    status, said = agv_ncs("identify", str(Path(__file__).parents[3] / "bags/sample"))
    assert status == 1
    assert "driven at up to 124.5 m/s" in said
    assert "at most 100 m/s" in said
