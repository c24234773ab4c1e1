"""State feedback against its matrix, and the loop that it makes against the eigenvalues of its linearisation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from agv_cloud.control.kanayama import kanayama
from agv_cloud.control.state_feedback import state_feedback
from agv_cloud.tracking_error import tracking_error

error = st.floats(-10.0, 10.0)
speed = st.floats(-5.0, 5.0)
gain = st.floats(0.0, 300.0)


@given(error, error, error, speed, speed, gain, gain, gain)
def test_it_is_a_matrix_times_the_error(
    x_e: float, y_e: float, theta_e: float, v_r: float, w_r: float, kx: float, ky: float, ktheta: float
) -> None:
    K = np.array([[kx, 0.0, 0.0], [0.0, ky, ktheta]])
    expected = np.array([v_r, w_r]) + K @ np.array([x_e, y_e, theta_e])
    found = state_feedback(x_e, y_e, theta_e, v_r, w_r, kx, ky, ktheta)
    assert found == pytest.approx(tuple(expected), rel=1e-13, abs=1e-11)


@given(speed, speed)
def test_on_the_track_the_reference_s_speeds_are_passed_on_to_the_last_bit(v_r: float, w_r: float) -> None:
    assert state_feedback(0.0, 0.0, 0.0, v_r, w_r) == (v_r, w_r)


def test_to_first_order_it_is_the_paper_s_law_with_gains_over_the_reference_s_speed() -> None:
    v_r, w_r, small = 0.8, 0.3, 1e-6
    for eps in small * np.eye(3):
        x_e, y_e, theta_e = eps.tolist()
        found = state_feedback(x_e, y_e, theta_e, v_r, w_r, 4.0, v_r * 3.0, v_r * 2.0)
        assert found == pytest.approx(kanayama(x_e, y_e, theta_e, v_r, w_r, 4.0, 3.0, 2.0), abs=1e-11)


@pytest.mark.parametrize(("v_r", "w_r"), [(1.0, 0.0), (0.7, 0.4), (-0.5, -0.2)])
def test_a_small_error_decays_as_the_linearised_loop_says(v_r: float, w_r: float) -> None:
    """The unicycle in continuous time under the law, against exp(A t); A by hand from the error's dynamics.

    dx_e/dt = w y_e - v + v_r cos(theta_e),  dy_e/dt = -w x_e + v_r sin(theta_e),  dtheta_e/dt = w_r - w
    """
    kx, ky, ktheta, time, size = 1.5, 2.0 * math.copysign(1.0, v_r), 1.8, 2.0, 1e-6
    A = np.array([[-kx, w_r, 0.0], [-w_r, 0.0, v_r], [0.0, -ky, -ktheta]])
    assert np.linalg.eigvals(A).real.max() < 0.0

    def slope(_: float, poses: list[float]) -> list[float]:
        x_r, y_r, theta_r, x, y, theta = poses
        v, w = state_feedback(*tracking_error(x_r, y_r, theta_r, x, y, theta), v_r, w_r, kx, ky, ktheta)
        return [
            v_r * math.cos(theta_r), v_r * math.sin(theta_r), w_r, v * math.cos(theta), v * math.sin(theta), w,
        ]  # fmt: skip

    for eps in size * np.eye(3):
        x_e, y_e, theta_e = eps.tolist()
        begin = [x_e, y_e, theta_e, 0.0, 0.0, 0.0]  # the AGV at the origin
        end = solve_ivp(slope, (0.0, time), begin, method="DOP853", rtol=1e-12, atol=1e-15).y[:, -1].tolist()
        found = tracking_error(*end)
        np.testing.assert_allclose(found, expm(time * A) @ eps, atol=1e-4 * size)


def test_behind_a_reference_that_drives_backwards_a_positive_gain_across_the_track_is_unstable() -> None:
    A = np.array([[-2.0, 0.0, 0.0], [0.0, 0.0, -0.5], [0.0, -1.0, -2.0]])
    assert np.linalg.eigvals(A).real.max() > 0.0


def test_standing_still_it_turns_all_the_same() -> None:
    assert state_feedback(0.0, 0.5, 0.0, 0.0, 0.0, 2.0, 3.0, 1.0) == (0.0, 1.5)


def test_its_angle_counts_turns() -> None:
    assert state_feedback(0.0, 0.0, 2.0 * math.pi, 1.0, 0.0, 2.0, 1.0, 2.0) == (1.0, 4.0 * math.pi)
