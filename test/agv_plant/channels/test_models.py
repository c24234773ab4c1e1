"""Channel models against their closed forms and against netem: bounds that a wrong model breaks.

The seeds are fixed, so a test passes or fails for good; each bound is five standard deviations of what it bounds, or a
p-value of 1e-4.
"""

from __future__ import annotations

import dataclasses
import math
from itertools import groupby

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import chisquare, norm

from agv_analysis.simulation.channel_outcomes import ChannelRealisation
from agv_plant.channels.bernoulli import bernoulli
from agv_plant.channels.burst import burst
from agv_plant.channels.gilbert_elliott import gilbert_elliott
from agv_plant.channels.perfect import perfect
from agv_plant.channels.registry import MODELS
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import losses
from agv_ros.parameters import build

Outcomes = NDArray[np.bool_]
STEPS = 200_000


def run_lengths(lost: Outcomes, of: bool) -> NDArray[np.int64]:
    """Lengths of the runs of one outcome, without the first and the last run, which may be cut."""
    runs = [(value, sum(1 for _ in group)) for value, group in groupby(lost.tolist())][1:-1]
    return np.array([length for value, length in runs if value == of], dtype=np.int64)


def geometric_fit(lengths: NDArray[np.int64], stay: float) -> float:
    """p-value of run lengths l against P(l) = stay^(l-1) (1 - stay), the tail gathered where fewer than 10 are due."""
    total = len(lengths)
    last = 1 + next(length for length in range(1, 10_000) if total * stay**length < 10.0)
    expected = [stay ** (length - 1) * (1.0 - stay) for length in range(1, last)] + [stay ** (last - 1)]
    found = np.bincount(np.minimum(lengths, last), minlength=last + 1)[1:]
    return float(chisquare(found, total * np.array(expected)).pvalue)


# -- perfect, burst --------------------------------------------------------------------------------------------------


def test_a_perfect_channel_loses_nothing() -> None:
    assert perfect() is False
    assert not losses(ChannelParameters(), 1, "uplink", 1000).any()


@pytest.mark.parametrize("n", [0, 1, 2, 14, 100])
def test_a_periodic_burst_loses_n_after_each_received_one(n: int) -> None:
    lost = losses(ChannelParameters(model="burst", n=n), 1, "uplink", 20 * (n + 1))
    assert lost.tolist() == ([False] + [True] * n) * 20
    assert lost.mean() == n / (n + 1)


@settings(deadline=None, derandomize=True)
@given(st.integers(1, 100), st.integers(1, 100))
def test_a_single_burst_loses_n_from_its_step_on(n: int, start: int) -> None:
    lost = losses(ChannelParameters(model="burst", n=n, start_step=start), 1, "uplink", 300)
    assert np.flatnonzero(lost).tolist() == list(range(start, start + n))


def test_a_burst_from_the_beginning() -> None:
    assert [burst(k, 3, 0) for k in range(5)] == [True, True, True, False, False]
    # A run begins with the AGV known to the edge: slot 0 is not lost.
    lost = losses(ChannelParameters(model="burst", n=3, start_step=0), 1, "uplink", 5)
    assert lost.tolist() == [False, True, True, False, False]


# -- bernoulli -------------------------------------------------------------------------------------------------------


@pytest.mark.no_cover
@pytest.mark.parametrize("p", [0.01, 0.3, 0.5, 0.9])
def test_bernoulli_has_its_loss_rate_and_its_runs(p: float) -> None:
    lost = losses(ChannelParameters(model="bernoulli", p=p), 5, "uplink", STEPS)
    assert abs(lost.mean() - p) < 5.0 * math.sqrt(p * (1.0 - p) / STEPS)
    assert geometric_fit(run_lengths(lost, True), p) > 1e-4
    assert geometric_fit(run_lengths(lost, False), 1.0 - p) > 1e-4


@pytest.mark.parametrize("p", [0.3, 0.7])
def test_a_bernoulli_channel_has_no_memory(p: float) -> None:
    lost = losses(ChannelParameters(model="bernoulli", p=p), 6, "uplink", STEPS).astype(float)
    for lag in (1, 2, 3, 7, 50):
        assert abs(np.corrcoef(lost[:-lag], lost[lag:])[0, 1]) < 5.0 / math.sqrt(STEPS)


def test_bernoulli_at_its_ends() -> None:
    below_one = math.nextafter(1.0, 0.0)
    assert [bernoulli(u, 0.0) for u in (0.0, below_one)] == [False, False]
    assert [bernoulli(u, 1.0) for u in (0.0, below_one)] == [True, True]
    lost = losses(ChannelParameters(model="bernoulli", p=1.0), 1, "uplink", 100)
    assert lost.tolist() == [False] + [True] * 99


# -- gilbert_elliott -------------------------------------------------------------------------------------------------


def netem(u_change: float, u_loss: float, state: int, a1: float, a2: float, a3: float, a4: float) -> tuple[bool, int]:
    """One message in Linux' net/sched/sch_netem.c, loss_gilb_ell(): the names and the order are the kernel's.

    In state good a1 = p is the chance to turn bad and a4 = 1 - k that of a loss, in state bad a2 = r the chance to
    turn good and a3 = h that of a delivery; the state that decides on the loss is the one before the turn.
    """
    lost = False
    after = state
    if state == 0:
        if u_change < a1:
            after = 1
        if u_loss < a4:
            lost = True
    else:
        if u_change < a2:
            after = 0
        if u_loss > a3:
            lost = True
    return lost, after


@settings(deadline=None, derandomize=True, max_examples=300)
@given(
    st.tuples(*[st.floats(0.0, 1.0, exclude_max=True)] * 2), st.integers(0, 1), st.tuples(*[st.floats(0.0, 1.0)] * 4)
)
def test_one_message_is_that_of_netem(u: tuple[float, ...], state: int, prhk: tuple[float, ...]) -> None:
    u_loss, u_change = u
    p, r, h, k = prhk
    # The same uniform number: netem loses below 1 - k in the good state, here above k.
    mirrored = 1.0 - u_loss if state == 0 else u_loss
    if abs(mirrored - (1.0 - k)) < 1e-12 or u_loss == h:
        return  # on the very edge rounding decides
    assert gilbert_elliott(state, u_loss, u_change, p, r, h, k) == netem(u_change, mirrored, state, p, r, h, 1.0 - k)


GILBERT_ELLIOTT = [
    ChannelParameters(model="gilbert_elliott", p=0.02, r=0.2),
    ChannelParameters(model="gilbert_elliott", p=0.1, r=0.1),
    ChannelParameters(model="gilbert_elliott", p=0.3, r=0.9),
    ChannelParameters(model="gilbert_elliott", p=0.05, r=0.1, h=0.4, k=0.98),
    ChannelParameters(model="gilbert_elliott", p=0.5, r=0.02, h=0.9, k=0.5),
]


def hidden_chain(c: ChannelParameters) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Transition matrix of (good, bad), its stationary distribution, and the chance of a loss in each."""
    P = np.array([[1.0 - c.p, c.p], [c.r, 1.0 - c.r]])
    values, vectors = np.linalg.eig(P.T)
    stationary = np.real(vectors[:, np.argmax(values.real)])
    return P, stationary / stationary.sum(), np.array([1.0 - c.k, 1.0 - c.h])


@pytest.mark.no_cover
@pytest.mark.parametrize("c", GILBERT_ELLIOTT, ids=str)
def test_gilbert_elliott_has_its_loss_rate(c: ChannelParameters) -> None:
    P, stationary, chance = hidden_chain(c)
    rate = float(stationary @ chance)
    assert rate == pytest.approx((c.p * (1.0 - c.h) + c.r * (1.0 - c.k)) / (c.p + c.r), rel=1e-12)
    lost = losses(c, 3, "uplink", STEPS)
    # Variance of the mean of a correlated sequence: the autocovariance is geometric with the chain's second eigenvalue.
    second = 1.0 - c.p - c.r
    covariance = float(stationary @ np.diag(chance) @ (P @ chance) - rate**2)
    spread = math.sqrt((rate * (1.0 - rate) + 2.0 * covariance / (1.0 - second)) / STEPS)
    assert abs(lost.mean() - rate) < 5.0 * spread


@pytest.mark.no_cover
@pytest.mark.parametrize("c", GILBERT_ELLIOTT, ids=str)
def test_gilbert_elliott_forgets_with_the_chain_s_second_eigenvalue(c: ChannelParameters) -> None:
    P, stationary, chance = hidden_chain(c)
    second = 1.0 - c.p - c.r
    lost = losses(c, 4, "uplink", STEPS).astype(float)
    for lag in (1, 2, 5, 20):
        both = float(stationary @ np.diag(chance) @ np.linalg.matrix_power(P, lag) @ chance)
        independent = STEPS * (1.0 - abs(second)) / (1.0 + abs(second))
        assert np.mean(lost[:-lag] * lost[lag:]) == pytest.approx(both, abs=5.0 * math.sqrt(both / independent))


@pytest.mark.no_cover
@pytest.mark.parametrize("c", GILBERT_ELLIOTT[:3], ids=str)
def test_gilbert_s_outages_are_geometric_with_mean_1_over_r(c: ChannelParameters) -> None:
    lost = losses(c, 7, "uplink", STEPS)
    outages, gaps = run_lengths(lost, True), run_lengths(lost, False)
    assert geometric_fit(outages, 1.0 - c.r) > 1e-4
    assert geometric_fit(gaps, 1.0 - c.p) > 1e-4
    spread = math.sqrt((1.0 - c.r) / c.r**2 / len(outages))
    assert abs(outages.mean() - 1.0 / c.r) < 5.0 * spread


@pytest.mark.parametrize("c", GILBERT_ELLIOTT[3:], ids=str)
def test_elliott_s_outages_have_the_phase_type_distribution(c: ChannelParameters) -> None:
    # The state at an outage's first slot: after a delivery, and losing. Then P(l) = alpha (P D)^(l-1) P (1 - d) for
    # the chances d of a loss and D = diag(d).
    P, stationary, chance = hidden_chain(c)
    state = stationary @ np.diag(1.0 - chance) @ P @ np.diag(chance)
    state /= state.sum()
    chances = []
    for _ in range(300):
        after = state @ P
        chances.append(float(after @ (1.0 - chance)))
        state = after * chance
    outages = run_lengths(losses(c, 8, "uplink", STEPS), True)
    tail = 1.0 - np.cumsum(chances)
    last = int(np.argmax(len(outages) * tail < 10.0)) + 1
    found = np.bincount(np.minimum(outages, last), minlength=last + 1)[1:]
    expected = np.append(chances[: last - 1], 1.0 - sum(chances[: last - 1]))
    assert chisquare(found, len(outages) * expected).pvalue > 1e-4


def test_gilbert_elliott_with_p_plus_r_one_is_bernoulli() -> None:
    p = 0.3
    lost = losses(ChannelParameters(model="gilbert_elliott", p=p, r=1.0 - p), 9, "uplink", STEPS)
    assert abs(lost.mean() - p) < 5.0 * math.sqrt(p * (1.0 - p) / STEPS)
    assert geometric_fit(run_lengths(lost, True), p) > 1e-4


def test_gilbert_elliott_begins_good_and_reaches_its_balance() -> None:
    # P(bad at slot k) = p / (p + r) (1 - (1 - p - r)^k), over many seeds.
    c = ChannelParameters(model="gilbert_elliott", p=0.05, r=0.2)
    lost = np.array([losses(c, seed, "uplink", 30) for seed in range(300)])
    expected = c.p / (c.p + c.r) * (1.0 - (1.0 - c.p - c.r) ** np.arange(30))
    spread = np.sqrt(expected * (1.0 - expected) / 300)
    assert (abs(lost.mean(axis=0) - expected) <= 5.0 * spread).all()


def test_gilbert_elliott_at_its_ends() -> None:
    def lost(**parameters: float) -> list[bool]:
        channel = build(ChannelParameters, {"model": "gilbert_elliott", **parameters})
        return [bool(one) for one in losses(channel, 1, "uplink", 6)]

    assert lost() == [False] * 6
    assert lost(p=1.0, r=0.0) == [False] + [True] * 5
    assert lost(p=1.0, r=1.0) == [False, True] * 3
    assert lost(p=1.0, r=0.0, h=1.0) == [False] * 6
    assert lost(p=0.0, k=0.0) == [False] + [True] * 5


# -- all of them -----------------------------------------------------------------------------------------------------

EVERY_MODEL = {
    "perfect": ChannelParameters(),
    "bernoulli": ChannelParameters(model="bernoulli", p=0.3),
    "gilbert_elliott": GILBERT_ELLIOTT[3],
    "burst": ChannelParameters(model="burst", n=3),
}


def test_every_model_is_tested_here() -> None:
    assert set(EVERY_MODEL) == set(MODELS)
    assert all(name == parameters.model for name, parameters in EVERY_MODEL.items())


@pytest.mark.parametrize("model", ["bernoulli", "gilbert_elliott"])
def test_streams_and_seeds_are_independent(model: str) -> None:
    steps = 50_000
    sources = [(1, "uplink"), (1, "downlink"), (2, "uplink"), (2, "downlink")]
    lost = np.array([losses(EVERY_MODEL[model], seed, stream, steps) for seed, stream in sources], dtype=float)
    # Correlated in time, so fewer independent samples: a decay of 0.85 a slot leaves (1 - 0.85^2) / (1 + 0.85^2).
    independent = steps if model == "bernoulli" else steps * (1.0 - 0.85**2) / (1.0 + 0.85**2)
    correlation = np.corrcoef(lost) - np.eye(len(sources))
    assert abs(correlation).max() < norm.isf(1e-6) / math.sqrt(independent)


@pytest.mark.parametrize("model", MODELS)
def test_the_same_source_gives_the_same_outcomes(model: str) -> None:
    first, second = (losses(EVERY_MODEL[model], 3, "uplink", 5000) for _ in range(2))
    assert (first == second).all()
    assert not first[0]


# -- the downlink's fate shared with the uplink's ---------------------------------------------------------------------


@pytest.mark.no_cover
@pytest.mark.parametrize("share", [0.0, 0.3, 0.8, 1.0])
def test_a_correlated_downlink_has_its_correlation_and_its_own_loss_rate(share: float) -> None:
    p = 0.3
    up = losses(ChannelParameters(model="bernoulli", p=p), 4, "uplink", STEPS).astype(float)
    down = losses(ChannelParameters(model="bernoulli", p=p, correlation=share), 4, "downlink", STEPS).astype(float)
    assert abs(down.mean() - p) < 5.0 * math.sqrt(p * (1.0 - p) / STEPS)
    assert abs(np.corrcoef(up, down)[0, 1] - share) < 5.0 / math.sqrt(STEPS)
    # Both lost: c p + (1 - c) p^2.
    both = share * p + (1.0 - share) * p * p
    assert abs((up * down).mean() - both) < 5.0 * math.sqrt(both * (1.0 - both) / STEPS)


@pytest.mark.parametrize("model", ["bernoulli", "gilbert_elliott"])
def test_a_downlink_of_the_same_fate_loses_what_the_uplink_loses(model: str) -> None:
    channel = dataclasses.replace(EVERY_MODEL[model], correlation=1.0)
    assert (losses(channel, 2, "downlink", 5000) == losses(EVERY_MODEL[model], 2, "uplink", 5000)).all()
    assert (losses(channel, 2, "uplink", 5000) == losses(EVERY_MODEL[model], 2, "uplink", 5000)).all()


@pytest.mark.parametrize("stream", ["uplink", "downlink"])
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_the_simulation_draws_the_same_correlated_numbers(stream: str, share: float) -> None:
    channel = dataclasses.replace(EVERY_MODEL["gilbert_elliott"], correlation=share)
    assert (ChannelRealisation(7, 9000).outcomes(channel, stream) == losses(channel, 7, stream, 9000)).all()
