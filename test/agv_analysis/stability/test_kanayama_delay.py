"""Constant outdatedness against the block companion matrix, polynomials' roots, and the number of zeros in a circle."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agv_analysis.stability.kanayama_delay import (
    critical_delay_across,
    critical_delay_along,
    spectral_radii,
    spectral_radius,
)
from agv_analysis.stability.lifted import largest_n, largest_radius
from agv_analysis.stability.linear_loop import kanayama_loop
from agv_analysis.stability.linearisation import step_matrices
from agv_cloud.parameters import ControllerParameters

if TYPE_CHECKING:
    from test.conftest import Lap

CONFIG = str(Path(__file__).parents[3] / "config/paper.yaml")
TS = 0.005
Floats = NDArray[np.float64]


def companion_moduli(n: int, v: float, w: float, by: ControllerParameters) -> Floats:
    """Moduli of the multipliers, largest first: eigenvalues of the block companion matrix of size 3 (n + 1)."""
    F, G = step_matrices(np.array([v]), np.array([w]), by, TS)
    lifted = np.eye(3 * (n + 1), k=-3)
    lifted[:3, :3] = F[0]
    lifted[:3, -3:] += G[0]
    return np.sort(np.abs(np.linalg.eigvals(lifted)))[::-1]


# -- multipliers -----------------------------------------------------------------------------------------------------


@settings(deadline=None, derandomize=True, max_examples=150)
@given(
    st.integers(0, 12), st.floats(0.05, 5.0), st.floats(-3.0, 3.0),
    st.floats(0.5, 300.0), st.floats(0.05, 20.0), st.floats(0.05, 20.0),
)  # fmt: skip
def test_the_block_companion_of_a_moving_agv(n: int, v: float, w: float, kx: float, ky: float, ktheta: float) -> None:
    by = ControllerParameters(kx=kx, ky=ky, ktheta=ktheta)
    assert spectral_radius(n, v, w, by, TS) == pytest.approx(companion_moduli(n, v, w, by)[0], abs=2e-7)


@pytest.mark.parametrize("n", [0, 3, 14, 40])
@pytest.mark.parametrize(("w", "neutral"), [(0.0, 2), (0.7, 1)])
def test_a_parked_agv_without_what_it_cannot_reach(n: int, w: float, neutral: int) -> None:
    moduli = companion_moduli(n, 0.0, w, ControllerParameters())
    others = sorted(np.delete(moduli, np.argsort(np.abs(moduli - 1.0))[:neutral]))
    assert spectral_radius(n, 0.0, w, ControllerParameters(), TS) == pytest.approx(others[-1], abs=1e-7)


@pytest.mark.parametrize(("n", "kx"), [(30, 5.0), (31, 12.0), (20, 250.0)])
def test_many_speeds_at_once(n: int, kx: float) -> None:
    v, w = (np.array(values) for values in ([0.5, 1.0, 1.5, 1.0, 3.0], [0.0, 0.12, -0.1, 2.0, 0.5]))
    truth = [
        companion_moduli(n, *speeds, ControllerParameters(kx=kx))[0]
        for speeds in zip(v.tolist(), w.tolist(), strict=True)
    ]
    np.testing.assert_allclose(spectral_radii(n, v, w, ControllerParameters(kx=kx), TS), truth, atol=1e-9)
    assert largest_radius(kanayama_loop(v, w, ControllerParameters(kx=kx), TS), n) == pytest.approx(
        max(truth), abs=1e-9
    )


def zeros_inside(radius: float, n: int, v: float, w: float, by: ControllerParameters) -> int:
    """Number of multipliers with |z| < radius: how often z^(3n) det(z I - F - z^-n G) turns around 0 on that circle."""
    F, G = step_matrices(np.array([v]), np.array([w]), by, TS)
    z = radius * np.exp(2j * np.pi * np.arange(400_000) / 400_000)
    A = F[0] + (z**-n)[:, None, None] * G[0]
    (a, b, c), (d, e, f), (g, h, i) = (z[:, None, None] * np.eye(3) - A).transpose(1, 2, 0)
    det = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    turns = np.angle(np.roll(det, -1) / det).sum() / (2.0 * np.pi)
    return 3 * n + round(float(turns))


@pytest.mark.parametrize(("v", "w", "kx"), [(1.0, 0.0, 0.3), (1.0, 0.0, 5.0), (1.4, 0.12, 25.0), (0.6, -0.5, 0.6)])
def test_n_500_by_counting_zeros(v: float, w: float, kx: float) -> None:
    """All 1503 multipliers lie within a circle a little larger than the radius, not all in one a little smaller."""
    radius = spectral_radius(500, v, w, ControllerParameters(kx=kx), TS)
    assert zeros_inside(radius + 1e-5, 500, v, w, ControllerParameters(kx=kx)) == 1503
    assert zeros_inside(radius - 1e-5, 500, v, w, ControllerParameters(kx=kx)) < 1503


# -- borders ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kx", "last"), [(5.0, 62), (25.0, 12), (250.0, 0)])
@pytest.mark.parametrize("track", ["paper", "line", "circle", "eight"])
def test_the_canonical_scenario(lap: Lap, track: str, kx: float, last: int) -> None:
    v, w = lap(track)[1:]
    assert largest_n(kanayama_loop(v, w, ControllerParameters(kx=kx), TS)) == last
    if track != "paper":
        return
    fastest = int(np.argmax(np.abs(v) + np.abs(w)))
    assert companion_moduli(last, float(v[fastest]), float(w[fastest]), ControllerParameters(kx=kx))[0] < 1.0
    assert companion_moduli(last + 1, float(v[fastest]), float(w[fastest]), ControllerParameters(kx=kx))[0] > 1.0


def test_a_sharp_corner_held_for_ever_allows_one_step_less(lap: Lap) -> None:
    """In the corners of the warehouse a pose that is 62 steps old is too old, by the companion matrix, too."""
    v, w = lap("warehouse")[1:]
    loops = [kanayama_loop(v, w, ControllerParameters(kx=kx), TS) for kx in (5.0, 25.0, 250.0)]
    assert [largest_n(loop) for loop in loops] == [61, 12, 0]
    sharpest = int(np.argmax(w))
    assert companion_moduli(61, float(v[sharpest]), float(w[sharpest]), ControllerParameters(kx=5.0))[0] < 1.0
    assert companion_moduli(62, float(v[sharpest]), float(w[sharpest]), ControllerParameters(kx=5.0))[0] > 1.0


@settings(deadline=None, derandomize=True, max_examples=60)
@given(st.floats(0.03, 1.99))
def test_along_the_track_by_the_roots_of_a_polynomial(a: float) -> None:
    """z^(n+1) - z^n + a has its roots inside for n below the critical delay, and not all of them above it."""
    delay = critical_delay_along(a)

    def largest(n: int) -> float:
        return float(np.abs(np.roots([1.0, -1.0, *([0.0] * (n - 1)), a] if n else [1.0, a - 1.0])).max())

    if abs(delay - round(delay)) > 1e-4:
        assert largest(math.floor(delay)) < 1.0
        assert largest(math.ceil(delay)) > 1.0


@settings(deadline=None, derandomize=True, max_examples=60)
@given(st.floats(0.5, 30.0), st.floats(0.1, 20.0), st.floats(0.3, 20.0))
def test_across_the_track_by_the_roots_of_a_polynomial(v: float, ky: float, ktheta: float) -> None:
    """z^n (z - 1)^2 + b (z - 1) + c; across a straight track, b = T_s v K_theta and c = T_s^2 v^2 K_y."""
    delay = critical_delay_across(v, ControllerParameters(kx=25.0, ky=ky, ktheta=ktheta), TS)
    b, c = TS * v * ktheta, TS * TS * v * v * ky

    def largest(n: int) -> float:
        high = np.polymul([1.0, -2.0, 1.0], [1.0, *([0.0] * n)])
        return float(np.abs(np.roots(np.polyadd(high, [b, c - b]))).max())

    if delay > 150.0:  # numpy's roots of long polynomials are slow
        assert largest(150) < 1.0
    elif delay == 0.0:
        assert largest(0) > 1.0 - 1e-7 or largest(1) > 1.0 - 1e-7
    elif abs(delay - round(delay)) > 1e-3:
        assert largest(math.floor(delay)) < 1.0
        assert largest(math.ceil(delay)) > 1.0


@pytest.mark.parametrize(
    ("kx", "ky", "ktheta", "v"), [(2.0, 4.0, 3.0, 4.0), (1.0, 20.0, 5.0, 8.0), (30.0, 1.0, 9.0, 6.0)]
)
def test_whichever_of_along_and_across_binds(kx: float, ky: float, ktheta: float, v: float) -> None:
    by = ControllerParameters(kx=kx, ky=ky, ktheta=ktheta)
    last = next(n for n in itertools.count() if companion_moduli(n, v, 0.0, by)[0] >= 1.0) - 1
    assert largest_n(kanayama_loop(np.array([v]), np.zeros(1), by, TS)) == last
    assert last == math.floor(min(critical_delay_along(TS * kx), critical_delay_across(v, by, TS)))


def test_degenerate_gains_and_speeds(lap: Lap) -> None:
    v, w = lap("line")[1:]

    def found(kx: float, ky: float = 1.0, speed: float = 1.0) -> int | None:
        return largest_n(kanayama_loop(speed * v, w, ControllerParameters(kx=kx, ky=ky), TS))

    assert found(0.0) == -1  # what is off along the track stays off
    assert found(200.0) == 0  # deadbeat: a = 1 is on the border of n = 1
    assert found(401.0) == -1
    assert found(25.0, ky=0.0) == -1  # nothing corrects across
    assert found(25.0, speed=0.0) == 12  # parked: along is all that it can reach
    assert critical_delay_along(1.0) == pytest.approx(1.0)
    assert (critical_delay_along(0.0), critical_delay_along(2.0)) == (0.0, 0.0)
    assert critical_delay_across(0.0, ControllerParameters(), TS) == math.inf
