"""The control law against its matrix form, its signs and the theory of Kanayama et al."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import approx_fprime

from agv_cloud.control.command import limit_speed
from agv_cloud.control.kanayama import kanayama
from agv_cloud.tracking_error import tracking_error

error = st.floats(-10.0, 10.0)
speed = st.floats(-5.0, 5.0)
gain = st.floats(0.0, 300.0)


@settings(deadline=None, derandomize=True)
@given(error, error, error, speed, speed, gain, gain, gain)
def test_the_matrix_form_of_the_paper(
    x_e: float, y_e: float, theta_e: float, v_r: float, w_r: float, kx: float, ky: float, ktheta: float
) -> None:
    # Equation 4 as u = u_ff + K eps' with eps' = (x_e, y_e, sin theta_e).
    feed_forward = np.array([v_r * np.cos(theta_e), w_r])
    K = np.array([[kx, 0.0, 0.0], [0.0, v_r * ky, v_r * ktheta]])
    expected = feed_forward + K @ np.array([x_e, y_e, np.sin(theta_e)])
    found = kanayama(x_e, y_e, theta_e, v_r, w_r, kx, ky, ktheta)
    assert found == pytest.approx(tuple(expected), rel=1e-13, abs=1e-11)


@settings(deadline=None, derandomize=True)
@given(speed, speed, gain, gain, gain)
def test_on_the_track_the_reference_s_speeds_are_passed_on_to_the_last_bit(
    v_r: float, w_r: float, kx: float, ky: float, ktheta: float
) -> None:
    assert kanayama(0.0, 0.0, 0.0, v_r, w_r, kx, ky, ktheta) == (v_r, w_r)


def test_the_start_of_the_paper_s_scenario() -> None:
    # v_r(0) = 0.5 m/s and the AGV 5 m ahead: v(0) = 0.5 - 5 K_x.
    assert kanayama(-5.0, 0.0, 0.0, 0.5, 0.0, 5.0, 1.0, 2.0) == (-24.5, 0.0)
    assert limit_speed(kanayama(-5.0, 0.0, 0.0, 0.5, 0.0, 5.0, 1.0, 2.0)[0], 6.0) == -6.0


@pytest.mark.parametrize(("which", "sign"), [(0, (1, 0)), (1, (0, 1)), (2, (0, 1))])
def test_each_error_is_steered_against(which: int, sign: tuple[int, int]) -> None:
    """Reference ahead: faster. Reference to the left or turned to the left: turn left."""
    eps = 0.1 * np.eye(3)[which]
    v, w = kanayama(eps[0], eps[1], eps[2], 1.0, 0.0, 25.0, 1.0, 2.0)
    assert (np.sign(round(v - 1.0, 1)), np.sign(w)) == sign


@settings(deadline=None, derandomize=True, max_examples=30)
@given(st.floats(0.2, 3.0), st.floats(-1.0, 1.0), st.floats(1.0, 100.0), st.floats(0.1, 5.0), st.floats(0.1, 5.0))
def test_the_linearised_error_dynamics_of_kanayama(v_r: float, w_r: float, kx: float, ky: float, ktheta: float) -> None:
    # Equation 22 with the law put in, at eps = 0; Kanayama et al. 1990, eq. 14, is its Jacobian.
    def derivative(eps: NDArray[np.float64]) -> NDArray[np.float64]:
        x_e, y_e, theta_e = eps
        v, w = kanayama(x_e, y_e, theta_e, v_r, w_r, kx, ky, ktheta)
        return np.array([w * y_e - v + v_r * np.cos(theta_e), -w * x_e + v_r * np.sin(theta_e), w_r - w])

    A = np.array([[-kx, w_r, 0.0], [-w_r, 0.0, v_r], [0.0, -v_r * ky, -v_r * ktheta]])
    assert approx_fprime(np.zeros(3), derivative, 1e-7) == pytest.approx(A, rel=1e-4, abs=1e-4)
    assert np.linalg.eigvals(A).real.max() < 0.0


@settings(deadline=None, derandomize=True, max_examples=30)
@given(error, error, st.floats(-1.5, 1.5), st.floats(0.5, 2.0))
def test_kanayama_s_lyapunov_function_falls(x_e: float, y_e: float, theta_e: float, v_r: float) -> None:
    # V = (x_e^2 + y_e^2)/2 + (1 - cos theta_e)/K_y has dV/dt = -K_x x_e^2 - v_r K_theta sin^2(theta_e)/K_y <= 0.
    kx, ky, ktheta = 10.0, 1.5, 2.0
    v, w = kanayama(x_e, y_e, theta_e, v_r, 0.3, kx, ky, ktheta)
    rates = (w * y_e - v + v_r * math.cos(theta_e), -w * x_e + v_r * math.sin(theta_e), 0.3 - w)
    fall = x_e * rates[0] + y_e * rates[1] + math.sin(theta_e) / ky * rates[2]
    assert fall == pytest.approx(-kx * x_e**2 - v_r * ktheta * math.sin(theta_e) ** 2 / ky, rel=1e-9, abs=1e-9)


def test_with_the_tracking_error_the_agv_drives_towards_the_reference() -> None:
    """In whatever direction the reference lies, one step takes the AGV nearer to it along its heading."""
    for heading in np.linspace(-math.pi, math.pi, 13):
        for bearing in np.linspace(-math.pi, math.pi, 8):
            target = (math.cos(bearing), math.sin(bearing))
            eps = tracking_error(*target, heading, 0.0, 0.0, heading)
            v, _ = kanayama(*eps, 0.0, 0.0, 25.0, 1.0, 2.0)
            moved = (0.005 * v * math.cos(heading), 0.005 * v * math.sin(heading))
            assert math.dist(moved, target) <= math.dist((0.0, 0.0), target) + 1e-15


# -- the limit -------------------------------------------------------------------------------------------------------


@settings(deadline=None, derandomize=True)
@given(st.floats(allow_nan=False), st.floats(0.0, exclude_min=True))
def test_the_limit_is_numpy_s_clip(v: float, v_max: float) -> None:
    assert limit_speed(v, v_max) == np.clip(v, -v_max, v_max)


def test_no_limit_and_no_number() -> None:
    assert limit_speed(-1e300, math.inf) == -1e300
    assert limit_speed(-math.inf, 6.0) == -6.0
    assert math.isnan(limit_speed(math.nan, 6.0))


def test_the_compiled_limit_is_the_same() -> None:
    numba = pytest.importorskip("numba", reason="the simulation compiles with numba")
    compiled = numba.njit(limit_speed)
    assert math.isnan(compiled(math.nan, 6.0))
    assert [compiled(v, 6.0) for v in (-7.0, -6.0, 0.0, 7.0)] == [-6.0, -6.0, 0.0, 6.0]
