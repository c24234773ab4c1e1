"""The held command against a plain reading of the rules: newest first, not too old, not from the future."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_plant.zero_order_hold import ZeroOrderHold
from agv_ros.messages import Command

TIMEOUT = 100


def stopped(stamp_ns: int) -> Command:
    return Command(stamp_ns, 0.0, 0.0)


def test_standing_still_before_the_first_command() -> None:
    held = ZeroOrderHold(TIMEOUT)
    assert held.at(0) == stopped(0)
    assert held.at(10**12) == stopped(10**12)
    assert held.stops == 0


def test_obeyed_until_it_is_older_than_the_limit() -> None:
    held = ZeroOrderHold(TIMEOUT)
    held.at(50)
    held.offer(Command(50, 1.0, 2.0))
    assert held.at(50 + TIMEOUT) == Command(50, 1.0, 2.0)
    assert held.at(51 + TIMEOUT) == stopped(51 + TIMEOUT)
    assert held.stops == 1


def test_the_agv_goes_on_when_commands_return_and_each_stop_counts_once() -> None:
    held = ZeroOrderHold(TIMEOUT)
    for start in (0, 1000, 2000):
        held.at(start)
        held.offer(Command(start, 1.0, 0.0))
        assert held.at(start + 1) == Command(start, 1.0, 0.0)
        assert [held.at(start + late) for late in (200, 300)] == [stopped(start + 200), stopped(start + 300)]
    assert held.stops == 3


def test_an_older_command_after_a_newer_one_is_not_obeyed() -> None:
    held = ZeroOrderHold(TIMEOUT)
    held.at(20)
    held.offer(Command(20, 2.0, 0.0))
    held.offer(Command(10, 1.0, 0.0))
    assert held.at(30) == Command(20, 2.0, 0.0)
    held.offer(Command(20, 3.0, 0.0))
    assert held.at(30) == Command(20, 3.0, 0.0)
    assert held.outdated == 1


@pytest.mark.parametrize("ahead", [1, 10**18])
def test_a_command_from_the_future_neither_moves_nor_blinds_the_agv(ahead: int) -> None:
    held = ZeroOrderHold(TIMEOUT)
    held.offer(Command(ahead, 9.0, 0.0))
    assert held.at(0) == stopped(0)
    held.offer(Command(0, 1.0, 0.0))
    held.offer(Command(ahead, 9.0, 0.0))
    assert held.at(0) == Command(0, 1.0, 0.0)
    held.at(TIMEOUT)
    held.offer(Command(TIMEOUT, 2.0, 0.0))
    assert held.at(TIMEOUT + 1) == Command(TIMEOUT, 2.0, 0.0)
    assert held.outdated == 2
    assert held.stops == 0


@settings(deadline=None, derandomize=True, max_examples=300)
@given(st.lists(st.tuples(st.integers(0, 40), st.lists(st.integers(-300, 50), max_size=3)), max_size=30))
def test_against_the_rules_read_out(story: list[tuple[int, list[int]]]) -> None:
    """At each instant obey the newest stamp offered so far that was not ahead of the clock, unless it is too old."""
    held, now, heard, stops, was_stopped = ZeroOrderHold(TIMEOUT), 1000, [], 0, False
    held.at(now)
    for pause, offers in story:
        for delay in offers:
            held.offer(Command(now + delay, float(now + delay), 0.0))
            heard += [now + delay] if delay <= 0 else []
        now += pause
        newest = max(heard, default=None)
        is_stopped = newest is not None and now - newest > TIMEOUT
        stops += is_stopped and not was_stopped
        was_stopped = is_stopped
        expected = stopped(now) if newest is None or is_stopped else Command(newest, float(newest), 0.0)
        assert held.at(now) == expected
    assert held.stops == stops


def test_a_command_that_is_a_little_early_waits_for_its_own_instant() -> None:
    """An edge that steps by its own clock is before a tick of the AGV that comes late, or does not come at all."""
    held = ZeroOrderHold(TIMEOUT, ahead_ns=30)
    held.offer(Command(0, 1.0, 0.0))
    assert held.at(0) == Command(0, 1.0, 0.0)
    held.offer(Command(10, 2.0, 0.0))
    held.offer(Command(20, 3.0, 0.0))
    held.offer(Command(20, 3.0, 0.0))  # a second time
    held.offer(Command(31, 9.0, 0.0))  # too far ahead
    assert held.at(10) == Command(0, 1.0, 0.0)
    held.offer(Command(10, 2.5, 0.0))  # on time, and newer than the one that waits for the same instant
    assert [held.at(now).v for now in (20, 30)] == [2.5, 3.0]
    assert held.outdated == 3
