"""Losses on both links: against every sequence of outcomes, against one link alone, and against the loop driven."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.link.joint_chain import correlated, independent
from agv_analysis.link.markov_channel import Chain, bernoulli, gilbert_elliott
from agv_analysis.run import Floats
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate_batch
from agv_analysis.stability import mean_square, mean_square_two_links
from agv_analysis.stability.linear_loop import LinearLoop, kanayama_loop
from agv_analysis.stability.margins import margins
from agv_cloud.parameters import ControllerParameters
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import losses

PAPER = str(Path(__file__).parents[3] / "config/paper.yaml")
TS = 0.005
GAINS = ControllerParameters(kx=60.0, ky=4.0, ktheta=6.0)
ONE = kanayama_loop(np.full(1, 1.2), np.full(1, 0.3), GAINS, TS)
WRONGLY_PREDICTED = kanayama_loop(np.full(1, 1.2), np.full(1, 0.3), GAINS, TS, True, 1.4)


def straight(by: ControllerParameters) -> LinearLoop:
    return kanayama_loop(np.ones(1), np.zeros(1), by, TS)


def expected_square(loop: LinearLoop, uplink: Chain, downlink: Chain, stops: bool, steps: int) -> float:
    """E[|e|^2] after some steps from e = h = 1 and their command, channels stationary: the sum over all possibilities.

    The plant acts on the error c that its command was computed from.
    """
    F, G, H = loop.F[0], loop.G[0], None if loop.H is None else loop.H[0]
    total = 0.0
    states = list(itertools.product(range(len(uplink.delivery)), range(len(downlink.delivery))))

    def go(k: int, chance: float, i: int, j: int, e: Floats, h: Floats, c: Floats) -> None:
        nonlocal total
        if chance == 0.0:
            return
        if k == steps:
            total += chance * float(e @ e)
            return
        for u, d in itertools.product((True, False), repeat=2):
            share = uplink.delivery[i] if u else 1.0 - uplink.delivery[i]
            share *= downlink.delivery[j] if d else 1.0 - downlink.delivery[j]
            at_edge = e if u else h
            at_plant = at_edge if d else np.zeros_like(c) if stops else c
            e_next, h_next = F @ e + G @ at_plant, at_edge if H is None else H @ at_edge
            for i_next, j_next in states:
                after = share * uplink.transition[i, i_next] * downlink.transition[j, j_next]
                go(k + 1, chance * after, i_next, j_next, e_next, h_next, at_plant)

    for i, j in states:
        ones = np.ones(len(F))
        go(0, float(uplink.stationary[i] * downlink.stationary[j]), i, j, ones, ones, ones)
    return total


@pytest.mark.parametrize("stops", [False, True])
@pytest.mark.parametrize("loop", [ONE, WRONGLY_PREDICTED], ids=["held", "predicted"])
@pytest.mark.parametrize(
    ("uplink", "downlink", "steps"),
    [(bernoulli(0.3), bernoulli(0.6), 5), (gilbert_elliott(0.2, 0.5), bernoulli(0.4), 4)],
)
def test_the_moments_are_those_of_all_that_can_happen(
    stops: bool, loop: LinearLoop, uplink: Chain, downlink: Chain, steps: int
) -> None:
    maps = [
        mean_square_two_links.step_maps(loop, u, d, float(not stops))[0]
        for u, d in itertools.product((True, False), repeat=2)
    ]
    transition, probabilities = independent(uplink, downlink)
    start = np.concatenate((np.ones(6), loop.L_h[0] @ np.ones(3)))
    moments = np.kron(uplink.stationary, downlink.stationary)[:, None, None] * np.outer(start, start)
    for _ in range(steps):
        after = [
            sum(p * A @ Z @ A.T for p, A in zip(row, maps, strict=True))
            for row, Z in zip(probabilities, moments, strict=True)
        ]
        moments = np.einsum("st,sij->tij", transition, np.array(after))
    found = float(np.trace(moments.sum(axis=0)[:3, :3]))
    truth = expected_square(loop, uplink, downlink, stops, steps)
    assert found == pytest.approx(truth, rel=1e-12)


@pytest.mark.parametrize("chain", [bernoulli(0.7), gilbert_elliott(0.1, 0.2)])
def test_one_link_alone(chain: Chain) -> None:
    """Of a command that is held it does not matter on which link it was lost."""
    truth = math.log(mean_square.spectral_radius(*mean_square.step_maps(ONE), chain))
    for links in (independent(chain, bernoulli(0.0)), independent(bernoulli(0.0), chain)):
        assert mean_square_two_links.lap_growth(ONE, links) == pytest.approx(truth, abs=1e-7)


def test_the_lap_and_the_matrix_agree() -> None:
    """Two implementations: the recursion along a lap and the matrix of it."""
    speeds = np.full(2000, 1.2), np.full(2000, 0.3)
    links = independent(bernoulli(0.5), gilbert_elliott(0.1, 0.3))
    truth = 2000 * mean_square_two_links.lap_growth(ONE, links)
    speeds[0][-1] = np.nextafter(1.2, 2.0)  # not constant, so that the lap is driven
    found = mean_square_two_links.lap_growth(kanayama_loop(*speeds, GAINS, TS), links)
    assert found == pytest.approx(truth, rel=1e-6)


def test_a_plant_that_stops_at_every_loss_of_everything_is_open() -> None:
    found = mean_square_two_links.lap_growth(straight(GAINS), independent(bernoulli(0.0), bernoulli(1.0)), stops=True)
    assert found == pytest.approx(0.0, abs=0.05)  # an error that stays, or grows as k^2 across


@pytest.mark.parametrize(("p", "contracts"), [(0.6, True), (0.95, False)])
def test_simulated_twins_on_both_sides_of_the_border(p: float, contracts: bool) -> None:
    """Equal independent losses on both links of a straight track, K_x = 25: the border lies between."""
    wanted = load_scenario(PAPER, [
        "error_detector.track=line", f"plant.initial_pose=[0.0, 0.0, {math.pi / 2}]", "plant.duration=20.0",
        "relay.uplink.model=bernoulli", f"relay.uplink.p={p}",
        "relay.downlink.model=bernoulli", f"relay.downlink.p={p}",
    ])  # fmt: skip
    growth = mean_square_two_links.lap_growth(straight(wanted.controller), independent(bernoulli(p), bernoulli(p)))
    assert (growth < 0.0) == contracts
    square = np.mean(simulate_batch([wanted], range(1, 101), twins=True)["contraction"] ** 2)
    assert (square < 1e-3) if contracts else (square > 1e3)


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_links_that_share_random_numbers_lose_as_those_of_the_relay(share: float) -> None:
    """Rates of the outcomes of one slot and of two slots in a row, in 400 000 slots; five standard errors are 0.006."""
    up = ChannelParameters(model="gilbert_elliott", p=0.2, r=0.4, h=0.1, k=0.95)
    down = ChannelParameters(model="gilbert_elliott", p=0.3, r=0.5, h=0.0, k=0.9, correlation=share)
    lost = [losses(channel, 5, stream, 400_000) for channel, stream in ((up, "uplink"), (down, "downlink"))]
    seen = 2 * lost[0] + lost[1]
    chains = gilbert_elliott(0.2, 0.4, 0.1, 0.95), gilbert_elliott(0.3, 0.5, 0.0, 0.9)
    transition, outcomes = correlated(*chains, share)
    np.testing.assert_allclose(transition.sum(axis=1), 1.0, rtol=1e-12)
    stationary = np.linalg.matrix_power(transition, 1000)[0]
    once = stationary @ outcomes
    np.testing.assert_allclose(np.bincount(seen, minlength=4) / 400_000, once, atol=0.006)
    twice = np.einsum("s,so,st,tq->oq", stationary, outcomes, transition, outcomes)
    found = np.bincount(4 * seen[:-1] + seen[1:], minlength=16) / 399_999
    np.testing.assert_allclose(found, twice.ravel(), atol=0.006)


def test_links_that_share_nearly_nothing_are_nearly_independent() -> None:
    chains = gilbert_elliott(0.2, 0.4), bernoulli(0.3)
    truth = mean_square_two_links.lap_growth(ONE, independent(*chains))
    assert mean_square_two_links.lap_growth(ONE, correlated(*chains, 0.0)) == truth
    assert mean_square_two_links.lap_growth(ONE, correlated(*chains, 1e-9)) == pytest.approx(truth, abs=1e-7)


def test_links_that_fail_together_are_easier_to_bear() -> None:
    """Half of all lost on both: K_x between the borders, stable only if they share their fate; twins confirm it."""
    loop = straight(ControllerParameters(kx=130.0))
    chains = bernoulli(0.5), bernoulli(0.5)
    apart, together = (mean_square_two_links.lap_growth(loop, correlated(*chains, share)) for share in (0.0, 1.0))
    assert together < -0.005 < 0.1 < apart
    settings = [
        "error_detector.track=line", "controller.kx=130.0", f"plant.initial_pose=[0.0, 0.0, {math.pi / 2}]",
        "plant.duration=0.25", "relay.uplink.model=bernoulli", "relay.uplink.p=0.5", "relay.downlink.model=bernoulli",
        "relay.downlink.p=0.5",
    ]  # fmt: skip
    scenarios = [load_scenario(PAPER, [*settings, f"relay.downlink.correlation={share}"]) for share in (0.0, 1.0)]
    of_apart, of_together = (simulate_batch(scenarios, range(1, 2001), twins=True)["contraction"] ** 2).mean(axis=1)
    assert of_together < 0.5
    assert of_apart > 5.0


def test_the_margins_have_it_where_commands_are_lost() -> None:
    lossy = ("relay.uplink.model=bernoulli", "relay.uplink.p=0.5", "relay.downlink.model=bernoulli")
    line = ("error_detector.track=line", "relay.downlink.p=0.6")
    found = margins(load_scenario(PAPER, [*lossy, *line]))
    links = independent(bernoulli(0.5), bernoulli(0.6))
    truth = mean_square_two_links.lap_growth(straight(ControllerParameters()), links)
    assert found.both_links == pytest.approx(truth, abs=1e-6)
    assert found.to_json()["both_links"] == {"mean_square_growth": found.both_links}


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        (["plant.downlink_policy=ramp", "plant.ramp_time=60.0"], "up to 200 steps"),
        (["relay.downlink.p=0.0"], "loses nothing"),
    ],
)
def test_where_there_is_no_answer_there_is_a_reason(settings: list[str], reason: str) -> None:
    line = ("error_detector.track=line", "relay.downlink.model=bernoulli", "relay.downlink.p=0.6")
    found = margins(load_scenario(PAPER, [*line, *settings]))
    assert found.both_links is None
    assert reason in found.to_json()["both_links"]["mean_square_growth_reason"]
