"""Second moments against all sequences of losses written out, products of operators by hand, and closed forms."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agv_analysis.link.markov_channel import Chain, bernoulli, bursty, gilbert_elliott
from agv_analysis.stability.first_border import crossing
from agv_analysis.stability.linear_loop import LinearLoop, kanayama_loop
from agv_analysis.stability.mean_square import (
    _sign_first,
    along_spectral_radius,
    critical_burst,
    critical_loss,
    critical_loss_along,
    critical_mean_age_along,
    lap_growth,
    operator,
    spectral_radius,
    step_maps,
)
from agv_cloud.parameters import ControllerParameters

if TYPE_CHECKING:
    from test.conftest import Lap

CONFIG = str(Path(__file__).parents[3] / "config/paper.yaml")
TS = 0.005
Floats = NDArray[np.float64]


def loop_at(v: float, w: float, by: ControllerParameters) -> LinearLoop:
    return kanayama_loop(np.array([v]), np.array([w]), by, TS)


def straight(by: ControllerParameters, v: float = 1.0) -> LinearLoop:
    return loop_at(v, 0.0, by)


def moments_by_enumeration(F: Floats, G: Floats, chain: Chain, steps: int) -> Floats:
    """E[e e'] after some steps from e = h = the unit vectors, over every path of states and verdicts."""
    size, states = len(F), len(chain.delivery)
    total = np.zeros((size, size))
    for path in itertools.product(itertools.product(range(states), (False, True)), repeat=steps):
        weight = chain.stationary[path[0][0]]
        for (state, lost), following in itertools.zip_longest(path, path[1:]):
            weight *= 1.0 - chain.delivery[state] if lost else chain.delivery[state]
            weight *= 1.0 if following is None else chain.transition[state, following[0]]
        if weight == 0.0:
            continue
        error = held = np.eye(size)
        for _, lost in path:
            held = held if lost else error
            error = F @ error + G @ held
        total += weight * error @ error.T
    return total


@pytest.mark.parametrize(("kx", "ky", "ktheta"), [(25.0, 1.0, 2.0), (5.0, 30.0, 1.0), (401.0, 1.0, 2.0)])
def test_without_losses_it_is_the_square_of_the_error_s_own_growth(
    lap: Lap, kx: float, ky: float, ktheta: float
) -> None:
    """The product of a lap's F + G, step by step; the first two have a complex pair, whose size never settles."""
    _, v_r, w_r = lap("paper", 2000)
    loop = kanayama_loop(v_r, w_r, ControllerParameters(kx=kx, ky=ky, ktheta=ktheta), TS)
    product, log_scale = np.eye(3), 0.0
    for F, G in zip(loop.F, loop.G, strict=True):
        product = (F + G) @ product
        log_scale, product = log_scale + math.log(np.abs(product).max()), product / np.abs(product).max()
    growth = log_scale + math.log(np.abs(np.linalg.eigvals(product)).max())
    assert lap_growth(loop, bernoulli(0.0)) == pytest.approx(2.0 * growth, rel=1e-9)
    assert lap_growth(loop, bernoulli(1e-9)) == pytest.approx(2.0 * growth, rel=5e-3)  # a mean of laps


@pytest.mark.parametrize(
    ("chain", "steps"),
    [(bernoulli(0.4), 9), (gilbert_elliott(0.2, 0.5), 5), (gilbert_elliott(0.1, 0.3, 0.2, 0.9), 5)],
)
@pytest.mark.parametrize(("v", "w"), [(1.0, 0.0), (12.0, -3.0)])
def test_the_recursion_is_the_mean_over_all_sequences(chain: Chain, steps: int, v: float, w: float) -> None:
    loop = loop_at(v, w, ControllerParameters(kx=150.0, ky=4.0, ktheta=3.0))
    size, states = 3, len(chain.delivery)
    start = np.kron(np.ones((2, 1)), np.eye(size))
    moments = np.concatenate([share * (start @ start.T).ravel() for share in chain.stationary])
    A = operator(*step_maps(loop), chain)
    assert A.shape == (states * 36, states * 36)
    for _ in range(steps):
        moments = A @ moments
    found = moments.reshape(states, 6, 6).sum(axis=0)[:3, :3]
    np.testing.assert_allclose(
        found, moments_by_enumeration(loop.F[0], loop.G[0], chain, steps), rtol=1e-10, atol=1e-12
    )


@pytest.mark.parametrize("chain", [bernoulli(0.6), bernoulli(0.93), bursty(0.3, 4.0)])
def test_driving_a_lap_is_the_product_of_its_operators(lap: Lap, chain: Chain) -> None:
    v, w = lap("paper", 30)[1:]
    by = ControllerParameters(kx=60.0, ky=4.0, ktheta=3.0)
    loop = kanayama_loop(12.0 * v, w, by, TS)
    product = np.eye(36 * len(chain.delivery))
    for k in range(30):
        product = operator(*step_maps(loop, k), chain) @ product
    truth = math.log(np.abs(np.linalg.eigvals(product)).max())
    assert lap_growth(loop, chain) == pytest.approx(truth, abs=1e-6)


def test_without_losses_it_is_the_square_of_the_loop() -> None:
    loop = loop_at(2.0, 0.4, ControllerParameters(kx=60.0, ky=4.0, ktheta=3.0))
    square = np.abs(np.linalg.eigvals(loop.F[0] + loop.G[0])).max() ** 2
    assert spectral_radius(*step_maps(loop), bernoulli(0.0)) == pytest.approx(square, rel=1e-9)


# -- along the track -------------------------------------------------------------------------------------------------


@settings(deadline=None, derandomize=True)
@given(st.floats(0.005, 1.99), st.floats(0.01, 0.5))
def test_the_critical_loss_along_parts_growth_from_decay(a: float, beside: float) -> None:
    p = critical_loss_along(a)
    assert along_spectral_radius(a, bernoulli(p * (1.0 - beside))) < 1.0
    assert along_spectral_radius(a, bernoulli(p + beside * (1.0 - p))) > 1.0


@settings(deadline=None, derandomize=True)
@given(st.floats(0.01, 1.5), st.floats(0.02, 0.8), st.floats(0.02, 0.98))
def test_for_any_renewal_process_the_mean_age_decides(a: float, p: float, r: float) -> None:
    """E[L^2] / E[L] < 2 / a, that is E[n_ul] < 1/a - 1/2, and loss rate times mean burst for a Gilbert channel."""
    chain = gilbert_elliott(p, r)
    lengths = chain.burst_lengths()
    L = np.arange(1, len(lengths) + 1)
    ratio = float(lengths @ L**2 / (lengths @ L))
    age = p / (p + r) / r
    assert ratio == pytest.approx(2.0 * age + 1.0, rel=1e-6)
    if abs(ratio * a / 2.0 - 1.0) > 1e-6:
        stable = along_spectral_radius(a, chain) < 1.0
        assert stable == (ratio < 2.0 / a) == (age < critical_mean_age_along(a))


@pytest.mark.parametrize("n", [12, 14, 16, 20])
def test_periodic_bursts_contract_if_each_factor_does(n: int) -> None:
    """The same n losses over and over: a chain with n + 1 states, a growth of (1 - (n + 1) a)^2 per n + 1 steps."""
    chain = Chain(np.roll(np.eye(n + 1), 1, axis=1), np.eye(n + 1)[0])
    assert along_spectral_radius(0.125, chain) == pytest.approx(abs(1.0 - 0.125 * (n + 1)) ** (2.0 / (n + 1)), rel=1e-6)


# -- critical values of a scenario -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("kx", "p"), [(5.0, 0.97531), (25.0, 0.88235), (250.0, 0.23077)])
@pytest.mark.parametrize("track", ["paper", "line", "circle", "eight", "warehouse"])
def test_the_canonical_scenario(lap: Lap, track: str, kx: float, p: float) -> None:
    v, w = lap(track, 2000)[1:] if track in ("eight", "warehouse") else lap(track)[1:]
    loop = kanayama_loop(v, w, ControllerParameters(kx=kx), TS)
    assert critical_loss(loop) == pytest.approx(p, abs=2e-5 if len(v) == 20_000 else 2e-3)


@pytest.mark.parametrize(
    ("kx", "ky", "ktheta", "v"), [(2.0, 4.0, 3.0, 8.0), (1.0, 20.0, 5.0, 8.0), (30.0, 1.0, 9.0, 6.0)]
)
def test_the_critical_loss_is_where_the_operator_has_radius_one(kx: float, ky: float, ktheta: float, v: float) -> None:
    """Also where it is across the track that the moments grow."""
    loop = straight(ControllerParameters(kx=kx, ky=ky, ktheta=ktheta), v)
    p = critical_loss(loop)
    assert 0.0 < p <= critical_loss_along(TS * kx) + 1e-8
    assert spectral_radius(*step_maps(loop), bernoulli(p - 0.01 * (1.0 - p))) < 1.0
    assert spectral_radius(*step_maps(loop), bernoulli(p + 0.01 * (1.0 - p))) > 1.0


@pytest.mark.parametrize(("loss_rate", "kx"), [(0.3, 5.0), (0.6, 5.0), (0.05, 25.0), (0.3, 25.0), (0.6, 25.0)])
def test_the_critical_burst_on_a_line(loss_rate: float, kx: float) -> None:
    """pi B = 1/a - 1/2."""
    found = critical_burst(straight(ControllerParameters(kx=kx)), loss_rate)
    assert found * loss_rate == pytest.approx(1.0 / (TS * kx) - 0.5, rel=1e-5)


def growth_per_reception(F: Floats, G: Floats, lengths: Floats) -> float:
    """Spectral radius of E[M_L x M_L] (Kronecker), the renewal form of the criterion, summed length by length."""
    M, total = np.eye(3), np.zeros((9, 9))
    for probability in lengths.tolist():
        M = F @ M + G
        total += probability * np.kron(M, M)
    return float(np.abs(np.linalg.eigvals(total)).max())


def test_the_example_of_the_docs() -> None:
    assert critical_burst(straight(ControllerParameters(kx=5.0)), 0.05) == pytest.approx(346.5, abs=0.1)


@pytest.mark.parametrize(
    ("loss_rate", "kx", "v", "w"),
    [(0.05, 5.0, 1.0, 0.0), (0.3, 25.0, 1.0, 0.0), (0.1, 10.0, 4.0, 0.0), (0.1, 25.0, 1.0, 0.12)],
)
def test_the_critical_burst_by_renewals(loss_rate: float, kx: float, v: float, w: float) -> None:
    """Where bursts are long and rare the error across binds, because it grows with the square of their length."""
    loop = loop_at(v, w, ControllerParameters(kx=kx))
    found, F, G = critical_burst(loop, loss_rate), loop.F[0], loop.G[0]
    assert growth_per_reception(F, G, bursty(loss_rate, 0.999 * found).burst_lengths()) < 1.0
    assert growth_per_reception(F, G, bursty(loss_rate, 1.001 * found).burst_lengths()) > 1.0
    along = found * loss_rate == pytest.approx(1.0 / (TS * kx) - 0.5, rel=1e-5)
    assert along == ((kx, v, w) == (25.0, 1.0, 0.0))


def test_degenerate_cases() -> None:
    assert critical_loss(straight(ControllerParameters(kx=200.0))) == pytest.approx(1.0 / 3.0)  # deadbeat
    assert critical_loss(straight(ControllerParameters(kx=401.0))) == -1.0
    assert critical_loss(straight(ControllerParameters(kx=0.0))) == -1.0
    assert critical_loss(straight(ControllerParameters(), 0.0)) == pytest.approx(15.0 / 17.0)  # parked
    assert critical_burst(straight(ControllerParameters(kx=401.0)), 0.3) == -1.0
    assert critical_burst(straight(ControllerParameters(kx=250.0)), 0.9) == -1.0  # 0.9 needs bursts of 9 slots
    assert (critical_loss_along(0.0), critical_loss_along(2.0)) == (-1.0, -1.0)
    assert (critical_mean_age_along(0.0), critical_mean_age_along(2.0)) == (-1.0, -1.0)
    assert along_spectral_radius(0.5, bernoulli(1.0)) >= 1.0  # nothing is ever received


@settings(deadline=None, derandomize=True)
@given(st.floats(-3.0, 3.0), st.floats(0.1, 10.0))
def test_crossing(root: float, steep: float) -> None:
    assert crossing(lambda x: math.atan(steep * (x - root)), -5.0, 7.0) == pytest.approx(root, abs=1e-7)
    assert crossing(lambda x: -1.0 if x < root else 1.0, -5.0, 7.0) == pytest.approx(root, abs=1e-7)


def test_the_mean_square_of_many_runs() -> None:
    """Along a line, 40 000 runs with a third lost, from a generator of this test's own."""
    a, p, runs = 0.5, 0.35, 40_000
    random = np.random.default_rng(7)
    error, held = np.ones(runs), np.ones(runs)
    squares = []
    for _ in range(10):
        held = np.where(random.random(runs) < p, held, error)
        error = error - a * held
        squares.append((error**2).mean())
    A = operator(np.array([[1.0 - a, 0.0], [1.0, 0.0]]), np.array([[1.0, -a], [0.0, 1.0]]), bernoulli(p))
    moments = np.ones(4)
    for k in range(10):
        moments = A @ moments
        assert squares[k] == pytest.approx(moments[0], rel=0.1)


def test_of_long_outages_the_whole_lap_is_asked() -> None:
    lap = kanayama_loop(np.linspace(0.5, 1.5, 20_000), np.zeros(20_000), ControllerParameters(), 0.005)

    def growth_of(part: LinearLoop) -> Callable[[float, float], float]:
        return lambda burst, settled: 50.0 if part.steps == lap.steps else -50.0

    signed = _sign_first(lap, growth_of, lambda burst: burst)
    assert [math.copysign(1.0, signed(burst)) for burst in (5.0, 1999.0, 2000.0, 1e6)] == [-1.0, -1.0, 1.0, 1.0]
