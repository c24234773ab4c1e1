"""Channels as Markov chains against closed forms and against long runs of the channels themselves."""

from __future__ import annotations

import math
from itertools import groupby

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agv_analysis.link.markov_channel import Chain, bernoulli, bursty, chain_of, gilbert_elliott, shortest_mean_burst
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import losses
from agv_ros.parameters import build

probability = st.floats(0.01, 0.99)


def ages(lost: NDArray[np.bool_]) -> NDArray[np.int64]:
    """n_ul by the recursion: 0 at a reception, one more than before at a loss."""
    found, n = [], 0
    for is_lost in lost.tolist():
        n = n + 1 if is_lost else 0
        found.append(n)
    return np.array(found)


@pytest.mark.no_cover
@pytest.mark.parametrize(
    "channel",
    [
        {"model": "bernoulli", "p": 0.3},
        {"model": "gilbert_elliott", "p": 0.05, "r": 0.2},
        {"model": "gilbert_elliott", "p": 0.1, "r": 0.3, "h": 0.4, "k": 0.95},
        {"model": "burst", "n": 6},
    ],
)
def test_figures_of_the_channel_itself(channel: dict[str, object]) -> None:
    """Over 300 000 slots; the bounds are some five standard deviations wide for the model with the longest memory."""
    parameters = build(ChannelParameters, channel, "test")
    chain = chain_of(parameters)
    assert chain is not None
    lost = losses(parameters, 3, "uplink", 300_000)
    bursts = [sum(1 for _ in group) for is_lost, group in groupby(lost.tolist()) if is_lost]
    assert chain.loss_rate == pytest.approx(lost.mean(), rel=0.03)
    assert chain.mean_burst == pytest.approx(np.mean(bursts), rel=0.03)
    assert chain.mean_age == pytest.approx(ages(lost).mean(), rel=0.06)
    lengths = np.diff(np.flatnonzero(~lost))
    expected = chain.burst_lengths()
    for length in range(1, min(6, len(expected)) + 1):
        assert expected[length - 1] == pytest.approx((lengths == length).mean(), abs=0.006)


@settings(deadline=None, derandomize=True)
@given(probability)
def test_independent_losses(p: float) -> None:
    chain = bernoulli(p)
    assert chain.loss_rate == pytest.approx(p)
    assert chain.mean_burst == pytest.approx(1.0 / (1.0 - p))
    assert chain.mean_age == pytest.approx(p / (1.0 - p))
    lengths = chain.burst_lengths()
    assert lengths[:2] == pytest.approx([1.0 - p, p * (1.0 - p)])
    assert lengths.sum() == pytest.approx(1.0, abs=1e-13)


@settings(deadline=None, derandomize=True)
@given(probability, probability)
def test_gilbert(p: float, r: float) -> None:
    """Loss rate p / (p + r), geometric bursts of mean 1 / r, so that E[n_ul] = loss rate times mean burst."""
    chain = gilbert_elliott(p, r)
    assert chain.stationary == pytest.approx([r / (p + r), p / (p + r)])
    assert chain.loss_rate == pytest.approx(p / (p + r))
    assert chain.mean_burst == pytest.approx(1.0 / r)
    assert chain.mean_age == pytest.approx(p / (p + r) / r)
    same = bursty(chain.loss_rate, chain.mean_burst)
    np.testing.assert_allclose(same.transition, chain.transition, atol=1e-12)


@settings(deadline=None, derandomize=True)
@given(probability, probability, probability, probability)
def test_the_mean_interval_is_one_over_the_delivery_rate(p: float, r: float, h: float, k: float) -> None:
    """Kac's lemma, for any stationary chain; and E[n_ul] is the mean of L (L - 1) / 2 per interval over that of L."""
    chain = gilbert_elliott(p, r, h, k)
    probabilities = chain.burst_lengths()
    lengths = np.arange(1, len(probabilities) + 1)
    mean = probabilities @ lengths
    assert probabilities.sum() == pytest.approx(1.0, abs=1e-12)
    assert mean == pytest.approx(1.0 / (1.0 - chain.loss_rate), rel=1e-9)
    assert chain.mean_age == pytest.approx(probabilities @ (lengths * (lengths - 1.0) / 2.0) / mean, rel=1e-9)


@pytest.mark.parametrize("n", [0, 1, 5, 30])
def test_periodic_bursts(n: int) -> None:
    chain = chain_of(ChannelParameters(model="burst", n=n))
    assert chain is not None
    assert chain.loss_rate == pytest.approx(n / (n + 1))
    assert chain.mean_burst == pytest.approx(n)
    assert chain.mean_age == pytest.approx(n / 2.0)
    np.testing.assert_allclose(chain.burst_lengths(), np.eye(n + 1)[n], atol=1e-12)


def test_nothing_and_everything_lost() -> None:
    nothing, everything = bernoulli(0.0), bernoulli(1.0)
    assert (nothing.loss_rate, nothing.mean_burst, nothing.mean_age) == (0.0, 0.0, 0.0)
    assert nothing.burst_lengths().tolist() == [1.0]
    assert (everything.loss_rate, everything.mean_age) == (1.0, math.inf)
    assert Chain(np.eye(2)[::-1].copy(), np.zeros(2)).mean_age == math.inf


@pytest.mark.parametrize(("loss_rate", "shortest"), [(0.1, 1.0), (0.5, 1.0), (0.8, 4.0)])
def test_receptions_last_a_slot_at_least(loss_rate: float, shortest: float) -> None:
    assert shortest_mean_burst(loss_rate) == pytest.approx(shortest)
    chain = bursty(loss_rate, shortest_mean_burst(loss_rate))
    assert chain.transition.min() >= 0.0
    assert chain.loss_rate == pytest.approx(loss_rate)


def test_a_perfect_channel_and_an_outage_that_ends() -> None:
    perfect = chain_of(ChannelParameters(model="perfect"))
    assert perfect is not None
    assert perfect.loss_rate == 0.0
    once = chain_of(ChannelParameters(model="burst", n=50, start_step=100))
    assert once is not None
    assert once.loss_rate == 0.0
