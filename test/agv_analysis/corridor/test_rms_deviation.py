"""Which RMS deviation is shown, and the intervals between receptions that it rests on, against closed forms."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from agv_analysis.corridor.leaving import Leaving
from agv_analysis.corridor.rms_deviation import FIRST_ORDER, SAMPLED, SIMULATED, RmsDeviation, rms_deviation
from agv_analysis.corridor.sampled_deviation import intervals_of
from agv_analysis.corridor.stationary_deviation import StationaryDeviation
from agv_analysis.link.channel_fit import Estimate
from agv_analysis.link.markov_channel import Chain, bernoulli, gilbert_elliott
from test.agv_analysis.corridor.test_single_outage import scenario
from test.agv_analysis.corridor.test_stationary_deviation import loop_of

LAPS = np.array([0.8, 1.0, 1.2, 1.0]) * 1e-4
"""Mean squares of laps, whose RMS is 1 cm."""


def of(rms: float, chain: Chain | None = None, has_heavy_tail: bool = False) -> RmsDeviation:
    certain = Estimate(0.0, 0.0, 0.0)
    found = Leaving(certain, certain, None, "", np.zeros(len(LAPS)), LAPS)
    square = np.full(1, rms**2)
    stationary = StationaryDeviation(square, square, 0.0 * square, has_heavy_tail, 0.005)
    loop = loop_of(scenario("error_detector.track=line"))
    return rms_deviation(loop, chain or gilbert_elliott(0.02, 0.2), stationary, "", found)


def test_of_laps_that_agree_with_the_linear_loop_its_moments_are_shown() -> None:
    found = of(0.0101)
    assert found.value == pytest.approx(0.0101)
    assert (found.interval, found.method) == (None, FIRST_ORDER)
    half = 1.96 * LAPS.std(ddof=1) / math.sqrt(len(LAPS))
    assert found.simulated.high == pytest.approx(math.sqrt(1e-4 + half))
    assert found.simulated.low == pytest.approx(math.sqrt(1e-4 - half))


def test_of_laps_that_do_not_their_own_with_its_interval() -> None:
    found = of(0.02)
    assert found.value == pytest.approx(0.01)
    assert found.method == SIMULATED
    assert found.interval == (found.simulated.low, found.simulated.high)
    assert "not right" in str(found)


def test_where_rare_outages_make_it_they_are_sampled_or_there_is_no_answer() -> None:
    found = of(0.02, has_heavy_tail=True)
    assert found.method == SAMPLED
    assert found.interval is not None
    assert next(found.notes())
    either = Chain(np.array([[0.9, 0.1], [0.2, 0.8]]), np.array([1.0, 0.3]))  # the next interval depends on the last
    unknown = of(0.02, either, has_heavy_tail=True)
    assert (unknown.value, unknown.to_json()["rms_deviation"]) == (None, None)
    assert "no answer" in str(unknown)


@pytest.mark.parametrize(
    ("chain", "expected"),
    [
        (gilbert_elliott(0.02, 0.2), [0.98, 0.02 * 0.2, 0.02 * 0.2 * 0.8, 0.02 * 0.2 * 0.8**2]),
        (bernoulli(0.3), [0.7, 0.7 * 0.3, 0.7 * 0.3**2, 0.7 * 0.3**3]),
    ],
    ids=["gilbert", "bernoulli"],
)
def test_intervals_between_receptions_have_a_closed_form(chain: Chain, expected: list[float]) -> None:
    found = intervals_of(chain)
    assert found is not None
    assert found[:4] == pytest.approx(expected, rel=1e-12)
    assert found.sum() == pytest.approx(1.0, rel=1e-12)


def test_intervals_without_an_end_are_none() -> None:
    stays_lost = dataclasses.replace(gilbert_elliott(0.02, 0.2), transition=np.array([[0.9, 0.1], [0.0, 1.0]]))
    assert intervals_of(stays_lost) is None
