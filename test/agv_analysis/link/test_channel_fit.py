"""Intervals of the fitted channel: how often they hold the truth, over recordings of channels that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agv_analysis.link.channel_fit import Estimate, fit_channel
from test.agv_analysis.link.recorded_outcomes import gap_and_outage, gilbert, series

RECORDINGS = 300
LEAST, MOST = 0.92, 0.98


def holds(estimate: Estimate, truth: float) -> bool:
    return estimate.low <= truth <= estimate.high


@pytest.mark.no_cover
@pytest.mark.parametrize(
    ("p", "r", "slots"),
    [(0.001, 0.01, 20_000), (0.01, 0.1, 2000), (0.1, 0.5, 400), (0.5, 0.1, 500), (0.02, 0.98, 2000), (0.3, 0.7, 400)],
)  # the last two: independent losses
def test_intervals_of_loss_rate_and_mean_age_cover(p: float, r: float, slots: int) -> None:
    """Truth in closed form: p / (p + r), and that over r."""
    fits = [fit_channel(lost) for lost in gilbert(p, r, slots, RECORDINGS, seed=5)]
    rate = p / (p + r)
    assert LEAST <= np.mean([holds(fit.loss_rate, rate) for fit in fits]) <= MOST
    assert LEAST <= np.mean([holds(fit.mean_age, rate / r) for fit in fits]) <= MOST


@pytest.mark.no_cover
@pytest.mark.parametrize(("p", "r", "slots"), [(0.001, 0.01, 2000), (0.001, 0.5, 2000), (0.002, 0.02, 1000)])
def test_few_outages_make_intervals_wider_not_wrong(p: float, r: float, slots: int) -> None:
    fits = [fit_channel(lost) for lost in gilbert(p, r, slots, RECORDINGS, seed=6)]
    assert np.mean([holds(fit.loss_rate, p / (p + r)) for fit in fits]) >= LEAST
    assert np.mean([holds(fit.mean_age, p / (p + r) / r) for fit in fits]) >= LEAST


@pytest.mark.no_cover
def test_intervals_cover_where_no_gilbert_channel_fits() -> None:
    """Gaps geometric, outages of 2 or of 30 slots: loss rate and age from the means of L and L^2."""
    rng = np.random.default_rng(7)
    q, long, short = 0.3, 30, 2

    def part() -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        return gap_and_outage(rng.geometric(0.05), long if rng.random() < q else short)

    fits = [fit_channel(series(part, 6000)) for _ in range(200)]
    assert np.mean([fit.goodness.fits for fit in fits]) < 0.1
    lost, slots = q * long + (1 - q) * short, 20.0 + q * long + (1 - q) * short
    age = (q * long * (long + 1) + (1 - q) * short * (short + 1)) / 2.0 / slots
    assert np.mean([holds(fit.loss_rate, lost / slots) for fit in fits]) >= 0.9
    assert np.mean([holds(fit.mean_age, age) for fit in fits]) >= 0.9


def test_an_outage_that_is_still_open_does_not_make_r_zero() -> None:
    lost = np.concatenate((np.zeros(1950, dtype=bool), np.ones(50, dtype=bool)))
    fit = fit_channel(lost)
    assert fit.model == "gilbert_elliott"
    assert 0.0 < fit.chain.transition[1, 0] < 1.0 / 50.0
    assert math.isfinite(fit.mean_burst)


def test_pairs_with_a_step_missing_between_them_are_no_transitions() -> None:
    lost = np.array([False, True, False, True])
    whole, apart = fit_channel(lost), fit_channel(lost, np.array([0, 1, 5, 9]))
    assert (whole.transitions.to_lost, whole.transitions.to_delivered) == (2, 1)
    assert (apart.transitions.to_lost, apart.transitions.to_delivered) == (1, 0)


@pytest.mark.parametrize(("lost", "age"), [(np.zeros(50, dtype=bool), 0.0), (np.ones(50, dtype=bool), math.inf)])
def test_all_or_nothing_lost(lost: np.ndarray[tuple[int], np.dtype[np.bool_]], age: float) -> None:
    fit = fit_channel(lost)
    assert fit.mean_age.value == age
    assert fit.mean_age.low <= age <= fit.mean_age.high
