"""Every criterion on loops with more states than the error, against dense matrices made of single steps."""

from __future__ import annotations

import dataclasses
import itertools
import math
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pytest

from agv_analysis.link.joint_chain import independent
from agv_analysis.link.markov_channel import Chain, bernoulli, gilbert_elliott
from agv_analysis.run import Floats
from agv_analysis.stability import (
    almost_sure,
    first_border,
    floquet,
    joint_spectral_radius,
    lifted,
    mean_square,
    mean_square_two_links,
    variable_delay,
)
from agv_analysis.stability.linear_loop import LinearLoop, kanayama_loop
from agv_analysis.stability.linearisation import step_matrices
from agv_cloud.parameters import ControllerParameters
from test.agv_analysis.stability.general_loops import (
    KINDS,
    delayed_multipliers,
    lagged_loop,
    random_loop,
    recursion,
    step,
)

if TYPE_CHECKING:
    from test.conftest import Lap

TS = 0.005
GAINS = ControllerParameters(kx=25.0, ky=4.0, ktheta=6.0)
LAGGED = [
    lagged_loop(np.full(1, 1.2), np.full(1, 0.3), GAINS, 0.1),
    lagged_loop(np.full(1, 1.2), np.full(1, 0.3), GAINS, 0.1, forgets=0.1),
    lagged_loop(np.full(1, 1.2), np.full(1, 0.3), GAINS, 0.1, predicts=True),
    lagged_loop(np.full(1, 1.2), np.full(1, 0.3), GAINS, 0.1, predicts=True, forgets=0.3),
]
NAMES = ["lag", "lag, memory", "lag, predicted", "lag, memory, predicted"]
OF_LAGGED = pytest.mark.parametrize("loop", LAGGED, ids=NAMES)


# -- constant delay ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [0, 1, 2, 7])
@pytest.mark.parametrize("kind", KINDS)
def test_a_lap_with_a_constant_delay_by_its_dense_matrix(kind: str, n: int) -> None:
    loop = random_loop(kind, 5, 5)
    truth = math.log(delayed_multipliers(loop, n, 5)[0])
    assert floquet.constant_delay(loop, n) == pytest.approx(truth, abs=1e-7)


@pytest.mark.parametrize("n", [0, 1, 6, 20])
@OF_LAGGED
def test_a_constant_delay_by_its_dense_matrix(loop: LinearLoop, n: int) -> None:
    truth = delayed_multipliers(loop, n, 1)[0]
    assert floquet.constant_delay(loop, n) == pytest.approx(math.log(truth), abs=1e-8)
    assert lifted.largest_radius(loop, n) == pytest.approx(truth, abs=1e-8)
    companion = lifted.companion(loop, n)
    assert companion.shape == (loop.size + 3 * n,) * 2
    moduli = np.sort(np.abs(np.linalg.eigvals(companion)))[::-1]
    np.testing.assert_allclose(moduli[:4], delayed_multipliers(loop, n, 1)[:4], atol=1e-7)


SLOW = lagged_loop(np.full(1, 1.2), np.full(1, 0.3), GAINS, 1.0, predicts=True)
"""A lag so slow that a predictor that does not know of it has a limit."""


@pytest.mark.parametrize("loop", [*LAGGED[:2], SLOW], ids=["lag", "lag, memory", "slow lag, predicted"])
def test_the_largest_delay_is_the_last_whose_radius_is_below_one(loop: LinearLoop) -> None:
    last = next(n for n in range(20) if delayed_multipliers(loop, n, 1)[0] >= 1.0) - 1
    assert last > 0
    assert floquet.largest_constant_delay(loop) == lifted.largest_n(loop) == last


@pytest.mark.parametrize("limit", [10, 11, 12, 13, 100])
def test_a_search_knows_all_up_to_its_limit(limit: int) -> None:
    assert first_border.last_stable(lambda n: n <= 12, 3.0, limit) == (12 if limit > 12 else None)
    assert first_border.last_stable(lambda n: n <= 12, 30.0, 100) == 12
    assert first_border.last_stable(lambda n: False, 3.0, limit) == -1


def predicted_delay(n: int, F: Floats, G: Floats, delta: float) -> tuple[Floats, Floats]:
    """F' and G' of h(k+1) = F'(k) h(k) + G'(k) h(k-n), the predicted error of an AGV whose speed alone is wrong.

    h(k) = e(k) - sum_{j=k-n}^{k-1} F(k-1) ... F(j+1) D(j) h(j), where D = G_true - G is what the model does not know,
    and e(k+1) = F e + (G + D) h telescope to F' = F + G, G'(k) = F(k) ... F(k-n+1) D(k-n). An account of its own.
    """
    steps = np.arange(len(F))
    unknown = delta * G[(steps - n) % len(F), :, 0]
    for i in range(n):
        unknown = np.einsum("kij,kj->ki", F[(steps - n + 1 + i) % len(F)], unknown)
    delayed = np.zeros_like(G)
    delayed[:, :, 0] = unknown
    return F + G, delayed


@pytest.mark.parametrize(("n", "delta"), [(0, 0.5), (1, 0.5), (6, 1.4), (9, -0.7), (30, 0.9)])
def test_a_wrong_speed_behind_a_predictor_by_the_predicted_error_alone(n: int, delta: float) -> None:
    angle = 2.0 * np.pi * np.arange(40) / 40
    v_r, w_r = 1.5 + 0.5 * np.sin(angle), 2.0 * np.cos(angle)
    F, G = predicted_delay(n, *step_matrices(v_r, w_r, GAINS, TS), delta)
    product = np.eye(3 * (n + 1))
    for F_k, G_k in zip(F, G, strict=True):
        companion = np.eye(3 * (n + 1), k=-3)
        companion[:3, :3] = F_k
        companion[:3, -3:] += G_k
        product = companion @ product
    truth = math.log(np.abs(np.linalg.eigvals(product)).max())
    loop = kanayama_loop(v_r, w_r, GAINS, TS, True, 1.0 + delta)
    assert floquet.constant_delay(loop, n) == pytest.approx(truth, abs=1e-7)


def test_long_delays_behind_a_predictor_keep_no_modes_of_the_model() -> None:
    """The model's own modes (an AGV moves on forever) are not modes of the loop: here they would hide all others.

    Along a line z^n (z - 1 + a) + a delta, n = 400.
    """
    loop = kanayama_loop(np.ones(20_000), np.zeros(20_000), ControllerParameters(ktheta=8.0, ky=16.0), TS, True, 1.001)
    roots = np.roots([1.0, 0.125 - 1.0, *[0.0] * 399, 0.125e-3])
    across = np.log(np.abs(1.0 - 4.0 * TS))
    truth = max(float(np.log(np.abs(roots).max())), across)
    assert floquet.constant_delay(loop, 400) / 20_000 == pytest.approx(truth, abs=1e-6)


# -- given ages and losses --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["held", "held with memory", "one state", "all states seen"])
def test_given_ages_by_the_states_kept(kind: str) -> None:
    loop = random_loop(kind, 60, 60)
    ages = np.random.default_rng(2).integers(0, 6, 60)
    states = [np.eye(loop.size)]
    for k, age in enumerate(ages.tolist()):
        states.append(step(loop, k, states[k], states[max(0, k - age)][: loop.outputs], received=False)[0])
    truth = math.log(np.abs(np.linalg.eigvals(states[-1])).max())
    assert variable_delay.age_sequence(loop, ages) == pytest.approx(truth, rel=1e-9)


def test_given_ages_are_judged_for_held_poses_only() -> None:
    with pytest.raises(ValueError, match="not where they are predicted"):
        variable_delay.age_sequence(random_loop("predicted", 5, 5), np.zeros(5, dtype=np.int64))


@pytest.mark.parametrize("kind", KINDS)
def test_a_given_sequence_of_losses_by_step(kind: str) -> None:
    loop, lost = random_loop(kind, 30, 30), np.random.default_rng(5).random(30) < 0.5
    m, q = loop.size, loop.outputs
    product = np.eye(m + q)
    for k, is_lost in enumerate(lost.tolist()):
        product = np.concatenate(step(loop, k, product[:m], product[m:], received=not is_lost))
    truth = np.sort(np.log(np.abs(np.linalg.eigvals(product)) + 1e-300))[::-1][:m]
    np.testing.assert_allclose(floquet.drop_sequence(loop, lost), truth, atol=1e-5)
    np.testing.assert_allclose(floquet.drop_sequence(loop, lost, 1), truth[:1], atol=1e-9)


# -- bursts -----------------------------------------------------------------------------------------------------------


def burst_map(loop: LinearLoop, length: int) -> Floats:
    z, h = np.eye(loop.size), np.zeros((loop.outputs, loop.size))
    for k in range(length):
        z, h = step(loop, k, z, h, received=k == 0)
    return z


@pytest.mark.parametrize(("loop", "proved"), [*zip(LAGGED, (15, 3, 8, 8), strict=True)], ids=NAMES)
def test_bursts_that_are_proved(loop: LinearLoop, proved: int) -> None:
    """The certificate is a norm that every burst shrinks, along and across together."""
    found = joint_spectral_radius.verdict(loop, proved)
    P = found.certificate
    assert found.verdict == joint_spectral_radius.STABLE
    assert P is not None
    assert np.linalg.eigvalsh(P)[0] > 0.0
    growth = []
    for length in range(1, proved + 2):
        M = burst_map(loop, length)
        assert np.linalg.eigvalsh(M.T @ P @ M - P)[-1] < 0.0
        growth.append(np.max(np.linalg.eigvals(np.linalg.solve(P, M.T @ P @ M)).real) ** (0.5 / length))
    assert found.upper == pytest.approx(max(growth), rel=1e-9)


@pytest.mark.parametrize("loop", LAGGED[:2], ids=NAMES[:2])
def test_bursts_that_are_refuted(loop: LinearLoop) -> None:
    radii = [float(np.abs(np.linalg.eigvals(burst_map(loop, n + 1))).max()) for n in range(30)]
    refuted = next(n for n, radius in enumerate(radii) if radius > 1.0)
    proved, found = joint_spectral_radius.largest_n(loop, 100)
    assert found == refuted
    assert proved is not None
    assert 3 <= proved < refuted
    assert joint_spectral_radius.verdict(loop, refuted).verdict == joint_spectral_radius.UNSTABLE


def test_a_lap_with_stops_and_a_lag_is_proved(lap: Lap) -> None:
    v, w = lap("warehouse", 400)[1:]
    loop = lagged_loop(v, w, ControllerParameters(kx=20.0, ky=1.0, ktheta=2.0), 0.05)
    assert joint_spectral_radius.verdict(loop, 4).verdict == joint_spectral_radius.STABLE


# -- random losses ----------------------------------------------------------------------------------------------------


def maps_of(loop: LinearLoop, k: int) -> tuple[Floats, Floats]:
    """Of (z, h), by one step of the loop: received and missed."""
    unit = np.eye(loop.size + loop.outputs)
    received, missed = (
        np.concatenate(step(loop, k, unit[: loop.size], unit[loop.size :], received=here)) for here in (True, False)
    )
    return received, missed


def repeating(outcomes: str) -> Chain:
    """The channel whose slots are received, "R", and lost, "L", in this order, again and again."""
    delivery = np.array([float(slot == "R") for slot in outcomes])
    return Chain(np.roll(np.eye(len(outcomes)), 1, axis=1), delivery)


def dense_growth(loop: LinearLoop, p: float, steps: int) -> float:
    """Growth (logarithm) of the second moments under independent losses, by the product of the recursions."""
    product = np.eye((loop.size + loop.outputs) ** 2)
    for k in range(steps):
        received, missed = maps_of(loop, k)
        product = recursion([(1.0 - p, received), (p, missed)]) @ product
    return math.log(np.abs(np.linalg.eigvals(product)).max())


@pytest.mark.parametrize("p", [0.0, 0.3, 0.8])
@pytest.mark.parametrize("kind", KINDS)
def test_the_mean_square_over_a_lap_by_its_dense_recursion(kind: str, p: float) -> None:
    loop, tolerance = random_loop(kind, 4, 4), 1e-3 if p == 0.0 else 1e-6  # moments of a complex pair never settle
    assert mean_square.lap_growth(loop, bernoulli(p)) == pytest.approx(dense_growth(loop, p, 4), abs=tolerance)


def dense_step(loop: LinearLoop, k: int, chain: Chain) -> Floats:
    """What step k makes of the second moments of all states of the channel, one above the other."""
    received, missed = maps_of(loop, k)
    blocks = [recursion([(g, received), (1.0 - g, missed)]) for g in chain.delivery.tolist()]
    states = range(len(blocks))
    return np.block([[chain.transition[i, j] * blocks[i] for i in states] for j in states])


CYCLES = ["R", "RL", "RLL", "RRLLRL", "RLLLLLL"]


@pytest.mark.parametrize("outcomes", CYCLES)
@pytest.mark.parametrize("kind", KINDS)
def test_the_mean_square_under_outcomes_that_repeat_by_its_dense_recursion(kind: str, outcomes: str) -> None:
    """The lap has 4 steps, so that the worst of several beginnings counts for some, and laps differ for others."""
    loop, chain = random_loop(kind, 4, 4), repeating(outcomes)
    product = np.eye(len(outcomes) * (loop.size + loop.outputs) ** 2)
    for k in range(4):
        product = dense_step(loop, k, chain) @ product
    truth = math.log(np.abs(np.linalg.eigvals(product)).max())
    assert mean_square.lap_growth(loop, chain) == pytest.approx(truth, abs=1e-6 if "L" in outcomes else 1e-3)


@pytest.mark.parametrize("chain", [bernoulli(0.6), gilbert_elliott(0.1, 0.3, 0.2, 0.9), repeating("RLLRLL")])
@OF_LAGGED
def test_the_mean_square_of_a_loop_that_stays_as_it_is(loop: LinearLoop, chain: Chain) -> None:
    """By the dense recursion, and by driving the same loop as a lap of many equal steps."""
    dense = dense_step(loop, 0, chain)
    assert dense.shape == (len(chain.delivery) * (loop.size + loop.outputs) ** 2,) * 2
    truth = math.log(np.abs(np.linalg.eigvals(dense)).max())
    assert mean_square.lap_growth(loop, chain) == pytest.approx(truth, abs=1e-7)
    driven = as_a_lap(loop, 3000)
    assert mean_square.lap_growth(driven, chain) / 3000 == pytest.approx(truth, abs=2e-6)


def as_a_lap(loop: LinearLoop, steps: int) -> LinearLoop:
    """A loop that stays as it is as a lap with a row for each step."""
    names = ("v_r", "w_r", "A", "B", "D", "L_h", "L_z", "P_h", "P_u")
    rows = {name: np.repeat(matrix, steps, axis=0) for name in names if (matrix := getattr(loop, name)) is not None}
    return dataclasses.replace(loop, **rows)  # type: ignore[arg-type]


@pytest.mark.parametrize("loop", [*LAGGED[:2], SLOW], ids=["lag", "lag, memory", "slow lag, predicted"])
def test_the_critical_loss_is_where_the_dense_recursion_has_radius_one(loop: LinearLoop) -> None:
    p = mean_square.critical_loss(loop)
    assert 0.0 < p < 1.0
    assert dense_growth(loop, p, 1) == pytest.approx(0.0, abs=1e-6)
    assert dense_growth(loop, 0.9 * p, 1) < -1e-6
    assert dense_growth(loop, p + 0.1 * (1.0 - p), 1) > 1e-6


def test_a_chain_of_many_states_is_driven() -> None:
    """Periodic losses: the square of the map of a burst."""
    loop, n = LAGGED[3], 9
    chain = Chain(np.roll(np.eye(n + 1), 1, axis=1), np.eye(n + 1)[0])
    truth = 2.0 * math.log(np.abs(np.linalg.eigvals(burst_map(loop, n + 1))).max()) / (n + 1)
    assert mean_square.lap_growth(loop, chain) == pytest.approx(truth, abs=1e-6)


@pytest.mark.parametrize("kind", ["held with memory", "predicted with memory"])
def test_exponents_by_qr(kind: str) -> None:
    """From numpy's QR at each reception, losses from a generator of this test's own."""
    loop, p, steps = random_loop(kind, 7, 7), 0.5, 40_000
    lost = np.random.default_rng(8).random(steps) < p
    z, h, logs = np.eye(5), np.zeros((3, 5)), np.zeros(5)
    for k, is_lost in enumerate(lost.tolist()):
        if not is_lost:
            z, R = np.linalg.qr(z)
            logs += np.log(np.abs(np.diag(R)))
        z, h = step(loop, k, z, h, received=not is_lost)
    found = almost_sure.exponents(loop, bernoulli(p), steps=200_000)
    np.testing.assert_array_less(np.abs(found.values - np.sort(logs / steps)[::-1]), 15.0 * found.errors + 1e-3)


# -- losses on both links ---------------------------------------------------------------------------------------------


def acted_on(loop: LinearLoop, k: int, pose: bool, command: bool, stops: bool) -> Floats:
    """Map of (z, h, u), u the command that the plant holds, by the definition of one step."""
    m, q, row = loop.size, loop.outputs, k % len(loop.A)
    unit = np.eye(m + q + 2)
    z, h, u = unit[:m], unit[m : m + q], unit[m + q :]
    h = z[:q] if pose else h
    sent = loop.L_h[row] @ h + loop.L_z[row] @ z
    u = sent if command else 0.0 * u if stops else u
    h_next = h if loop.P_h is None or loop.P_u is None else loop.P_h[row] @ h + loop.P_u[row] @ sent
    return np.concatenate((loop.A[row] @ z + loop.B[row] @ u + loop.D[row] @ h, h_next, u))


@pytest.mark.parametrize("stops", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_both_links_over_a_lap_by_the_dense_recursion(kind: str, stops: bool) -> None:
    loop, up, down = random_loop(kind, 3, 3), 0.3, 0.4
    product = np.eye((loop.size + loop.outputs + 2) ** 2)
    for k in range(3):
        maps = [
            ((1.0 - up if pose else up) * (1.0 - down if command else down), acted_on(loop, k, pose, command, stops))
            for pose, command in itertools.product((True, False), repeat=2)
        ]
        product = recursion(maps) @ product
    truth = math.log(np.abs(np.linalg.eigvals(product)).max())
    links = independent(bernoulli(up), bernoulli(down))
    assert mean_square_two_links.lap_growth(loop, links, stops) == pytest.approx(truth, abs=1e-6)


@pytest.mark.parametrize("stops", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_both_links_under_outcomes_that_repeat_by_their_product(kind: str, stops: bool) -> None:
    """Outcomes of 6 steps on a lap of 4, so that the worse of two beginnings counts."""
    loop = random_loop(kind, 4, 4)
    poses, commands = "RLL", "RL"
    radii = []
    for begin in range(4):
        product = np.eye(loop.size + loop.outputs + 2)
        for k in range(12):
            product = acted_on(loop, begin + k, poses[k % 3] == "R", commands[k % 2] == "R", stops) @ product
        radii.append(np.abs(np.linalg.eigvals(product)).max())
    links = independent(repeating(poses), repeating(commands))
    assert len(links.transition) == 6
    truth = 2.0 * math.log(max(radii)) / 3
    assert mean_square_two_links.lap_growth(loop, links, stops) == pytest.approx(truth, abs=1e-9)


@OF_LAGGED
def test_without_losses_of_commands_it_is_the_mean_square_of_one_link(loop: LinearLoop) -> None:
    truth = mean_square.lap_growth(loop, bernoulli(0.6))
    links = independent(bernoulli(0.6), bernoulli(0.0))
    assert mean_square_two_links.lap_growth(loop, links) == pytest.approx(truth, abs=1e-7)


@pytest.mark.parametrize("stops", [False, True])
def test_the_moments_of_many_driven_loops(stops: bool) -> None:
    """40 000 affine loops whose nominal command changes, losses from a generator of this test's own.

    The AGV holds, or drops, the command itself; what two of them that met the same losses differ in is the linear loop.
    """
    loop, runs, p, steps = random_loop("held with memory", 6, 6, seed=4), 40_000, 0.3, 6
    random = np.random.default_rng(9)
    nominal = random.standard_normal((6, 2))
    twins = [start * np.ones((loop.size, runs)) for start in (0.0, 1.0)]
    lost, unsent = random.random((2, steps, runs)) < p
    ends = [drive_affine(loop, nominal, z, lost, unsent, stops) for z in twins]
    found = float((np.square(ends[1] - ends[0]).sum(axis=0)).mean())
    m, q = loop.size, loop.outputs
    start = np.concatenate((np.ones(m + q), loop.L_h[0] @ np.ones(q) + loop.L_z[0] @ np.ones(m)))
    X = np.outer(start, start)
    outcomes = [
        mean_square_two_links.step_maps(loop, pose, command, float(not stops))
        for pose, command in itertools.product((True, False), repeat=2)
    ]
    weights = [(1 - p) ** 2, (1 - p) * p, p * (1 - p), p * p]
    for k in range(steps):
        X = np.sum([w * A[k] @ X @ A[k].T for w, A in zip(weights, outcomes, strict=True)], axis=0)
    assert found == pytest.approx(float(np.trace(X[:m, :m])), rel=0.05)


def drive_affine(loop: LinearLoop, nominal: Floats, z: Floats, lost: Floats, unsent: Floats, stops: bool) -> Floats:
    """Runs side by side, columns, about a motion whose command is `nominal`, shape (6, 2); commands are whole ones."""
    h = z[: loop.outputs].copy()
    held = loop.L_h[0] @ h + loop.L_z[0] @ z + nominal[-1][:, None]
    for k in range(len(lost)):
        h = np.where(lost[k], h, z[: loop.outputs])
        sent = nominal[k][:, None] + loop.L_h[k] @ h + loop.L_z[k] @ z
        held = np.where(unsent[k], 0.0 if stops else held, sent)
        z = loop.A[k] @ z + loop.B[k] @ (held - nominal[k][:, None]) + loop.D[k] @ h
    return z


def test_kanayama_is_the_same_as_any_other_loop() -> None:
    """Closed forms against the paths that take any loop."""
    for v, w in ((1.2, 0.3), (1.0, 0.0), (0.0, 0.0)):
        loop = kanayama_loop(np.full(50, v), np.full(50, w), GAINS, TS)
        plain = dataclasses.replace(loop, closed_form=None)
        same = partial(pytest.approx, abs=1e-7)
        for n in (0, 5, 20):
            assert lifted.largest_radius(plain, n) == same(lifted.largest_radius(loop, n))
        assert floquet.largest_constant_delay(plain) == floquet.largest_constant_delay(loop)
        assert joint_spectral_radius.largest_n(plain) == joint_spectral_radius.largest_n(loop)
        assert mean_square.critical_loss(plain) == same(mean_square.critical_loss(loop))
