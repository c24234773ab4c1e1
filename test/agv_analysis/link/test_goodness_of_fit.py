"""Tests of fit: against scipy, by counting all compositions, and by how often they reject what is true."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from agv_analysis.link.chi_square import chi_square_tail
from agv_analysis.link.goodness_of_fit import SIGNIFICANCE, geometric_p_value, goodness_of_fit, goodness_of_intervals
from agv_analysis.link.heavy_tail import tail_is_heavy
from agv_analysis.link.periodic_outages import period_of
from agv_analysis.link.reception_intervals import Intervals, reception_intervals
from test.agv_analysis.link.recorded_outcomes import gap_and_outage, gilbert, series

EMPTY = np.zeros(0, dtype=np.int64)


@pytest.mark.parametrize("degrees", range(1, 12))
@pytest.mark.parametrize("x", [0.0, 0.1, 1.0, 5.0, 60.0])
def test_the_chi_square_tail_is_that_of_scipy(x: float, degrees: int) -> None:
    stats = pytest.importorskip("scipy.stats")
    assert chi_square_tail(x, degrees) == pytest.approx(stats.chi2.sf(x, degrees), rel=1e-9)


@pytest.mark.parametrize("hit", [0.5, 0.2, 0.01])
def test_lengths_that_are_geometric_get_p_values_that_are_uniform(hit: float) -> None:
    rng = np.random.default_rng(1)
    found = np.array([geometric_p_value(rng.geometric(hit, 200)) for _ in range(500)])
    for level in (0.05, 0.25, 0.5, 0.75):  # within 3.5 standard deviations
        assert abs(np.mean(found < level) - level) < 3.5 * np.sqrt(level * (1 - level) / 500)


def test_the_longest_length_has_the_probability_that_counting_gives() -> None:
    """All ways to write 12 as 4 lengths are equally likely; the bound is exact where two cannot be so long."""
    ways = [w for w in itertools.product(range(1, 10), repeat=4) if sum(w) == 12]
    found = goodness_of_intervals(Intervals(EMPTY, EMPTY == 1, np.array([7, 2, 1, 2]), EMPTY, 0, 0)).longest_outage
    assert found == pytest.approx(np.mean([max(w) >= 7 for w in ways]), rel=1e-9)


@pytest.mark.no_cover
@pytest.mark.parametrize(("p", "r", "slots"), [(0.01, 0.1, 6000), (0.001, 0.01, 20_000), (0.05, 0.95, 5000)])
def test_a_gilbert_channel_is_rejected_as_seldom_as_it_should_be(p: float, r: float, slots: int) -> None:
    """11 or more of 400 at 1 % have probability 0.003."""
    k = np.arange(slots)
    rejected = [not goodness_of_fit(k, lost).fits for lost in gilbert(p, r, slots, 400, seed=3)]
    assert sum(rejected) <= 10


@pytest.mark.parametrize("seed", range(3))
def test_outages_of_two_kinds_are_rejected(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lost = series(lambda: gap_and_outage(rng.geometric(0.1), 60 if rng.random() < 0.05 else 1), 10_000)
    p_value = goodness_of_fit(np.arange(10_000), lost).p_value
    assert p_value is not None
    assert p_value < SIGNIFICANCE / 100


@pytest.mark.parametrize("seed", range(3))
def test_a_channel_whose_state_changes_slowly_is_rejected(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lost = series(lambda: rng.random(rng.geometric(1 / 500)) < rng.choice([0.01, 0.3]), 20_000)
    assert not goodness_of_fit(np.arange(20_000), lost).fits


def test_an_open_outage_longer_than_all_others_is_rejected() -> None:
    rng = np.random.default_rng(0)
    lost = np.concatenate((rng.random(14_000) < 0.05, np.ones(6000, dtype=bool)))
    p_value = goodness_of_fit(np.arange(20_000), lost).longest_outage
    assert p_value is not None
    assert p_value < 1e-9


@pytest.mark.parametrize("seed", range(20))
def test_intervals_are_those_of_a_plain_loop(seed: int) -> None:
    """Slot by slot, with steps missing."""
    rng = np.random.default_rng(seed)
    k = np.flatnonzero(rng.random(60) < 0.9)
    lost = rng.random(len(k)) < 0.4
    between: list[int] = []
    outages: list[int] = []
    gaps: list[int] = []
    open_lengths = {True: [0], False: [0]}
    for piece in np.split(np.arange(len(k)), np.flatnonzero(np.diff(k) != 1) + 1):
        runs = [(key, len(list(group))) for key, group in itertools.groupby(bool(lost[i]) for i in piece)]
        for i, (is_lost, length) in enumerate(runs):
            if 0 < i < len(runs) - 1:
                (outages if is_lost else gaps).append(length)
            else:
                open_lengths[is_lost].append(length)
        received = [int(i) for i in piece if not lost[i]]
        between += [b - a for a, b in itertools.pairwise(received)]
    found = reception_intervals(k, lost)
    assert found.between_receptions.tolist() == between
    assert (found.outages.tolist(), found.gaps.tolist()) == (outages, gaps)
    assert (found.longest_open, found.longest_open_gap) == (max(open_lengths[True]), max(open_lengths[False]))


@pytest.mark.parametrize(
    ("pattern", "period"), [([0, 1], 2), ([0, 0, 1, 1, 1], 5), ([0, 1, 0, 0, 1, 1], 6), ([0], None), ([1], None)]
)
def test_the_period_of_outages(pattern: list[int], period: int | None) -> None:
    lost = np.resize(np.array(pattern, dtype=bool), 101)
    assert period_of(np.arange(101), lost) == period
    assert period_of(np.arange(101) + (np.arange(101) > 50), lost) is None  # a step is missing
    if period is not None:  # the first pose is known, whatever the link does
        begun = np.concatenate(([False], lost))
        assert period_of(np.arange(102), begun) == period
    if period is not None:
        lost[50] = ~lost[50]
        assert period_of(np.arange(101), lost) is None


@pytest.mark.no_cover
def test_a_tail_without_a_second_moment_is_told_from_a_geometric_one() -> None:
    rng = np.random.default_rng(2)
    assert np.mean([tail_is_heavy(np.ceil(rng.random(100) ** (-1 / 1.5)).astype(int)) for _ in range(100)]) > 0.9
    assert np.mean([tail_is_heavy(rng.geometric(0.1, 100), 1.0) for _ in range(300)]) < 0.08
    assert not tail_is_heavy(rng.choice([1, 60], 200, p=[0.8, 0.2]))
