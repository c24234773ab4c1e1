"""Steps by the edge's own clock: which step is due at which instant, and from which pose."""

from __future__ import annotations

import pytest

from agv_cloud.timer_stepping import OutsideRunError, TimerStepping
from agv_ros.messages import StampedPose
from agv_ros.stamps import Grid

TS = 20_000_000
GRID = Grid(1_000_000_000, TS)
OFFSET = 500_000_000_000
"""The edge's clock minus the AGV's [ns]; poses are under way for no time here."""


def pose(k: int, grid: Grid = GRID) -> StampedPose:
    return StampedPose(grid.stamp(k), float(k), 0.0, 0.0)


def now(k: float) -> int:
    """The edge's clock at step k."""
    return GRID.start_ns + round(k * TS) + OFFSET


def test_before_the_first_pose_no_step_is_due() -> None:
    assert TimerStepping(GRID, from_first_pose=False).tick(now(3)) is None


def test_each_step_is_taken_once_with_the_freshest_pose_and_what_no_tick_came_for_is_counted() -> None:
    stepping = TimerStepping(GRID, from_first_pose=False)
    assert stepping.add_pose(pose(2), now(2))
    found = []
    for at in (2.0, 2.3, 3.1, 4.0):
        step = stepping.tick(now(at))
        found.append(step and (step.k, step.taken))
    assert found == [(2, 2), None, (3, 2), (4, 2)]
    assert not stepping.add_pose(pose(4), now(4.5))
    step = stepping.tick(now(7.0))
    assert step is not None
    assert (step.k, step.taken, step.pose) == (7, 4, pose(4))
    assert (stepping.missed, stepping.oldest_ns) == (2, 3 * TS)


def test_the_run_may_begin_with_the_first_pose_wherever_its_stamp_lies() -> None:
    stepping = TimerStepping(GRID, from_first_pose=True)
    first = StampedPose(123_456_789, 0.0, 0.0, 0.0)
    assert stepping.add_pose(first, now(0))
    assert stepping.grid == Grid(123_456_789, TS)
    step = stepping.tick(now(0))
    assert step is not None
    assert (step.k, stepping.step_of(123_456_789 + 2 * TS)) == (0, 2)


def test_a_first_pose_outside_the_run_says_what_to_set() -> None:
    stepping = TimerStepping(GRID, from_first_pose=False)
    with pytest.raises(OutsideRunError, match=r"start_time = 1 s: set it, or set error_detector\.begin to first_pose"):
        stepping.add_pose(StampedPose(0, 0.0, 0.0, 0.0), now(0))
