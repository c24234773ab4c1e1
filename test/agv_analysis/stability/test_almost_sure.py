"""Almost-sure exponents against sums written out, products with numpy's own QR, and runs of the loop."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agv_analysis.link.markov_channel import Chain, bernoulli, bursty, gilbert_elliott
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.stability.almost_sure import (
    averaged_critical_loss_along,
    averaged_exponent_along,
    critical_loss,
    critical_loss_along,
    exponent_along,
    exponents,
    is_degenerate,
    sample_losses,
)
from agv_analysis.stability.linear_loop import LinearLoop, kanayama_loop
from agv_cloud.parameters import ControllerParameters

CONFIG = str(Path(__file__).parents[3] / "config/paper.yaml")
TS = 0.005
Floats = NDArray[np.float64]


def constant(v: float, w: float, by: ControllerParameters) -> LinearLoop:
    return kanayama_loop(np.array([v]), np.array([w]), by, TS)


# -- along the track -------------------------------------------------------------------------------------------------


def sum_along(a: float, p: float) -> float:
    """Sum of q p^(l-1) log|1 - a l| over l, times the delivery rate q, term by term."""
    q, terms, weight, length = 1.0 - p, [], 1.0 - p, 1
    while weight * (1.0 + math.log(1.0 + a * length)) > 1e-18:
        terms.append(weight * math.log(abs(1.0 - a * length)))
        weight, length = weight * p, length + 1
    return q * math.fsum(terms)


@settings(deadline=None, derandomize=True)
@given(st.floats(0.01, 3.0), st.floats(0.0, 0.99))
def test_along_the_track_by_its_sum(a: float, p: float) -> None:
    if min(abs(1.0 - a * length) for length in range(1, 3000)) > 1e-6:
        assert exponent_along(a, bernoulli(p)) == pytest.approx(sum_along(a, p), rel=1e-9, abs=1e-12)


def test_along_the_track_by_a_random_product() -> None:
    """Bursts: 200 000 steps of a Gilbert channel made here; five standard errors are 0.004 or so."""
    a, p, r = 0.3, 0.1, 0.3
    random = np.random.default_rng(11).random(400_000)
    bad, lengths, length = False, [], 0
    for u in random.tolist():
        length += 1
        if not bad:
            lengths.append(length)
            length = 0
        bad = u >= r if bad else u < p
    logs = np.log(np.abs(1.0 - a * np.array(lengths[1:])))
    assert exponent_along(a, gilbert_elliott(p, r)) == pytest.approx(logs.sum() / sum(lengths[1:]), abs=0.004)


@pytest.mark.parametrize("a", [1.0, 0.5, 0.125, 0.025])
def test_a_burst_that_brings_the_error_to_nothing(a: float) -> None:
    assert is_degenerate(a)
    assert exponent_along(a, bernoulli(0.5)) == -math.inf
    assert critical_loss_along(a) is None


@pytest.mark.parametrize("a", [0.0, 0.3, 1.25, 0.126, 2.5])
def test_no_such_burst(a: float) -> None:
    assert not is_degenerate(a)


def test_a_burst_that_never_happens_does_not_count() -> None:
    """a = 1/8 with bursts of three steps only: log|1 - 3/8| / 3."""
    chain = Chain(np.roll(np.eye(3), 1, axis=1), np.eye(3)[0])
    assert exponent_along(0.125, chain) == pytest.approx(math.log(0.625) / 3.0)


@pytest.mark.parametrize("a", [0.027, 0.13, 0.3, 0.7, 1.25, 1.7])
def test_the_critical_loss_along_is_the_first_zero(a: float) -> None:
    found = critical_loss_along(a)
    assert found is not None
    assert sum_along(a, found) == pytest.approx(0.0, abs=1e-6)
    assert all(sum_along(a, float(p)) < 0.0 for p in np.linspace(0.0, found - 1e-3, 40))
    assert found > (2.0 - a) / (2.0 + a)  # mean square asks for more (Jensen)


def test_gains_that_do_not_contract_even_without_losses() -> None:
    assert (critical_loss_along(0.0), critical_loss_along(2.0), critical_loss_along(2.5)) == (-1.0, -1.0, -1.0)
    assert critical_loss(constant(1.0, 0.0, ControllerParameters(kx=401.0))) == -1.0
    assert critical_loss(constant(1.0, 0.0, ControllerParameters(kx=0.0))) == -1.0


@pytest.mark.parametrize("a", [1.0, 0.125, 0.13])
def test_the_average_over_gains_by_many_gains(a: float) -> None:
    """Gains within 1 %, by their exponents term by term; at a = 1/8 no neighbour is as stable as that gain alone."""
    gains = a * (0.99 + 0.02 * (np.arange(400) + 0.5) / 400)
    for p in (0.5, 0.9):
        truth = float(np.mean([sum_along(float(x), p) for x in gains]))
        assert averaged_exponent_along(a, bernoulli(p)) == pytest.approx(truth, abs=4e-3 * (1.0 - p))


def test_a_gain_whose_inverse_is_an_integer_is_like_its_neighbours() -> None:
    """K_x = 25 on a line, 1/a = 8: 0.995 across the track was all that was left; along it neighbours say 0.955."""
    found = [critical_loss(constant(1.0, 0.0, ControllerParameters(kx=kx))) for kx in (24.5, 25.0, 25.5)]
    assert found == pytest.approx([0.955] * 3, abs=0.004)
    assert averaged_critical_loss_along(0.125) == pytest.approx(found[1], abs=1e-6)
    assert [averaged_critical_loss_along(a) for a in (0.0, 2.0)] == [-1.0, -1.0]


# -- all three errors ------------------------------------------------------------------------------------------------


def by_qr(v: float, w: float, by: ControllerParameters, p: float, steps: int, seed: int) -> Floats:
    """Exponents from numpy's QR after every reception, losses from a generator of this test's own."""
    loop = constant(v, w, by)
    F, G = loop.F[0], loop.G[0]
    random = np.random.default_rng(seed)
    basis, error, logs = np.eye(3), np.eye(3), np.zeros(3)
    for lost in (random.random(steps) < p).tolist():
        if not lost:
            basis, R = np.linalg.qr(error)
            logs += np.log(np.abs(np.diag(R)))
            error = basis
        error = F @ error + G @ basis
    return np.sort(logs / steps)[::-1]


@pytest.mark.parametrize(
    ("v", "w", "kx", "p"), [(8.0, 0.0, 30.0, 0.5), (8.0, 3.0, 70.0, 0.6), (20.0, -1.0, 130.0, 0.4)]
)
def test_exponents_by_qr(v: float, w: float, kx: float, p: float) -> None:
    by = ControllerParameters(kx=kx, ky=2.0, ktheta=3.0)
    found = exponents(constant(v, w, by), bernoulli(p), steps=200_000)
    truth = by_qr(v, w, by, p, 40_000, 3)
    # The truth is five times shorter, so its own error is some sqrt(5) times as large.
    np.testing.assert_array_less(np.abs(found.values - truth), 5.0 * math.sqrt(6.0) * found.errors + 2e-4)
    assert found.errors.max() < 0.05


def test_on_a_line_the_exponents_hold_the_one_along() -> None:
    found = exponents(constant(8.0, 0.0, ControllerParameters(kx=70.0, ky=2.0, ktheta=3.0)), bursty(0.4, 2.5))
    truth = exponent_along(0.35, bursty(0.4, 2.5))
    nearest = int(np.abs(found.values - truth).argmin())
    assert abs(found.values[nearest] - truth) < 5.0 * found.errors[nearest]


@pytest.mark.parametrize("n", [0, 4])
def test_periodic_losses_are_no_game_of_chance(n: int) -> None:
    loop = constant(8.0, 3.0, ControllerParameters(kx=70.0, ky=2.0, ktheta=3.0))
    F, G = loop.F[0], loop.G[0]
    M = np.eye(3)
    for _ in range(n + 1):
        M = F @ M + G
    truth = np.sort(np.log(np.abs(np.linalg.eigvals(M))) / (n + 1))[::-1]
    chain = Chain(np.roll(np.eye(n + 1), 1, axis=1), np.eye(n + 1)[0])
    found = exponents(loop, chain, steps=50_000)
    np.testing.assert_allclose(found.values, truth, atol=1e-4)


def test_nothing_received() -> None:
    found = exponents(constant(1.0, 0.0, ControllerParameters()), bernoulli(1.0), steps=1000)
    assert found.values.tolist() == [0.0, 0.0, 0.0]
    assert np.isinf(found.errors).all()


def test_losses_come_as_the_chain_says() -> None:
    """Loss rate 0.3 in bursts of 4: over 400 000 steps to five standard errors, which bursts make larger."""
    lost = sample_losses(bursty(0.3, 4.0), 400_000, 2)
    begins = np.count_nonzero(lost[1:] & ~lost[:-1])
    assert lost.mean() == pytest.approx(0.3, abs=0.01)
    assert np.count_nonzero(lost) / begins == pytest.approx(4.0, rel=0.03)


# -- runs ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("track", ["paper", "line"])
@pytest.mark.parametrize(("kx", "inside", "outside"), [(250.0, 0.4, 0.75), (27.0, 0.9, 0.995)])
def test_runs_on_both_sides(track: str, kx: float, inside: float, outside: float) -> None:
    """Between the borders of mean square and almost sure, 0.23 and 0.56 for K_x = 250, runs converge, too."""

    def separation(p: float, seed: int) -> float:
        setting = [f"error_detector.track={track}", f"controller.kx={kx}", f"relay.seed={seed}"]
        setting += ["plant.duration=40.0", "relay.uplink.model=bernoulli", f"relay.uplink.p={p}"]
        one, other = (
            simulate(load_scenario(CONFIG, [*setting, f"plant.initial_pose=[0.0, {y}, 1.5707963267948966]"]))
            for y in (0.0, 1e-9)
        )
        steps = min(len(one), len(other))
        return float(np.linalg.norm(one.pose[steps - 1] - other.pose[steps - 1])) / 1e-9

    for seed in (1, 2, 3):
        assert separation(inside, seed) < 1e-2
        assert separation(outside, seed) > 1.0
