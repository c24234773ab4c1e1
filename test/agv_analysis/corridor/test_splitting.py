"""Importance splitting on events whose probability is computed exactly, by the chain of channel state and age."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agv_analysis.corridor.splitting import REPLICATES, Work, age_levels, rate_of, tail_rate
from agv_analysis.link.channel_fit import Estimate
from agv_analysis.link.markov_channel import Chain, bernoulli, gilbert_elliott


def exact(chain: Chain, longest: int, slots: int) -> float:
    """P(more than `longest` losses in a row within so many slots), the channel good and slot 0 received."""
    by_age = np.zeros((longest + 1, len(chain.delivery)))
    by_age[0, 0], seen = 1.0, 0.0
    for k in range(slots):
        delivery = chain.delivery if k else np.ones(len(chain.delivery))
        lost = (by_age * (1.0 - delivery)) @ chain.transition
        by_age[0] = (by_age * delivery).sum(axis=0) @ chain.transition
        by_age[1:] = lost[:-1]
        seen += float(lost[-1].sum())
    return seen


def within(rate: Estimate, slots: int) -> Estimate:
    return Estimate(*(-math.expm1(-value * slots) for value in (rate.value, rate.low, rate.high)))


@pytest.mark.parametrize(
    ("chain", "longest", "first"),
    [(gilbert_elliott(0.02, 0.2), 120, 8), (bernoulli(0.1), 12, 2), (gilbert_elliott(0.05, 0.3, 0.2, 0.99), 60, 6)],
    ids=["gilbert", "independent", "gilbert-elliott"],
)
def test_runs_of_losses_that_hardly_ever_come(chain: Chain, longest: int, first: int) -> None:
    """Down to 1e-9 and below, with an interval no wider than a factor of 1.5."""
    levels = age_levels(chain, longest + 1, first)
    found = rate_of([0] * REPLICATES, 0, chain, levels, Work(50_000, 1500, 10_000), seed=2)
    p, truth = within(found.per_slot, 20_000), exact(chain, longest, 20_000)
    assert truth < 2e-8
    assert p.low <= truth <= p.high <= 1.5 * p.low
    assert found.ended == 0


@pytest.mark.parametrize(
    ("chain", "longest", "first", "slots"),
    [(gilbert_elliott(0.02, 0.2), 57, 8, 20_000), (bernoulli(0.05), 5, 1, 50_000)],
    ids=["gilbert", "independent"],
)
def test_intervals_hold_the_truth_as_often_as_they_say(chain: Chain, longest: int, first: int, slots: int) -> None:
    """Even with so few runs that an estimate is good to a factor of 1.4 and 1.8 only."""
    truth, levels = exact(chain, longest, slots), age_levels(chain, longest + 1, first)
    assert 5e-4 < truth < 2e-3
    found = [rate_of([0] * REPLICATES, 0, chain, levels, Work(5000, 100, 10_000), seed).per_slot for seed in range(300)]
    assert 276 <= sum(p.low <= truth <= p.high for p in (within(rate, slots) for rate in found)) <= 294


def test_a_level_that_hardly_any_run_reaches_leaves_the_rate_unknown() -> None:
    chain = bernoulli(0.05)
    found = rate_of([0] * REPLICATES, 0, chain, [1.0, 8.0], Work(2000, 50, 1000), seed=1).per_slot
    assert (found.value, found.low, found.high) == (0.0, 0.0, 1.0)


def test_the_same_seed_gives_the_same_estimate() -> None:
    chain = gilbert_elliott(0.1, 0.5)
    one, other = (rate_of([0] * REPLICATES, 0, chain, [2.0, 5.0], Work(2000, 50, 1000), seed=7) for _ in range(2))
    assert one == other


def test_the_tail_of_outages_falls_as_the_chain_says() -> None:
    assert tail_rate(gilbert_elliott(0.02, 0.2)) == pytest.approx(0.8)
    assert tail_rate(bernoulli(0.3)) == pytest.approx(0.3)
