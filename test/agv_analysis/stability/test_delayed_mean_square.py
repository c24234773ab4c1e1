"""Late and lost poses: against every sequence of outcomes, the relay's own ages, special cases, and twins."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.link.age_chain import (
    AgeChain,
    age_chain_of,
    behind_constant_delay,
    fitted_ages,
    late,
    slots_under_way,
)
from agv_analysis.link.markov_channel import Chain, bernoulli, gilbert_elliott
from agv_analysis.run import Floats
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate, simulate_batch
from agv_analysis.stability import delayed_mean_square, floquet, mean_square
from agv_analysis.stability.analysis import analyse
from agv_analysis.stability.linear_loop import LinearLoop, kanayama_loop
from agv_analysis.stability.margins import margins
from agv_cloud.parameters import ControllerParameters
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import Channel
from agv_plant.radio.delay import soonest

PAPER = str(Path(__file__).parents[3] / "config/paper.yaml")
TS = 0.005


def loop_of(kx: float = 25.0, v: float = 1.2, w: float = 0.3) -> LinearLoop:
    return kanayama_loop(np.array([v]), np.array([w]), ControllerParameters(kx=kx, ky=4.0, ktheta=6.0), TS)


WRONGLY_PREDICTED = kanayama_loop(
    np.array([1.2]), np.array([0.3]), ControllerParameters(kx=60.0, ky=4.0, ktheta=6.0), TS, True, 1.4
)


def moments_after(loop: LinearLoop, ages: AgeChain, first: int, steps: int) -> float:
    """E[|z|^2] after some steps from z = y = 1, by the matrices A_i written out."""
    m, D = loop.size, ages.oldest
    size = m + m * (D + 1)
    F, G, state = loop.F[0], loop.G[0], np.zeros((len(ages.moves), size, size))
    state[first] = 1.0
    for _ in range(steps):
        after = np.zeros_like(state)
        for s, arrival, t in np.argwhere(ages.moves > 0.0):
            A = np.zeros((size, size))
            answered = slice(size - m, size) if arrival == D + 1 else slice(m * arrival, m * (arrival + 1))
            A[:m, :m] = F
            A[:m, answered] += G
            for i in range(D):
                A[m * (i + 1) : m * (i + 2), m * i : m * (i + 1)] = np.eye(m)
            A[size - m :, answered] = np.eye(m)
            after[t] += ages.moves[s, arrival, t] * A @ state[s] @ A.T
        state = after
    return float(np.trace(state.sum(axis=0)[:m, :m]))


def expected_square(loop: LinearLoop, slots: Floats, p: float, steps: int) -> float:
    """E[|z|^2] over all that can happen to the messages of some steps: each lost, or so many slots under way.

    The edge answers from the freshest that it has; before the first the error was 1 and known.
    """
    F, G, total = loop.F[0], loop.G[0], 0.0
    fates = [(None, p), *((d, (1.0 - p) * f) for d, f in enumerate(slots))]
    for fate in itertools.product(fates, repeat=steps):
        chance = math.prod(share for _, share in fate)
        if chance == 0.0:
            continue
        errors = [np.ones(loop.size)]
        for k in range(steps):
            arrived = [j for j, (d, _) in enumerate(fate[: k + 1]) if d is not None and j + d <= k]
            held = errors[max(arrived)] if arrived else np.ones(loop.size)
            errors.append(F @ errors[-1] + G @ held)
        total += chance * float(errors[-1] @ errors[-1])
    return total


def expected_square_of_predicted(loop: LinearLoop, chain: Chain, delay: int, steps: int) -> float:
    """The same where the edge moves each pose on anew from when it was taken, under the commands that it sent since.

    What is not lost is `delay` slots under way. The first pose, of z = 1, is known; the channel begins stationary.
    """
    A, B, D, L_h, L_z, P_h, P_u = (
        rows[0] for rows in (loop.A, loop.B, loop.D, loop.L_h, loop.L_z, loop.P_h, loop.P_u) if rows is not None
    )
    total = 0.0
    states = range(len(chain.delivery))
    for fate in itertools.product((False, True), repeat=steps):
        share = np.array(chain.stationary)
        for lost in fate:
            share = (share * np.where(lost, 1.0 - chain.delivery, chain.delivery)) @ chain.transition
        chance = float(sum(share[s] for s in states))
        if chance == 0.0:
            continue
        z = [np.ones(loop.size)]
        commands: list[Floats] = []
        for k in range(steps):
            freshest = max([0, *(j for j in range(k + 1 - delay) if not fate[j])])
            h = z[freshest][: loop.outputs]
            for u in commands[freshest:]:
                h = P_h @ h + P_u @ u
            commands.append(L_h @ h + L_z @ z[-1])
            z.append(A @ z[-1] + B @ commands[-1] + D @ h)
        total += chance * float(z[-1] @ z[-1])
    return total


@pytest.mark.parametrize("delay", [0, 1, 3])
@pytest.mark.parametrize("chain", [bernoulli(0.4), gilbert_elliott(0.2, 0.5)])
def test_what_a_wrong_model_makes_of_late_poses_is_that_of_all_that_can_happen(chain: Chain, delay: int) -> None:
    """The step from k to k + 1 of the product's recursion, from the pose of step 0 on, which all that is held is of."""
    loop, ages, steps = WRONGLY_PREDICTED, behind_constant_delay(chain, delay), 9
    m, q, D = loop.size, loop.outputs, ages.oldest
    size = m + q * (D + 1)
    assert loop.P_h is not None
    assert loop.P_u is not None
    parts = loop.A[0], loop.B[0], loop.D[0], loop.L_h[0], loop.L_z[0], loop.P_h[0], loop.P_u[0]
    maps = np.zeros((D + 2, size, size))
    for arrival in range(D + 2):
        delayed_mean_square._step_of_predicted(*parts, arrival, maps[arrival])
    start = np.ones(size)
    moments = np.zeros((len(chain.delivery), size, size))
    moments[:] = chain.stationary[:, None, None] * np.outer(start, start)
    known = expected_square_of_predicted(loop, chain, delay, steps)
    for k in range(steps):
        if k < delay:  # nothing can have come yet: the channel's state is that of the message that comes first
            moments = maps[D + 1] @ moments @ maps[D + 1].T
            continue
        after = np.zeros_like(moments)
        for s, arrival, t in np.argwhere(ages.moves > 0.0):
            after[t] += ages.moves[s, arrival, t] * maps[arrival] @ moments[s] @ maps[arrival].T
        moments = after
    assert float(np.trace(moments.sum(axis=0)[:m, :m])) == pytest.approx(known, rel=1e-12)


def test_behind_a_wrong_model_the_special_cases_are_those_of_other_criteria() -> None:
    for chain in (bernoulli(0.6), gilbert_elliott(0.1, 0.2)):
        found = delayed_mean_square.lap_growth(WRONGLY_PREDICTED, behind_constant_delay(chain, 0))
        assert found == pytest.approx(mean_square.lap_growth(WRONGLY_PREDICTED, chain), abs=1e-7)
    truth = 2.0 * floquet.constant_delay(WRONGLY_PREDICTED, 4)
    driven = behind_constant_delay(bernoulli(1e-9), 4)
    assert delayed_mean_square.lap_growth(WRONGLY_PREDICTED, driven) == pytest.approx(truth, abs=2e-4)


@pytest.mark.parametrize("p", [0.0, 0.4])
@pytest.mark.parametrize("slots", [[0.5, 0.3, 0.2], [0.0, 0.0, 1.0], [0.2, 0.0, 0.8]])
def test_the_moments_are_those_of_all_that_can_happen(p: float, slots: list[float]) -> None:
    """Each error before the first step was 1, so the age then is D: any late message would be fresher."""
    loop = loop_of(60.0)
    ages = late(np.cumsum(slots), p)
    # The messages of the steps before are unknown here: those that the chain lets arrive bring the same error, 1.
    assert expected_square(loop, np.array(slots), p, 5) == pytest.approx(moments_after(loop, ages, 0, 5), rel=1e-12)


def test_the_drive_and_the_matrices_agree() -> None:
    loop, ages = loop_of(60.0), late(np.array([0.5, 0.8, 1.0]), 0.4)
    growth = delayed_mean_square.lap_growth(loop, ages)
    long, longer = (math.log(moments_after(loop, ages, 0, steps)) for steps in (400, 500))
    assert growth == pytest.approx((longer - long) / 100.0, abs=1e-6)


@pytest.mark.parametrize("chain", [bernoulli(0.6), gilbert_elliott(0.1, 0.2)])
def test_without_a_delay_it_is_the_mean_square_of_losses(chain: Chain) -> None:
    found = delayed_mean_square.lap_growth(loop_of(), behind_constant_delay(chain, 0))
    assert found == pytest.approx(mean_square.lap_growth(loop_of(), chain), abs=1e-7)


@pytest.mark.parametrize("n", [0, 3, 12, 20])
def test_without_losses_it_is_the_lifted_system(n: int) -> None:
    """Twice the growth of the error; by the recursion itself where some arrivals never happen."""
    truth = 2.0 * floquet.constant_delay(loop_of(), n)
    assert delayed_mean_square.lap_growth(loop_of(), behind_constant_delay(bernoulli(0.0), n)) == truth
    driven = behind_constant_delay(bernoulli(1e-9), n)
    assert delayed_mean_square.lap_growth(loop_of(), driven) == pytest.approx(truth, abs=2e-4)


def test_two_ways_to_a_constant_delay() -> None:
    for p in (0.3, 0.8):
        by_age, by_channel = late(np.array([0.0, 0.0, 0.0, 1.0]), p), behind_constant_delay(bernoulli(p), 3)
        found = delayed_mean_square.lap_growth(loop_of(), by_age)
        assert found == pytest.approx(delayed_mean_square.lap_growth(loop_of(), by_channel), abs=1e-7)


@pytest.mark.parametrize(
    "channel",
    [
        ChannelParameters(model="bernoulli", p=0.3, delay=0.012, jitter=0.011),
        ChannelParameters(model="bernoulli", p=0.3, delay=0.012, jitter=0.02, duplicate=0.4),
        ChannelParameters(model="bernoulli", p=0.2, delay=0.012, jitter=0.011, lifetime=0.0151),
        ChannelParameters(model="gilbert_elliott", p=0.1, r=0.3, delay=0.015),
    ],
)
def test_ages_are_those_of_the_relay(channel: ChannelParameters) -> None:
    """Two ages in a row over 60 000 slots of the relay's own outcomes, the freshest stamp held."""
    steps, relay = 60_000, Channel(channel, 4, "uplink", TS)
    arrivals: dict[int, list[int]] = {}
    for k in range(steps):
        if not relay.lost(k):
            arrivals.setdefault(k + soonest(*relay.delays(k)), []).append(k)
    ages, held = [], 0
    for k in range(steps):
        held = max([held, *arrivals.get(k, [])])
        ages.append(k - held)
    chain = age_chain_of(channel, TS)
    assert chain is not None
    np.testing.assert_allclose(chain.moves.sum(axis=(1, 2)), 1.0, rtol=1e-12)
    # The chain, walked here with the ages that it gives, against what the relay's messages made.
    random, state, age, walked = np.random.default_rng(1), 0, 0, []
    for u in random.random(steps).tolist():
        flat = chain.moves[state].ravel()
        place = int(np.searchsorted(np.cumsum(flat), u * (1.0 - 1e-12)))
        arrival, state = divmod(place, chain.moves.shape[2])
        age = arrival if arrival <= chain.oldest and arrival <= age + 1 else age + 1
        walked.append(age)
    pairs = [np.minimum(np.array(found), 9) for found in (ages, walked)]
    one, other = (np.bincount(10 * found[:-1] + found[1:], minlength=100) / steps for found in pairs)
    np.testing.assert_allclose(one, other, atol=0.015)


def test_the_slots_under_way() -> None:
    uniform = ChannelParameters(delay=0.01, jitter=0.01)  # 0 to 20 ms: 1 to 4 slots, each as likely
    np.testing.assert_allclose(slots_under_way(uniform, TS), [0.0, 0.25, 0.5, 0.75, 1.0], atol=1e-6)
    assert slots_under_way(ChannelParameters(delay=0.015), TS).tolist() == [0.0, 0.0, 0.0, 1.0]
    assert age_chain_of(ChannelParameters(model="gilbert_elliott", p=0.1, r=0.3, jitter=0.01), TS) is None


def predicted(kx: float, speed_scale: float) -> list[str]:
    """With a model that takes the commanded speed for the true one."""
    return ["error_detector.policy=predict", f"controller.kx={kx}", f"plant.speed_scale={speed_scale}"]


@pytest.mark.parametrize(
    ("p", "settings", "contracts"),
    [(0.4, [], True), (0.96, [], False), (0.96, predicted(25.0, 1.3), True), (0.4, predicted(160.0, 2.2), False)],
)
def test_simulated_twins_on_both_sides(p: float, settings: list[str], contracts: bool) -> None:
    """Poses 4 slots late and lost with p, K_x = 25: without the delay p = .88 would be the border of a held pose."""
    wanted = load_scenario(PAPER, [
        "error_detector.track=line", f"plant.initial_pose=[0.0, 0.0, {math.pi / 2}]", "plant.duration=20.0",
        "relay.uplink.model=bernoulli", f"relay.uplink.p={p}", "relay.uplink.delay=0.02", *settings,
    ])  # fmt: skip
    growth = margins(wanted)["late_poses.mean_square_growth"]
    assert (growth < 0.0) == contracts
    square = np.mean(simulate_batch([wanted], range(1, 31), twins=True)["contraction"] ** 2)
    assert (square < 1e-3) if contracts else (square > 1e3)


@pytest.mark.parametrize(("p", "stable"), [(0.3, True), (0.93, False)])
def test_a_run_with_late_and_lost_poses_is_judged(p: float, stable: bool) -> None:
    run = simulate(load_scenario(PAPER, [
        "error_detector.track=line", "plant.duration=20.0", "relay.uplink.model=bernoulli", f"relay.uplink.p={p}",
        "relay.uplink.delay=0.01", "relay.uplink.jitter=0.01",
    ]))  # fmt: skip
    found = analyse(run).to_json()
    assert found["late_mean_square_stable"] == stable
    loop = kanayama_loop(np.ones(1), np.zeros(1), ControllerParameters(), TS)
    truth = delayed_mean_square.lap_growth(loop, late(slots_under_way(run.scenario.relay.uplink, TS), p))
    assert found["late_mean_square_growth"] == pytest.approx(truth, abs=0.2 * abs(truth))


def test_a_fit_knows_the_bursts_behind_a_constant_delay() -> None:
    random, bad, age, ages = np.random.default_rng(5), False, 3, []
    for u in random.random(60_000).tolist():
        bad = u >= 0.02 if bad else u < 0.02
        age = age + 1 if bad else 3
        ages.append(age)
    fit = fitted_ages(np.array(ages))
    truth = delayed_mean_square.lap_growth(loop_of(), behind_constant_delay(gilbert_elliott(0.02, 0.02), 3))
    assert truth > 0.0
    assert delayed_mean_square.lap_growth(loop_of(), fit) == pytest.approx(truth, rel=0.15)


def test_where_there_is_no_answer_there_is_a_reason() -> None:
    late_line = ("error_detector.track=line", "relay.uplink.delay=0.01", "relay.uplink.jitter=0.01")
    bursty = ("relay.uplink.model=gilbert_elliott", "relay.uplink.p=0.1", "relay.uplink.r=0.3")
    for settings, said in (
        (bursty, "losses with a memory"),
        (("relay.downlink.delay=0.01",), "commands are late"),
    ):
        found = margins(load_scenario(PAPER, [*late_line, *settings]))
        assert found["late_poses.mean_square_growth"] is None
        assert said in found.reasons["late_poses.mean_square_growth"]


def test_a_complex_pair_has_its_growth_too() -> None:
    """K_y = 4, K_theta = 1 swings across the line: powers of the recursion never settle, its eigenvalues are known."""
    gains = ControllerParameters(kx=25.0, ky=4.0, ktheta=1.0)
    loop, ages = kanayama_loop(np.ones(1), np.zeros(1), gains, TS), behind_constant_delay(bernoulli(0.3), 1)
    F, G = loop.F[0], loop.G[0]
    zero, one = np.zeros((3, 3)), np.eye(3)
    arrives = np.block([[F, G, zero], [one, zero, zero], [zero, one, zero]])  # z, C z(k-1), what is held
    misses = np.block([[F, zero, G], [one, zero, zero], [zero, zero, one]])
    operator = 0.7 * np.kron(arrives, arrives) + 0.3 * np.kron(misses, misses)
    expected = np.log(np.abs(np.linalg.eigvals(operator)).max())
    assert delayed_mean_square.lap_growth(loop, ages) / loop.steps == pytest.approx(expected, rel=1e-7)
