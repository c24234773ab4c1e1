"""Stamps and steps: one grid, there and back, in whole nanoseconds."""

from __future__ import annotations

from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_ros.stamps import (
    AGREEING,
    BACK_NS,
    MAX_FIRST,
    MAX_LEAP,
    Backwards,
    Grid,
    NearestSteps,
    OffGridError,
    Steps,
    to_nanoseconds,
)

grids = st.builds(Grid, st.integers(1, 2 * 10**18), st.integers(1000, 10**10))


@settings(deadline=None, derandomize=True)
@given(st.floats(0.0, 1e9))
def test_nanoseconds_are_the_nearest_whole_ones(seconds: float) -> None:
    exact = Fraction(seconds) * 10**9
    # The product is rounded to a double once, so beyond 2^53 ns it is only as fine as that.
    assert abs(to_nanoseconds(seconds) - exact) <= max(Fraction(1, 2), exact / 2**53) + Fraction(1, 10**6)


def test_periods_that_are_written_in_decimals_are_exact() -> None:
    for microseconds in range(1, 20_000):
        assert to_nanoseconds(microseconds / 1e6) == microseconds * 1000
    assert Grid.of(1.0, 0.005) == Grid(1_000_000_000, 5_000_000)


@settings(deadline=None, derandomize=True)
@given(grids, st.integers(0, 10**9))
def test_there_and_back(grid: Grid, k: int) -> None:
    assert grid.step(grid.stamp(k)) == k
    assert grid.stamp(k + 1) - grid.stamp(k) == grid.ts_ns


@settings(deadline=None, derandomize=True)
@given(grids, st.integers(-(10**9), 10**9), st.integers(1, 10**10))
def test_between_two_instants_there_is_no_step(grid: Grid, k: int, beside: int) -> None:
    with pytest.raises(OffGridError, match="do all nodes have the same ts and start_time"):
        grid.step(grid.stamp(k) + beside % (grid.ts_ns - 1) + 1)


@settings(deadline=None, derandomize=True)
@given(grids, st.integers(1, 10**9))
def test_before_the_first_instant_there_is_no_step(grid: Grid, k: int) -> None:
    with pytest.raises(OffGridError):
        grid.step(grid.stamp(-k))


def test_steps_may_be_lost_repeated_and_reordered() -> None:
    grid = Grid(10**9, 5_000_000)
    steps = Steps(grid)
    for k in (0, 1, 5, 5, 3, MAX_LEAP, 0, 7):
        assert steps.of(grid.stamp(k)) == k


def test_a_wild_stamp_is_refused_and_changes_nothing() -> None:
    grid = Grid(10**9, 5_000_000)
    steps = Steps(grid)
    steps.of(grid.stamp(3))
    for wild in (3 + MAX_LEAP + 1, 10**12):
        with pytest.raises(OffGridError, match=f"is step {wild}, the furthest one seen was 3"):
            steps.of(grid.stamp(wild))
    with pytest.raises(OffGridError):
        steps.of(grid.stamp(4) + 1)
    assert steps.of(grid.stamp(3 + MAX_LEAP)) == 3 + MAX_LEAP
    assert steps.of(grid.stamp(4)) == 4


def test_a_stamp_of_the_past_does_not_shut_out_the_present() -> None:
    grid = Grid(10**9, 5_000_000)
    steps = Steps(grid, window=2)
    for k in (0, 1, 2, 3, 4, 5, 6, 7, 1, 8, 0, 9):
        assert steps.of(grid.stamp(k)) == k


def test_a_loop_that_has_leapt_is_followed_once_enough_messages_agree() -> None:
    grid = Grid(10**9, 5_000_000)
    steps = Steps(grid, window=2000)
    assert steps.of(grid.stamp(5)) == 5
    for i in range(AGREEING - 1):  # none of these belongs to a run that goes on there
        with pytest.raises(OffGridError):
            steps.of(grid.stamp(10_000 * (i + 1)))
    assert steps.of(grid.stamp(6)) == 6
    for k in range(50_000, 50_000 + AGREEING - 1):
        with pytest.raises(OffGridError):
            steps.of(grid.stamp(k))
    assert steps.of(grid.stamp(50_000 + AGREEING)) == 50_000 + AGREEING
    assert steps.of(grid.stamp(50_000 + AGREEING + 2000)) == 50_000 + AGREEING + 2000


def test_a_node_may_join_a_loop_that_has_run_for_days_but_not_one_of_another_clock() -> None:
    grid = Grid(10**9, 5_000_000)
    a_working_day = 8 * 3600 * 200
    assert Steps(grid).of(grid.stamp(a_working_day)) == a_working_day
    assert Steps(grid).of(grid.stamp(MAX_FIRST)) == MAX_FIRST
    since_1970 = 1_800_000_000 * 200
    with pytest.raises(OffGridError, match="do all nodes have the same start_time"):
        Steps(grid).of(grid.stamp(since_1970))


def test_stamps_off_the_grid_count_for_the_nearest_step_since_the_first() -> None:
    steps, first = NearestSteps(20), 1_700_000_000
    assert [steps.of(first + ns) for ns in (0, 9, 10, 29, 30, 55, 41, 1000)] == [0, 0, 1, 1, 2, 3, 2, 50]
    assert steps.of(first - 500) == 0  # its clock began anew
    assert steps.of(first - 480) == 1
    assert steps.of(first + 20 * (MAX_LEAP + 100)) == 0  # or leapt


def test_a_robot_whose_clock_goes_back_begins_anew_after_ten_stamps() -> None:
    steps, ts = NearestSteps(20_000_000), 20_000_000
    first = [steps.of(10**9 + k * ts) for k in range(500)]
    assert first == list(range(500))
    again = [steps.of(10**9 + (k + 3) * ts) for k in range(100)]
    assert again[:9] == list(range(3, 12))  # they may have been late
    assert again[9:] == list(range(91))


def test_late_messages_begin_nothing() -> None:
    back = Backwards(BACK_NS)
    assert not any(back.has_gone_back(ns * 10**7) for k in range(1000) for ns in (k, k - 300, k - 7))


def test_the_stamp_zero_is_no_time() -> None:
    with pytest.raises(OffGridError, match="no time"):
        NearestSteps(20_000_000).of(0)
