"""Punctuality of a periodic loop against counting and sorting by hand."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_plant.deadline_monitor import DeadlineMonitor

PERIOD = 5_000_000


def ticked(*ticks: int, start: int = 0) -> DeadlineMonitor:
    deadline_monitor = DeadlineMonitor(PERIOD)
    deadline_monitor.start(start)
    for tick in ticks:
        deadline_monitor.tick(tick)
    return deadline_monitor


def test_nothing_to_say_before_the_first_tick() -> None:
    assert ticked().summary() == {"jitter p50": 0.0, "jitter p99": 0.0, "jitter max": 0.0, "missed deadlines": 0.0}


def test_a_perfect_loop() -> None:
    found = ticked(*(10**15 + k * PERIOD for k in range(1, 200)), start=10**15)
    assert set(found.summary().values()) == {0.0}


def test_a_tick_belongs_to_the_nearest_instant() -> None:
    deadline_monitor = ticked()
    assert [deadline_monitor.tick(round(at * PERIOD)) for at in (0.49, 0.51, 1.49, 1.51, 3.2)] == [0, 1, 1, 2, 3]
    assert deadline_monitor.missed == 0


def test_every_instant_without_a_tick_is_a_missed_deadline() -> None:
    assert ticked(PERIOD, 2 * PERIOD, 6 * PERIOD).missed == 3
    assert ticked(10 * PERIOD).missed == 9


def test_the_largest_jitter_is_that_of_the_longest_gap() -> None:
    found = ticked(PERIOD, 2 * PERIOD, 5 * PERIOD, 6 * PERIOD).summary()
    assert found["jitter max"] == pytest.approx(2 * PERIOD * 1e-9, abs=1e-15)
    assert found["jitter p50"] == 0.0


@settings(deadline=None, derandomize=True)
@given(st.lists(st.integers(-PERIOD // 2 + 1, PERIOD // 2 - 1), min_size=1, max_size=50), st.integers(0, 10**18))
def test_jitter_is_the_deviation_of_each_period(offsets: list[int], start: int) -> None:
    ticks = [start + (k + 1) * PERIOD + offset for k, offset in enumerate(offsets)]
    found = ticked(*ticks, start=start).summary()
    deviations = sorted(abs(b - a - PERIOD) * 1e-9 for a, b in pairwise([start, *ticks]))
    assert found["missed deadlines"] == 0.0
    assert found["jitter max"] == pytest.approx(deviations[-1], abs=1e-15)
    assert found["jitter p50"] == pytest.approx(np.median(deviations), abs=1e-15)
    assert deviations[0] - 1e-15 <= found["jitter p99"] <= deviations[-1] + 1e-15


def test_of_a_long_run_the_last_lap_counts() -> None:
    rough = [k * PERIOD + (k % 2) * 1_000_000 for k in range(1, 101)]
    smooth = [k * PERIOD for k in range(101, 20_102)]
    assert ticked(*rough).summary()["jitter max"] == pytest.approx(1e-3)
    found = ticked(*rough, *smooth)
    assert set(found.summary().values()) == {0.0}
    assert found.tick(20_105 * PERIOD) == 20_105
    assert found.missed == 3


def test_no_deadline_is_missed_after_the_last_one() -> None:
    deadline_monitor = DeadlineMonitor(PERIOD, last=5)
    deadline_monitor.start(0)
    assert [deadline_monitor.tick(at * PERIOD) for at in (1, 2, 9, 12)] == [1, 2, 5, 5]
    assert deadline_monitor.missed == 2
