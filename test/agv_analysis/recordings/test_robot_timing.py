"""Poses and commands of another robot that came later than their stamps say; written with rosbags, as they came."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.recordings.other_robots import read_robot_run
from agv_analysis.recordings.robot_topics import RobotTopics
from agv_analysis.run import Run
from agv_analysis.stability.analysis import observe
from test.agv_analysis.recordings.test_other_robots import Recording, make, odometry, posture, twist_stamped

MS = 1_000_000
T = 20 * MS
START, LOG = 1_700_000_000_250_000_000, 3_600_003_000_000
STEPS = 500
TOPICS = RobotTopics("/odom", "/cmd_vel", "/plan")


def driven(
    path: Path,
    pose_late: Callable[[int], float] = lambda k: 0.0,
    command_late: Callable[[int], float] = lambda k: 0.0,
    start: int = START,
    log_of: Callable[[int], int] = lambda stamp: stamp + LOG,
    twice: bool = False,
    simulated_clock: bool = False,
) -> Run:
    """A robot on a line; its messages come later by so many milliseconds, from their steps."""
    made = Recording()
    for k in range(STEPS):
        stamp = start + k * T
        pose, log = posture(0.02 * k, 0.1, 0.0), log_of(stamp) + round(pose_late(k) * MS)
        for again in range(1 + twice):
            made.add("/odom", log + again * 3 * T, odometry(stamp, pose, 1.0))
        made.add("/cmd_vel", log_of(stamp) + round((1.0 + command_late(k)) * MS), twist_stamped(stamp, 1.0, 0.0))
        made.add("/plan", log_of(stamp), odometry(stamp, posture(0.02 * k, 0.0, 0.0), 1.0))
        if simulated_clock:
            time = make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
            made.add("/clock", log_of(stamp), make("rosgraph_msgs/msg/Clock", clock=time))
    return read_robot_run(made.write(path / "bag"), TOPICS)


def gap(k: int, first: int = 200, length: float = 533.0) -> float:
    """Messages from step `first` on come together, `length` after the one before [ms]; stamps stay regular."""
    return max(0.0, length - 20.0 * (k - first + 1)) if k >= first else 0.0


def ages_by_hand(late: Callable[[int], float]) -> list[int]:
    """At the end of each step the freshest pose that had come, pose by pose."""
    ages = []
    for k in range(STEPS):
        came = [j for j in range(k + 1) if j * 20.0 + late(j) < (k + 1) * 20.0]
        ages.append(k - max(came, default=0))
    return ages


def test_a_gap_in_log_time_is_an_age_though_stamps_are_regular(tmp_path: Path) -> None:
    run = driven(tmp_path, gap)
    assert not run.lost.any()
    assert run.n_ul.max() == 0
    assert run.n_ul_received is not None
    assert run.n_ul_received.tolist() == ages_by_hand(gap)
    assert run.n_ul_received.max() * 0.02 == pytest.approx(0.533, abs=2 * 0.02)
    assert run.is_late
    assert any("age by receive time at most 25 steps (0.5 s), by stamps 0" in note for note in run.notes)
    found = observe(run)
    assert found.n == 25
    assert found.outages.uplink.age_received is not None
    assert found.outages.uplink.age_received.max == 25


LATE: dict[str, Callable[[int], float]] = {
    "bursts": lambda k: max(0.0, 20.0 * (35 - k % 60)),
    "reordered": lambda k: (k * 7 % 5) * 15.0 * (k % 40 > 30),
    "overtaken": lambda k: 300.0 * (k % 50 == 9),
    "at the beginning": lambda k: gap(k, 1, 4000.0),
    "a growing queue": lambda k: 0.5 * k,
}


@pytest.mark.parametrize("name", LATE)
def test_ages_are_those_of_the_poses_that_had_come(tmp_path: Path, name: str) -> None:
    """A pose that a newer one has overtaken counts as lost; of a queue some is taken for the drift of a clock."""
    run = driven(tmp_path, LATE[name], twice=True)
    assert run.n_ul_received is not None
    expected = np.array(ages_by_hand(LATE[name])[: len(run)])
    assert np.abs(run.n_ul_received - expected).max() <= (name == "a growing queue")
    older = (expected - run.n_ul)[5:]
    assert run.is_late == bool(older.max() >= 2 or np.mean(older >= 1) > 0.01) == (name != "overtaken")


def test_late_commands_make_the_poses_behind_them_older(tmp_path: Path) -> None:
    run = driven(tmp_path, command_late=lambda k: gap(k, 100, 400.0))
    assert run.n_ul_received is not None
    assert run.n_ul_received.max() == 0
    assert run.is_late
    assert run.command_age.tolist() == ages_by_hand(lambda k: gap(k, 100, 400.0))
    assert run.timing is not None
    assert run.timing.late_commands == sum(gap(k, 100, 400.0) >= 20.0 for k in range(STEPS))


def test_jitter_below_a_period_is_nothing(tmp_path: Path) -> None:
    noise = np.random.default_rng(5).uniform(0.0, 19.0, (2, STEPS))
    run = driven(tmp_path, lambda k: float(noise[0, k]), lambda k: float(noise[1, k]))
    assert not run.is_late
    assert run.command_age is run.n_ul
    assert observe(run).outages.uplink.age_received is None


def test_a_clock_that_drifts_is_not_late(tmp_path: Path) -> None:
    run = driven(tmp_path, log_of=lambda stamp: LOG + START + round((stamp - START) * (1.0 + 2e-4)))
    assert run.n_ul_received is not None
    assert not run.is_late


@pytest.mark.parametrize(
    ("why", "change"),
    [
        ("log times are the stamps", {"log_of": lambda stamp: stamp}),
        (
            "log times do not run as fast as the stamps",
            {"start": 12 * 10**9, "log_of": lambda stamp: START + round(stamp / 0.9)},
        ),
        ("the stamps are of a simulated clock", {"simulated_clock": True, "pose_late": gap}),
    ],
)
def test_where_log_times_say_nothing_the_run_says_so(tmp_path: Path, why: str, change: dict[str, object]) -> None:
    run = driven(tmp_path, **change)  # type: ignore[arg-type]
    assert run.n_ul_received is None
    assert not run.is_late
    (note,) = [note for note in run.notes if "when poses came is not recorded" in note]
    assert why in note
