"""The edge's own clock against the rules read out: never ahead of the AGV, late by the least delay."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from agv_cloud.clock_offset import ACCEPTED_NS, IN_A_ROW, WINDOW_NS, FreshestPose
from agv_ros.messages import StampedPose

MS = 1_000_000
TS = 5 * MS
HOUR = 3600 * 1000 * MS


def pose(stamp_ns: int) -> StampedPose:
    return StampedPose(stamp_ns, 0.0, 0.0, 0.0)


def test_before_the_first_pose_there_is_none() -> None:
    freshest = FreshestPose(TS)
    assert (freshest.pose, freshest.beginnings) == (None, 0)


@settings(deadline=None, derandomize=True)
@given(
    st.integers(-(10**18), 10**18), st.lists(st.integers(0, 900 * MS), min_size=1, max_size=60)
)  # fmt: skip
def test_the_edge_is_late_by_the_least_delay(offset: int, delays: list[int]) -> None:
    """Two clocks with any offset, and any delays: the AGV's time is missed by the least delay so far."""
    freshest, least = FreshestPose(TS), delays[0]
    for k, delay in enumerate(delays):
        sent = 10**9 + k * TS
        freshest.offer(pose(sent), sent + delay + offset)
        least = min(least, delay)
        assert freshest.time(sent + delay + offset) == sent + delay - least
    assert freshest.beginnings == 1


@settings(deadline=None, derandomize=True)
@given(st.permutations(range(20)))
def test_only_a_fresher_pose_is_taken(order: list[int]) -> None:
    freshest, outdated = FreshestPose(TS), 0
    for i, k in enumerate(order):
        is_news = k > max(order[:i], default=-1)
        outdated += not is_news
        assert freshest.offer(pose(k * TS), 100 * MS + i * TS) == is_news
    assert (freshest.pose, freshest.outdated) == (pose(19 * TS), outdated)
    assert not freshest.offer(pose(19 * TS), 300 * MS)  # a second time
    assert freshest.outdated == outdated + 1


def test_a_clock_that_runs_slow_is_followed() -> None:
    """100 ppm slower: after an hour it is 360 ms behind, but the edge no more than 2 ms ahead of it."""
    freshest = FreshestPose(TS)
    for now in range(0, HOUR, 100 * MS):
        sent = now - now // 10_000
        freshest.offer(pose(sent), now + 3 * MS)
        assert 0 <= freshest.time(now + 3 * MS) - sent <= 2 * (WINDOW_NS + 100 * MS) // 10_000
    assert (freshest.beginnings, freshest.future, freshest.outdated) == (1, 0, 0)


def test_one_wild_stamp_is_counted_and_does_no_harm() -> None:
    freshest = FreshestPose(TS)
    for k in range(100):
        assert freshest.offer(pose(k * TS), k * TS + MS)
        for wild in (10**18, k * TS + MS + ACCEPTED_NS + 1):
            assert not freshest.offer(pose(wild), k * TS + MS)
        assert freshest.time(k * TS + MS) == k * TS
    assert (freshest.future, freshest.outdated, freshest.beginnings) == (200, 0, 1)


def test_an_agv_that_starts_anew_is_followed() -> None:
    freshest = FreshestPose(TS)
    for k in range(1000):
        freshest.offer(pose(10**9 + k * TS), k * TS)
    for k in range(1, 10):  # its clock is back at the beginning, its first pose was lost
        taken = freshest.offer(pose(10**9 + k * TS), 10**10 + k * TS)
        assert taken == (k >= IN_A_ROW)
    assert (freshest.beginnings, freshest.first_ns, freshest.future) == (2, 10**9 + IN_A_ROW * TS, 0)
    assert freshest.time(10**10 + 9 * TS) == 10**9 + 9 * TS


def test_a_clock_that_is_reset_with_the_stamps_is_followed_at_once() -> None:
    """A simulator's: both go back, by however much, and the next pose begins a run."""
    for back in (2 * TS, HOUR):
        freshest, start = FreshestPose(TS), 2 * HOUR
        for k in range(100):
            assert freshest.offer(pose(start + k * TS), start + k * TS)
        now = start + 100 * TS - back - 3 * TS
        assert freshest.offer(pose(now), now)
        assert (freshest.beginnings, freshest.first_ns, freshest.time(now)) == (2, now, now)
        assert freshest.offer(pose(now + TS), now + TS)
        assert (freshest.beginnings, freshest.outdated) == (2, 0)


def test_an_own_clock_that_was_set_back_begins_no_run() -> None:
    freshest = FreshestPose(TS)
    for k in range(100):
        set_back = 300 * MS if k > 50 else 0
        assert freshest.offer(pose(10**9 + k * TS), HOUR + k * TS - set_back)
    assert freshest.beginnings == 1
