"""Outage statistics against counting by hand and against the channels' closed forms."""

from __future__ import annotations

import dataclasses
from itertools import groupby

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agv_analysis.metrics.outages import age_statistics, ages, outage_lengths, outages
from agv_analysis.run import Run
from agv_analysis.scenario import parse_scenario
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import losses
from agv_ros.errors import UserError

Outcomes = NDArray[np.bool_]
outcomes = st.lists(st.booleans(), max_size=80).map(lambda values: np.array(values, dtype=np.bool_))


def run_of(lost: Outcomes, downlink_lost: Outcomes | None = None) -> Run:
    """A run with these outcomes and nothing else in it; n_ul counted step by step."""
    n_ul, age = [], 0
    for outcome in lost:
        age = age + 1 if outcome else 0
        n_ul.append(age)
    steps = len(lost)
    return Run(
        scenario=parse_scenario("controller: {ros__parameters: {kx: 25.0}}", "test"),
        k=np.arange(steps),
        pose=np.zeros((steps, 3)),
        reference=np.zeros((steps, 5)),
        error=np.zeros((steps, 3)),
        command=np.zeros((steps, 2)),
        n_ul=np.array(n_ul, dtype=np.int64),
        lost=lost,
        downlink_lost=np.zeros(steps, dtype=np.bool_) if downlink_lost is None else downlink_lost,
    )


def of(text: str) -> Outcomes:
    """Outcomes from a picture: `x` lost, `.` delivered."""
    return np.array([letter == "x" for letter in text], dtype=np.bool_)


def test_outages_counted_by_hand() -> None:
    found = outages(run_of(of("..xx.x..xx.xxx.")))
    assert found.uplink.histogram == {1: 1, 2: 2, 3: 1}
    assert (found.uplink.slots, found.uplink.lost, found.uplink.count) == (15, 8, 4)
    assert found.loss_rate == 8 / 15
    assert found.uplink.mean_burst == 2.0
    assert found.uplink.longest == found.n_ul_max == 3
    assert found.uplink.open_slots == 0
    assert found.downlink.histogram == {}
    assert (found.downlink.longest, found.downlink.mean_burst, found.downlink.loss_rate) == (0, 0.0, 0.0)


def test_an_outage_still_open_at_the_end_counts_and_is_said() -> None:
    found = outages(run_of(of(".x.xxx")))
    assert found.uplink.histogram == {1: 1, 3: 1}
    assert found.uplink.open_slots == 3


def test_an_outage_ends_where_steps_are_missing() -> None:
    run = dataclasses.replace(run_of(of(".xxxx.")), k=np.array([0, 1, 2, 7, 8, 9]))
    assert outages(run).uplink.histogram == {2: 2}


def test_the_downlink_has_outages_of_its_own() -> None:
    found = outages(run_of(of("......"), of("..xx..")))
    assert found.loss_rate == 0.0
    assert found.downlink.histogram == {2: 1}
    assert found.downlink.age.max == 2
    assert found.downlink.age.mean == 0.5


@given(lost=outcomes)
@settings(deadline=None, derandomize=True)
def test_lengths_are_those_of_the_runs_of_losses(lost: Outcomes) -> None:
    expected = [len(list(group)) for outcome, group in groupby(lost.tolist()) if outcome]
    assert outage_lengths(np.arange(len(lost)), lost).tolist() == expected


@given(lost=outcomes, start=st.integers(0, 10_000))
@settings(deadline=None, derandomize=True)
def test_ages_count_from_the_last_reception(lost: Outcomes, start: int) -> None:
    expected, last = [], 0
    for i, outcome in enumerate(lost):
        last = last if outcome else i
        expected.append(i - last)
    assert ages(start + np.arange(len(lost)), lost).tolist() == expected


def test_percentiles_are_ages_that_occurred() -> None:
    age = age_statistics(np.array([0] * 98 + [7, 9]), 0.005)
    assert (age.p50, age.p99, age.max) == (0, 7, 9)
    assert age.seconds == pytest.approx((0.0008, 0.0, 0.035, 0.045))


def test_a_single_slot_is_a_run_and_none_is_not() -> None:
    found = outages(run_of(of(".")))
    assert (found.loss_rate, found.n_ul_max, found.uplink.histogram) == (0.0, 0, {})
    with pytest.raises(UserError, match="simulation: no step"):
        outages(run_of(of("")))


def test_random_losses_have_the_statistics_of_their_closed_form() -> None:
    steps, p, r = 100_000, 0.02, 0.2
    channel = ChannelParameters(model="gilbert_elliott", p=p, r=r)
    found = outages(run_of(losses(channel, 3, "uplink", steps))).uplink
    rate, burst = p / (p + r), 1.0 / r
    assert found.loss_rate == pytest.approx(rate, rel=0.1)
    assert found.mean_burst == pytest.approx(burst, rel=0.05)
    # An age of j happens with probability pi (1 - r)^(j-1) r, j >= 1 ... summed over its tail: E[n] = pi B.
    assert found.age.mean == pytest.approx(rate * burst, rel=0.15)
