"""Clocks as robots have them: jitter, stamps that were never set, clocks that are set, or that differ."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.recordings.clock_steps import clock_steps
from agv_analysis.recordings.other_robots import RobotTopics, read_robot_run
from agv_analysis.recordings.sampling import sampling_of
from agv_ros.errors import UserError
from test.agv_analysis.recordings.test_other_robots import Recording, make, odometry, posture, twist_stamped

PERIOD, START, COUNT = 20_000_000, 1_700_000_000_000_000_000, 400
TOPICS = RobotTopics(pose="/odom", command="/cmd_vel", reference="/reference")


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("share", [0.1, 0.2])
def test_jitter_of_a_fifth_of_a_period_makes_no_losses(seed: int, share: float) -> None:
    """Rounding gap by gap would find some: those of normal numbers are more than half a period off now and then."""
    random = np.random.default_rng(seed)
    stamps = START + np.rint((np.arange(3000) + random.normal(0.0, share, 3000)) * 1.0002 * PERIOD).astype(np.int64)
    stamps = stamps[np.append(True, np.diff(np.maximum.accumulate(stamps)) > 0)]
    assert share < 0.2 or (np.abs(np.diff(stamps) / PERIOD - 1.0) > 0.5).mean() > 0.02
    sampling = sampling_of(stamps, "odom")
    assert sampling.k[-1] + 1 == 3000
    assert np.count_nonzero(np.diff(sampling.k) > 1) == 3000 - len(stamps)  # those that jitter has put in another order
    assert sampling.period == pytest.approx(1.0002 * PERIOD, rel=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_losses_are_found_behind_jitter(seed: int) -> None:
    random = np.random.default_rng(seed)
    lost = random.random(3000) < 0.05
    lost[[0, -1]] = False
    k = np.flatnonzero(~lost)
    stamps = START + np.rint((k + random.normal(0.0, 0.15, len(k))) * PERIOD).astype(np.int64)
    found = sampling_of(stamps, "odom").k
    assert found[-1] == 2999
    assert (found == k).mean() > 0.99


def recorded(
    shift: int = 0, from_row: int = COUNT, command_ahead: int = 0, no_stamp: slice = slice(0), w: float | None = None
) -> Recording:
    """A robot that goes straight on at 0.5 m/s; before a row its clock is set by `shift` [ns]."""
    made = Recording()
    for k in range(COUNT):
        log_time = START + k * PERIOD + 1_000_000
        stamp = 0 if k in range(COUNT)[no_stamp] else START + k * PERIOD + shift * (k >= from_row)
        pose = posture(0.01 * k, 0.0, 0.0)
        if w is not None:
            pose.orientation = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=w)
        made.add("/odom", log_time, odometry(stamp, pose, 0.5))
        made.add("/cmd_vel", log_time + 2_000_000, twist_stamped(START + k * PERIOD + command_ahead, 0.5 + k, 0.0))
        made.add("/reference", log_time, odometry(START + k * PERIOD, posture(0.01 * k, 0.0, 0.0), 0.5))
    return made


def test_stamps_that_are_no_time_are_set_aside(tmp_path: Path) -> None:
    run = read_robot_run(recorded(no_stamp=slice(0, COUNT, 40)).write(tmp_path / "bag"), TOPICS)
    assert any(note == "/odom: 10 stamps are 0, which means no time, their messages are left out" for note in run.notes)
    assert run.lost.sum() == 9  # those behind the first one that is there
    with pytest.raises(UserError, match="all its 400 stamps are 0, no time"):
        read_robot_run(recorded(no_stamp=slice(COUNT)).write(tmp_path / "never"), TOPICS)


@pytest.mark.parametrize("w", [0.0, 0.5, math.nan])
def test_a_quaternion_that_is_no_rotation_is_rejected_as_it_is_live(tmp_path: Path, w: float) -> None:
    with pytest.raises(UserError, match="none of its 400 poses has finite numbers and an orientation"):
        read_robot_run(recorded(w=w).write(tmp_path / "bag"), TOPICS)


@pytest.mark.parametrize("shift", [3_000_000_000, -3_000_000_000])
def test_a_clock_that_was_set_is_named(tmp_path: Path, shift: int) -> None:
    with pytest.raises(UserError, match=re.escape(f"/odom: the clock of its stamps was set by {shift / 1e9:+.3f} s")):
        read_robot_run(recorded(shift, 200).write(tmp_path / "bag"), TOPICS)


def test_outages_bursts_and_queues_set_no_clock() -> None:
    k = np.arange(1000)
    kept = (k < 300) | (k > 450)
    stamps = START + k * PERIOD
    late = np.where((k > 500) & (k < 600), (600 - k) * PERIOD, 0)  # a queue that is emptied at once
    assert clock_steps(stamps[kept], (stamps + 5_000_000)[kept]) == []
    assert clock_steps(stamps, stamps + 5_000_000 + late) == []
    assert clock_steps(stamps, 10 * stamps) == []  # a simulation at another rate


@pytest.mark.parametrize("ahead", [37_000_000_000, -400_000_000, 0])
def test_commands_by_another_clock_are_carried_over(tmp_path: Path, ahead: int) -> None:
    run = read_robot_run(recorded(command_ahead=ahead).write(tmp_path / "bag"), TOPICS)
    noted = [note for note in run.notes if "by another clock" in note]
    assert [f"{ahead / 1e9:+.2f} s" in note for note in noted] == [True] * (ahead != 0)
    same = read_robot_run(recorded().write(tmp_path / "same"), TOPICS)
    assert np.array_equal(run.command, same.command, equal_nan=True)
