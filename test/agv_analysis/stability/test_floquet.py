"""Multipliers of a lap against dense products, eigenvalues, and the derivative of whole simulated runs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agv_analysis.stability.floquet import constant_delay, drop_sequence, largest_constant_delay
from agv_analysis.stability.linear_loop import LinearLoop, kanayama_loop
from agv_analysis.stability.linearisation import step_matrices
from agv_analysis.stability.products import growths, log_spectral_radius, ordered_product
from agv_cloud.parameters import ControllerParameters

if TYPE_CHECKING:
    from test.conftest import Lap

CONFIG = str(Path(__file__).parents[3] / "config/paper.yaml")
TS = 0.005
Floats = NDArray[np.float64]


# -- constant outdatedness -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("track", ["paper", "line", "circle", "eight", "warehouse"])
@pytest.mark.parametrize(("kx", "last"), [(5.0, 62), (25.0, 12), (250.0, 0)])
def test_the_canonical_scenario_whatever_the_track(lap: Lap, track: str, kx: float, last: int) -> None:
    loop = kanayama_loop(*lap(track)[1:], ControllerParameters(kx=kx), TS)
    assert largest_constant_delay(loop) == last
    assert constant_delay(loop, last) < 0.0 < constant_delay(loop, last + 1)


@pytest.mark.parametrize("n", [0, 1, 3, 7])
@pytest.mark.parametrize("track", ["paper", "eight", "warehouse"])
def test_a_short_lap_by_the_product_of_its_companions(lap: Lap, track: str, n: int) -> None:
    v, w = lap(track, 60)[1:]
    v, by = 10.0 * v, ControllerParameters(kx=60.0, ky=2.0, ktheta=3.0)
    F, G = step_matrices(v, w, by, TS)
    product = np.eye(3 * (n + 1))
    for k in range(60):
        lifted = np.eye(3 * (n + 1), k=-3)
        lifted[:3, :3] = F[k]
        lifted[:3, -3:] += G[k]
        product = lifted @ product
    truth = math.log(np.abs(np.linalg.eigvals(product)).max())
    assert constant_delay(kanayama_loop(v, w, by, TS), n) == pytest.approx(truth, abs=1e-6)


def test_nothing_stable_and_everything_stable(lap: Lap) -> None:
    v, w = lap("paper", 400)[1:]
    assert largest_constant_delay(kanayama_loop(v, w, ControllerParameters(kx=401.0), TS)) == -1
    assert largest_constant_delay(kanayama_loop(v, w, ControllerParameters(kx=1.0), TS), limit=20) is None
    assert largest_constant_delay(kanayama_loop(0.0 * v, w, ControllerParameters(kx=0.0), TS)) == -1


# -- a given sequence of losses --------------------------------------------------------------------------------------


def by_step(lost: NDArray[np.bool_], v: Floats, w: Floats, by: ControllerParameters) -> Floats:
    """Log moduli of the lap's multipliers from 6 x 6 matrices of (error, held sample), one a step."""
    F, G = step_matrices(v, w, by, TS)
    zero, one, product, log_scale = np.zeros((3, 3)), np.eye(3), np.eye(6), 0.0
    for F_k, G_k, is_lost in zip(F, G, lost.tolist(), strict=True):
        now = np.block([[F_k, G_k], [zero, one]]) if is_lost else np.block([[F_k + G_k, zero], [one, zero]])
        product = now @ product
        size = np.abs(product).max()
        product, log_scale = product / size, log_scale + math.log(size)
    return np.sort(np.log(np.abs(np.linalg.eigvals(product)) + 1e-300))[::-1][:3] + log_scale


@settings(deadline=None, derandomize=True, max_examples=30)
@given(st.integers(0, 10_000), st.floats(0.0, 0.9), st.sampled_from(["paper", "eight", "warehouse"]))
def test_random_sequences_by_step(lap: Lap, seed: int, p: float, track: str) -> None:
    v, w = lap(track, 80)[1:]
    lost = np.random.default_rng(seed).random(80) < p
    by = ControllerParameters(kx=35.0, ky=2.0, ktheta=3.0)
    found, truth = drop_sequence(kanayama_loop(10.0 * v, w, by, TS), lost), by_step(lost, 10.0 * v, w, by)
    if lost.all():
        assert found.tolist() == [0.0, 0.0, 0.0]
    else:
        # The first slots may be lost as well: they belong to the last burst of the lap before.
        np.testing.assert_allclose(found, truth, atol=1e-6)


def test_on_a_line_a_sequence_is_a_product_of_numbers() -> None:
    """Along: the product of 1 - a L over the bursts; it may hold a factor 0."""
    lengths = [3, 1, 20, 5, 9, 30]
    lost = np.concatenate([[False] + [True] * (length - 1) for length in lengths])
    v, w = np.ones(len(lost)), np.zeros(len(lost))
    truth = sum(math.log(abs(1.0 - 0.125 * length)) for length in lengths)
    assert np.abs(drop_sequence(kanayama_loop(v, w, ControllerParameters(), TS), lost) - truth).min() < 1e-9
    parked = kanayama_loop(0.0 * v, w, ControllerParameters(), TS)
    assert drop_sequence(parked, lost) == pytest.approx([truth], abs=1e-9)
    parked = kanayama_loop(np.zeros(50), np.zeros(50), ControllerParameters(kx=200.0), TS)
    deadbeat = drop_sequence(parked, np.zeros(50, dtype=np.bool_))
    assert deadbeat.tolist() == [-math.inf]


def test_nothing_received_is_an_open_loop() -> None:
    lost = np.ones(20, dtype=np.bool_)
    loop = kanayama_loop(np.ones(20), np.zeros(20), ControllerParameters(), TS)
    assert drop_sequence(loop, lost).tolist() == [0.0, 0.0, 0.0]


# -- long products ---------------------------------------------------------------------------------------------------


@settings(deadline=None, derandomize=True, max_examples=40)
@given(st.integers(0, 10_000), st.integers(1, 17), st.integers(1, 3))
def test_products_in_order(seed: int, count: int, size: int) -> None:
    factors = np.random.default_rng(seed).standard_normal((count, size, size))
    truth = np.eye(size)
    for factor in factors:
        truth = factor @ truth
    product, log_scale = ordered_product(factors)
    np.testing.assert_allclose(math.exp(log_scale) * product, truth, rtol=1e-9, atol=1e-9 * np.abs(truth).max())
    moduli = np.sort(np.log(np.abs(np.linalg.eigvals(truth))))[::-1]
    assert log_spectral_radius(factors) == pytest.approx(moduli[0], abs=1e-9)
    np.testing.assert_allclose(growths(factors), moduli, atol=1e-6)


def test_products_beyond_the_range_of_numbers() -> None:
    """10 000 times diag(2, 1/2, 1/4): each direction keeps its own growth."""
    factors = np.broadcast_to(np.diag([0.5, 2.0, 0.25]), (10_000, 3, 3))
    np.testing.assert_allclose(growths(factors), 10_000 * np.log([2.0, 0.5, 0.25]), rtol=1e-12)
    assert log_spectral_radius(factors) == pytest.approx(10_000 * math.log(2.0))


def test_a_nilpotent_product() -> None:
    factors = np.zeros((3, 2, 2))
    factors[:, 0, 1] = 1.0
    assert log_spectral_radius(factors) == -math.inf
    assert growths(factors).tolist() == [-math.inf, -math.inf]


def test_what_a_predictor_does_not_know_may_grow_while_a_limit_holds_the_agv() -> None:
    """No command reaches the error, which halves with each step; the model takes it that each does, and answers 1.6."""
    steps, half = 2000, 0.5 * np.eye(3)
    nothing, model, law = np.zeros((steps, 3, 2)), np.zeros((steps, 3, 2)), np.zeros((steps, 2, 3))
    model[:, 0, 0], law[:, 0, 0] = 1.6, 1.0
    loop = LinearLoop(
        TS, np.ones(steps), np.zeros(steps), A=np.tile(half, (steps, 1, 1)), B=nothing, D=np.zeros((steps, 3, 3)),
        L_h=law, L_z=nothing.swapaxes(1, 2), P_h=np.tile(half, (steps, 1, 1)), P_u=model,
    )  # fmt: skip
    assert constant_delay(loop, 0) == pytest.approx(steps * math.log(0.5))
    assert constant_delay(loop, 1) == pytest.approx(steps * math.log(1.6), rel=0.01)
