"""Both links as one chain: against the relay's own draws, against links that are known to share or not to share."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from agv_analysis.link.joint_chain import JointChain, correlated, fitted, independent
from agv_analysis.link.markov_channel import Chain, bernoulli, chain_of
from agv_analysis.run import Floats
from agv_analysis.stability.linear_loop import LinearLoop, kanayama_loop
from agv_analysis.stability.mean_square_two_links import lap_growth
from agv_cloud.parameters import ControllerParameters
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import losses

STEPS = 200_000
INDEPENDENT = ChannelParameters(model="bernoulli", p=0.4)
BURSTY = ChannelParameters(model="gilbert_elliott", p=0.1, r=0.3)
FADING = ChannelParameters(model="gilbert_elliott", p=0.2, r=0.4, h=0.3, k=0.8)
PERIODIC = ChannelParameters(model="burst", n=2)


def straight(kx: float) -> LinearLoop:
    return kanayama_loop(np.ones(1), np.zeros(1), ControllerParameters(kx=kx), 0.005)


def relay(up: ChannelParameters, down: ChannelParameters, share: float, seed: int = 3) -> NDArray[np.int64]:
    """Outcomes 0 .. 3 of the relay's own slots: both delivered, the pose alone, the command alone, neither."""
    return np.asarray(2 * drawn(up, seed, "uplink") + drawn(replace(down, correlation=share), seed, "downlink"))


@cache
def drawn(channel: ChannelParameters, seed: int, stream: str) -> NDArray[np.bool_]:
    """The relay's own outcomes of one link; drawing them takes longer than all else here."""
    return losses(channel, seed, stream, STEPS)


def triples(links: JointChain) -> Floats:
    """Probability of each three outcomes in a row, shape (4, 4, 4)."""
    state = np.linalg.matrix_power(links.transition, 4096).mean(axis=0)
    T, P = links.transition, links.outcomes
    return np.asarray(np.einsum("s,so,st,tp,tu,uq->opq", state, P, T, P, T, P))


@pytest.mark.parametrize("share", [0.0, 0.5, 0.97, 1.0])
@pytest.mark.parametrize(
    ("up", "down"),
    [(INDEPENDENT, FADING), (FADING, INDEPENDENT), (INDEPENDENT, INDEPENDENT), (BURSTY, FADING), (PERIODIC, FADING)],
)
def test_three_slots_in_a_row_are_those_of_the_relay(
    up: ChannelParameters, down: ChannelParameters, share: float
) -> None:
    """Of channels whose numbers mean different things, too: below p lost, below g delivered."""
    chains = [chain_of(channel) for channel in (up, down)]
    assert chains[0] is not None
    assert chains[1] is not None
    links = correlated(chains[0], chains[1], share)
    np.testing.assert_allclose(links.transition.sum(axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(links.outcomes.sum(axis=1), 1.0, rtol=1e-12)
    seen = relay(up, down, share)
    found = np.bincount(16 * seen[:-2] + 4 * seen[1:-1] + seen[2:], minlength=64) / (STEPS - 2)
    np.testing.assert_allclose(found, triples(links).ravel(), atol=0.01)


def test_equal_channels_with_one_fate_are_one_channel() -> None:
    """They never fall out of step, so what could follow if they did does not count: pi B = 0.5 * 10 < 7.5."""
    slow = ChannelParameters(model="gilbert_elliott", p=0.1, r=0.1)
    chain = chain_of(slow)
    assert chain is not None
    assert not np.isin(relay(slow, slow, 1.0), (1, 2)).any()
    together = correlated(chain, chain, 1.0)
    assert lap_growth(straight(25.0), together) < 0.0 < lap_growth(straight(25.0), independent(chain, chain))
    truth = lap_growth(straight(25.0), independent(chain, bernoulli(0.0)))  # a command that is lost with its pose
    assert lap_growth(straight(25.0), together) == pytest.approx(truth, abs=1e-7)


def test_periodic_links_stay_in_step() -> None:
    chain = chain_of(ChannelParameters(model="burst", n=1))
    assert chain is not None
    assert len(independent(chain, chain).transition) == 2
    assert lap_growth(straight(25.0), independent(chain, chain)) < 0.0


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.9, 0.99, 0.999, 1.0])
def test_moments_of_the_relay_s_own_draws(share: float) -> None:
    """E[x_e^2] after 12 steps over 40 000 stretches of the relay's slots, p = .5 on both, K_x = 130, one by one."""
    a, steps = 0.65, 12
    half = ChannelParameters(model="bernoulli", p=0.5)
    seen = relay(half, half, share, seed=9)[1:]
    runs = seen[: len(seen) // steps * steps].reshape(-1, steps)
    x, h, u = np.ones(len(runs)), np.ones(len(runs)), np.zeros(len(runs))
    for outcome in runs.T:
        h = np.where(outcome < 2, x, h)
        u = np.where(outcome % 2 == 0, a * h, u)
        x = x - u
    F, steps_of = np.zeros((4, 9, 9)), []
    for outcome in range(4):
        h_row = [1.0, 0.0, 0.0] if outcome < 2 else [0.0, 1.0, 0.0]
        u_row = [a * value for value in h_row] if outcome % 2 == 0 else [0.0, 0.0, 1.0]
        A = np.array([np.array([1.0, 0.0, 0.0]) - u_row, h_row, u_row])
        F[outcome] = np.kron(A, A)
        steps_of.append(A)
    links = correlated(bernoulli(0.5), bernoulli(0.5), share)
    first = np.array([1.0]) if share == 0.0 else np.array([1.0]) if share == 1.0 else np.array([1.0 - share, share])
    start = np.outer([1.0, 1.0, 0.0], [1.0, 1.0, 0.0]).ravel()
    state = first[:, None] * start
    for _ in range(steps):
        after = np.einsum("so,oij,sj->si", links.outcomes, F, state)
        state = links.transition.T @ after
    truth = float((x**2).mean())
    spread = float((x**2).std()) / math.sqrt(len(runs))
    assert float(state[:, 0].sum()) == pytest.approx(truth, abs=5.0 * spread + 1e-9)


def test_links_that_fail_together_are_seen_in_the_outcomes() -> None:
    """K_x = 130, half of all lost: stable only if they share their fate."""
    half = ChannelParameters(model="bernoulli", p=0.5)
    for share, is_stable in ((1.0, True), (0.97, True), (0.5, False)):
        seen = relay(half, half, share)[:20_000]
        links = fitted(seen >= 2, seen % 2 == 1)
        assert links is not None
        truth = lap_growth(straight(130.0), correlated(bernoulli(0.5), bernoulli(0.5), share))
        assert (truth < 0.0) == is_stable
        assert lap_growth(straight(130.0), links) == pytest.approx(truth, abs=0.02)


def test_independent_links_are_rarely_taken_for_dependent() -> None:
    """At 1 % significance of 100 recordings hardly more than 5, of bursty links."""
    random, dependent = np.random.default_rng(2), 0
    for _ in range(100):
        lost = []
        for _ in range(2):
            u, bad, one = random.random(2000), False, []
            for value in u.tolist():
                bad = value >= 0.3 if bad else value < 0.1
                one.append(bad)
            lost.append(np.array(one))
        dependent += fitted(lost[0], lost[1]) is not None
    assert dependent <= 5


def test_a_fit_of_few_slots_is_a_chain() -> None:
    """What only the last slot shows has a row, too."""
    lost = np.array([False, True, False, True, True, False] * 20 + [True])
    other = lost.copy()
    other[-1] = False
    links = fitted(lost, other)
    assert links is not None
    np.testing.assert_allclose(links.transition.sum(axis=1), 1.0)


def test_a_fleet_s_vehicles_each_share_with_their_own_uplink() -> None:
    """Vehicle 3 of a fleet, correlation 1: its commands are lost with its poses, not with those of the first."""
    for vehicle in (0, 3):
        up = ChannelParameters(model="bernoulli", p=0.3, vehicle=vehicle)
        down = ChannelParameters(model="bernoulli", p=0.3, vehicle=vehicle, correlation=1.0)
        poses, commands = losses(up, 5, "uplink", 2000), losses(down, 5, "downlink", 2000)
        assert (poses == commands).all()
        if vehicle:
            first = losses(ChannelParameters(model="bernoulli", p=0.3), 5, "uplink", 2000)
            assert (commands != first).any()


def test_one_number_decides_both() -> None:
    """Lost below 0.4 on one, delivered below 0.7 on the other: both delivered from 0.4 to 0.7, and so on."""
    links = correlated(bernoulli(0.4), Chain(np.array([[0.5, 0.5], [0.5, 0.5]]), np.array([0.7, 0.7])), 1.0)
    np.testing.assert_allclose(links.outcomes[0], [0.3, 0.3, 0.4, 0.0], atol=1e-12)
