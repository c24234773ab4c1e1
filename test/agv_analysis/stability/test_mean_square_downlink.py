"""A plant that ramps down where commands are lost: against every sequence of outcomes, special cases, and twins."""

from __future__ import annotations

import dataclasses
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
from agv_analysis.stability import mean_square_downlink, mean_square_two_links
from agv_analysis.stability.evidence import evidence_of_scenario
from agv_analysis.stability.linear_loop import LinearLoop, kanayama_loop
from agv_analysis.stability.mean_square_downlink import with_age_of_command
from agv_analysis.stability.verdict import GREEN, decide
from agv_cloud.parameters import ControllerParameters
from agv_plant.parameters import PlantParameters

PAPER = str(Path(__file__).parents[3] / "config/paper.yaml")
TS = 0.005
LOOP = kanayama_loop(np.full(1, 1.2), np.full(1, 0.3), ControllerParameters(kx=60.0, ky=4.0, ktheta=6.0), TS)
RAMP = PlantParameters(downlink_policy="ramp", ramp_time=3 * TS)


def expected_square(loop: LinearLoop, uplink: Chain, downlink: Chain, ramp: float, steps: int) -> float:
    """E[|z|^2] after some steps from z = h = 1 and their command: the sum over all that both links may do."""
    A, B, L_h = loop.A[0], loop.B[0], loop.L_h[0]
    total = 0.0
    states = list(itertools.product(range(len(uplink.delivery)), range(len(downlink.delivery))))

    def go(k: int, chance: float, i: int, j: int, z: Floats, h: Floats, u: Floats, n: int) -> None:
        nonlocal total
        if chance == 0.0:
            return
        if k == steps:
            total += chance * float(z @ z)
            return
        for pose, command in itertools.product((True, False), repeat=2):
            share = uplink.delivery[i] if pose else 1.0 - uplink.delivery[i]
            share *= downlink.delivery[j] if command else 1.0 - downlink.delivery[j]
            at_edge = z if pose else h
            held, age = (L_h @ at_edge, 0) if command else (u, n + 1)
            moved = A @ z + B @ (max(0.0, 1.0 - age / ramp) * held)
            for i_next, j_next in states:
                after = share * uplink.transition[i, i_next] * downlink.transition[j, j_next]
                go(k + 1, chance * after, i_next, j_next, moved, at_edge, held, age)

    for i, j in states:
        ones = np.ones(3)
        go(0, float(uplink.stationary[i] * downlink.stationary[j]), i, j, ones, ones, L_h @ ones, 0)
    return total


@pytest.mark.parametrize("ramp", [1.0, 2.5, 4.0])
@pytest.mark.parametrize(
    ("uplink", "downlink", "steps"),
    [(bernoulli(0.3), bernoulli(0.6), 5), (bernoulli(0.2), gilbert_elliott(0.2, 0.5), 4)],
)
def test_the_moments_are_those_of_all_that_can_happen(uplink: Chain, downlink: Chain, steps: int, ramp: float) -> None:
    last = math.ceil(ramp)
    links = independent(uplink, downlink)
    transition, outcomes = with_age_of_command(links, last)
    np.testing.assert_allclose(transition.sum(axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(outcomes.sum(axis=1), 1.0, rtol=1e-12)
    maps = [
        mean_square_two_links.step_maps(LOOP, pose, n == 0, max(0.0, 1.0 - n / ramp))[0]
        for pose in (True, False)
        for n in range(last + 1)
    ]
    start = np.concatenate((np.ones(6), LOOP.L_h[0] @ np.ones(3)))
    heard = float(np.kron(uplink.stationary, downlink.stationary) @ (links.outcomes[:, 0] + links.outcomes[:, 2]))
    age = outcomes.argmax(axis=1) % (last + 1)  # a state of these chains is told by it; begun is from one step ago
    moments = np.select([age == 0, age == 1], [heard, 1.0 - heard])[:, None, None] * np.outer(start, start)
    for _ in range(steps):
        after = [
            sum(p * A @ Z @ A.T for p, A in zip(row, maps, strict=True))
            for row, Z in zip(outcomes, moments, strict=True)
        ]
        moments = np.einsum("st,sij->tij", transition, np.array(after))
    found = float(np.trace(moments.sum(axis=0)[:3, :3]))
    assert found == pytest.approx(expected_square(LOOP, uplink, downlink, ramp, steps), rel=1e-12)


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_a_ramp_of_one_step_is_a_stop(share: float) -> None:
    links = correlated(bernoulli(0.4), gilbert_elliott(0.1, 0.3), share)
    found = mean_square_downlink.lap_growth(LOOP, links, dataclasses.replace(RAMP, ramp_time=TS))
    assert found == pytest.approx(mean_square_two_links.lap_growth(LOOP, links, stops=True), abs=1e-6)


def test_states_that_cannot_be_are_left_out() -> None:
    """Behind exactly 30 losses after each command the age is told by where the channel is."""
    cycle = Chain(np.roll(np.eye(31), 1, axis=1), np.eye(31)[0])
    transition, _ = with_age_of_command(independent(bernoulli(0.5), cycle), 10)
    assert transition.shape == (31, 31)


def test_without_losses_of_commands_there_is_no_ramp() -> None:
    links = independent(bernoulli(0.4), bernoulli(0.0))
    found = mean_square_downlink.lap_growth(LOOP, links, RAMP)
    assert found == pytest.approx(mean_square_two_links.lap_growth(LOOP, links), abs=1e-6)


@pytest.mark.parametrize(("p", "kx", "contracts"), [(0.6, 25.0, True), (0.8, 150.0, False)])
def test_simulated_twins_on_both_sides(p: float, kx: float, contracts: bool) -> None:
    """Without a ramp the mean age of 4 steps of the second would be survived up to K_x = 44."""
    wanted = load_scenario(PAPER, [
        "error_detector.track=line", f"plant.initial_pose=[0.0, 0.0, {math.pi / 2}]", "plant.duration=8.0",
        "relay.downlink.model=bernoulli", f"relay.downlink.p={p}", "plant.downlink_policy=ramp",
        "plant.ramp_time=0.1", f"controller.kx={kx}",
    ])  # fmt: skip
    evidence = evidence_of_scenario(wanted)
    assert evidence.growth is not None
    assert (evidence.growth < 0.0) == contracts
    assert (decide(evidence).word in GREEN) == contracts
    square = np.mean(simulate_batch([wanted], range(1, 31), twins=True)["contraction"] ** 2)
    assert (square < 1e-3) if contracts else (square > 1e3)


def test_what_is_not_judged_is_said() -> None:
    assert "not for buffer" in mean_square_downlink.why_not(PlantParameters(downlink_policy="buffer", plan_steps=4))
    assert "up to 200 steps" in mean_square_downlink.why_not(dataclasses.replace(RAMP, ramp_time=60.0))
    links = independent(bernoulli(0.4), bernoulli(0.1))
    with pytest.raises(ValueError, match="up to 200 steps"):
        mean_square_downlink.lap_growth(LOOP, links, dataclasses.replace(RAMP, ramp_time=60.0))
