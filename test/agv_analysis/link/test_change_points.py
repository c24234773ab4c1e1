"""Change points: found where the link changed, seldom where it did not, and not made of one outage."""

from __future__ import annotations

import numpy as np
import pytest

from agv_analysis.link.change_points import SIGNIFICANCE, stationarity
from test.agv_analysis.link.recorded_outcomes import gap_and_outage, gilbert, series


@pytest.mark.parametrize("before", [0.0, 0.05])
@pytest.mark.parametrize("slots", [2000, 14_000, 18_500])
def test_a_change_is_found_within_a_few_steps(before: float, slots: int) -> None:
    rng = np.random.default_rng(slots)
    lost = rng.random(20_000) < np.where(np.arange(20_000) < slots, before, 0.97)
    found = stationarity(np.arange(20_000), lost)
    assert found.p_value == SIGNIFICANCE
    assert len(found.change_points) == 1
    assert abs(found.change_points[0] - slots) <= 5


def test_change_points_are_steps_also_where_steps_are_missing() -> None:
    rng = np.random.default_rng(1)
    k = np.concatenate((np.arange(100, 4000), np.arange(4500, 9000)))
    lost = rng.random(len(k)) < np.where(k < 6000, 0.05, 0.9)
    (change,) = stationarity(k, lost).change_points
    assert abs(change - 6000) <= 5


@pytest.mark.no_cover
@pytest.mark.parametrize(("p", "r", "slots"), [(0.01, 0.1, 6000), (0.001, 0.01, 20_000), (0.05, 0.95, 5000)])
def test_p_values_on_a_link_that_does_not_change(p: float, r: float, slots: int) -> None:
    """Of 200, 21 or more below 5 % have probability 0.001; below 0.2 %, 4 or more 0.001."""
    k = np.arange(slots)
    found = np.array([stationarity(k, lost).p_value for lost in gilbert(p, r, slots, 200, seed=4)], dtype=float)
    assert np.count_nonzero(found < 0.05) <= 20
    assert np.count_nonzero(found <= SIGNIFICANCE) <= 3


@pytest.mark.no_cover
def test_outages_of_two_kinds_are_no_change() -> None:
    rng = np.random.default_rng(3)
    recordings = [
        series(lambda: gap_and_outage(rng.geometric(0.25), 60 if rng.random() < 0.05 else 1), 10_000) for _ in range(40)
    ]
    assert sum(len(stationarity(np.arange(10_000), lost).segments) > 1 for lost in recordings) <= 2


def test_one_outage_is_no_change() -> None:
    lost = np.zeros(20_000, dtype=bool)
    lost[9000:9400] = True
    assert len(stationarity(np.arange(20_000), lost).segments) == 1


@pytest.mark.parametrize("slots", [1, 2, 5, 13])
def test_recordings_too_short_to_change(slots: int) -> None:
    found = stationarity(np.arange(slots), np.arange(slots) % 2 == 0)
    assert found.change_points == ()
    assert found.segments == ((0, slots),)


@pytest.mark.parametrize("slots", [12, 20, 199])
def test_a_short_recording_without_any_outage_shows_no_change(slots: int) -> None:
    found = stationarity(np.arange(slots), np.zeros(slots, dtype=np.bool_))
    assert (found.p_value, found.change_points) == (1.0, ())


@pytest.mark.parametrize("every", [10, 100])
def test_losses_at_equal_intervals_are_no_change(every: int) -> None:
    """All orders of its blocks are nearly the same; the first one, which begins without a loss, is the odd one out."""
    k = np.arange(100_000)
    found = stationarity(k, k % every == 7)
    assert found.change_points == ()
    assert found.p_value is not None
    assert found.p_value > 0.1
