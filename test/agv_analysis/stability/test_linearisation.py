"""The linearised loop against finite differences of the nonlinear one, made of the nodes' own functions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agv_analysis.stability.linearisation import (
    burst_maps,
    is_constant,
    loop_jacobians,
    reachable,
    reception_maps,
    step_matrices,
)
from agv_analysis.stability.paper import matrices
from agv_cloud.control.command import limit_speed
from agv_cloud.control.kanayama import kanayama
from agv_cloud.parameters import ControllerParameters
from agv_cloud.tracking_error import tracking_error
from agv_plant.vehicle.unicycle import euler_step
from agv_ros.pose import Pose

TS = 0.005
Floats = NDArray[np.float64]


def off_by(reference: Pose, error: Floats) -> Pose:
    """The posture that sees the reference at `error` in its own frame: the tracking error turned round."""
    x_e, y_e, theta_e = error.tolist()
    theta = reference.theta - theta_e
    cos, sin = math.cos(theta), math.sin(theta)
    return Pose(reference.x - cos * x_e + sin * y_e, reference.y - sin * x_e - cos * y_e, theta)


def next_error(now: Floats, outdated: Floats, v: float, w: float, by: ControllerParameters) -> Floats:
    """e(k+1) of the nonlinear loop for e(k) = now and a command from e(k-n) = outdated."""
    reference = Pose(2.0, -1.0, 0.7)
    plant = off_by(reference, now)
    seen = tracking_error(*reference, *off_by(reference, outdated))
    command = kanayama(*seen, v, w, by.kx, by.ky, by.ktheta)
    return np.array(tracking_error(*euler_step(*reference, v, w, TS), *euler_step(*plant, *command, TS)))


@settings(deadline=None, derandomize=True, max_examples=60)
@given(
    st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.floats(0.0, 300.0), st.floats(0.0, 20.0), st.floats(0.0, 20.0)
)  # fmt: skip
def test_f_and_g_by_finite_differences(v: float, w: float, kx: float, ky: float, ktheta: float) -> None:
    by, h, zero = ControllerParameters(kx=kx, ky=ky, ktheta=ktheta), 1e-5, np.zeros(3)
    F, G = (M[0] for M in step_matrices(np.array([v]), np.array([w]), by, TS))
    assert not next_error(zero, zero, v, w, by).any() or np.abs(next_error(zero, zero, v, w, by)).max() < 1e-14
    for column, unit in enumerate(h * np.eye(3)):
        of_now = (next_error(unit, zero, v, w, by) - next_error(-unit, zero, v, w, by)) / (2.0 * h)
        of_outdated = (next_error(zero, unit, v, w, by) - next_error(zero, -unit, v, w, by)) / (2.0 * h)
        np.testing.assert_allclose(F[:, column], of_now, atol=1e-8)
        np.testing.assert_allclose(G[:, column], of_outdated, atol=1e-8)


def test_the_shapes_follow_the_speeds() -> None:
    """Row k belongs to the speeds of step k, all speeds at once as one by one."""
    v, w = np.array([1.0, 0.5, 0.0]), np.array([0.0, 0.2, -0.4])
    F, G = step_matrices(v, w, ControllerParameters(), TS)
    for k in range(3):
        F_k, G_k = step_matrices(v[k : k + 1], w[k : k + 1], ControllerParameters(), TS)
        np.testing.assert_array_equal((F[k], G[k]), (F_k[0], G_k[0]))


# -- about any motion ------------------------------------------------------------------------------------------------


def step(pose: Floats, held: Floats, reference: Floats, by: ControllerParameters) -> Floats:
    x_r, y_r, theta_r, v_r, w_r = reference.tolist()
    error = tracking_error(x_r, y_r, theta_r, *held.tolist())
    v, w = kanayama(*error, v_r, w_r, by.kx, by.ky, by.ktheta)
    x, y, theta = pose.tolist()
    return np.array(euler_step(x, y, theta, limit_speed(v, by.v_max), w, TS))


@pytest.mark.parametrize("v_max", [math.inf, 6.0])
def test_derivatives_of_the_loop_far_from_its_reference(v_max: float) -> None:
    random, by, h = np.random.default_rng(8), ControllerParameters(kx=8.0, ky=1.5, ktheta=2.5, v_max=v_max), 1e-6
    pose, held = random.uniform(-2.0, 2.0, (2, 60, 3))
    reference = random.uniform(-2.0, 2.0, (60, 5))
    now, outdated = loop_jacobians(pose, held, reference, by, TS)
    limited = 0
    for k in range(60):
        answers = [step(pose[k], held[k] + d, reference[k], by) for d in h * np.vstack((np.eye(3), -np.eye(3)))]
        np.testing.assert_allclose(
            outdated[k], np.array([answers[i] - answers[i + 3] for i in range(3)]).T / (2 * h), atol=1e-8
        )
        answers = [step(pose[k] + d, held[k], reference[k], by) for d in h * np.vstack((np.eye(3), -np.eye(3)))]
        np.testing.assert_allclose(
            now[k], np.array([answers[i] - answers[i + 3] for i in range(3)]).T / (2 * h), atol=1e-8
        )
        limited += not outdated[k, :2].any()
    assert limited == 0 if math.isinf(v_max) else 5 < limited < 55


def test_a_of_the_paper_is_their_sum_at_zero_error() -> None:
    random = np.random.default_rng(9)
    held = random.uniform(-2.0, 2.0, (40, 3))
    pose, speeds = random.uniform(-2.0, 2.0, (40, 3)), random.uniform(-2.0, 2.0, (40, 2))
    now, outdated = loop_jacobians(pose, held, np.hstack((held, speeds)), ControllerParameters(), TS)
    np.testing.assert_allclose(
        now + outdated, matrices(pose[:, 2], held[:, 2], speeds[:, 0], ControllerParameters(), TS), atol=1e-14
    )


# -- from one reception to the next ----------------------------------------------------------------------------------


def driven(F: Floats, G: Floats, first: int, length: int) -> Floats:
    error = np.eye(3)
    for k in range(first, first + length):
        error = F[k % len(F)] @ error + G[k % len(F)]
    return error


def a_lap(steps: int) -> tuple[Floats, Floats]:
    random = np.random.default_rng(4)
    return step_matrices(
        random.uniform(0.0, 20.0, steps),
        random.uniform(-9.0, 9.0, steps),
        ControllerParameters(kx=80.0, ky=4.0, ktheta=3.0),
        TS,
    )


def test_maps_of_bursts_that_run_over_the_end_of_the_lap() -> None:
    F, G = a_lap(7)
    for length, M in enumerate(burst_maps(F, G, 16), start=1):
        np.testing.assert_allclose(M, [driven(F, G, k, length) for k in range(7)], atol=1e-12)


def test_at_constant_speeds_they_are_a_power_and_a_sum() -> None:
    """M_L = F^L + sum of F^i G over i < L; along a line 1 - a L."""
    F, G = step_matrices(np.ones(1), np.zeros(1), ControllerParameters(), TS)
    for length, M in enumerate(burst_maps(F, G, 30), start=1):
        truth = np.linalg.matrix_power(F[0], length)
        truth = truth + sum(np.linalg.matrix_power(F[0], i) @ G[0] for i in range(length))
        np.testing.assert_allclose(M[0], truth, atol=1e-12)
        assert M[0, 0, 0] == pytest.approx(1.0 - 0.125 * length, abs=1e-12)


@settings(deadline=None, derandomize=True, max_examples=40)
@given(st.sets(st.integers(0, 24), min_size=1), st.integers(0, 12))
def test_maps_between_given_receptions(steps: set[int], beyond: int) -> None:
    F, G = a_lap(25)
    received = np.array(sorted(steps), dtype=np.int64)
    end = int(received[-1]) + 1 + beyond
    ends = [*received[1:].tolist(), end]
    truth = [driven(F, G, begin, stop - begin) for begin, stop in zip(received.tolist(), ends, strict=True)]
    np.testing.assert_allclose(reception_maps(F, G, received, end), truth, atol=1e-10)


# -- what the commands can reach -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("v", "w"), [(1.0, 0.0), (0.0, 0.3), (0.0, 0.0), (-1.0, 0.2)])
def test_reach_is_the_rank_of_what_commands_do(v: float, w: float) -> None:
    """Rank of (B, F B, F^2 B), where B holds the columns by which v and w - w_r move the error where gains act."""
    F, G = (M[0] for M in step_matrices(np.array([v]), np.array([w]), ControllerParameters(), TS))
    rank = np.linalg.matrix_rank(np.hstack((G, F @ G, F @ F @ G)), tol=1e-12)
    assert reachable(np.array([v]), np.array([w])) == rank


def test_constant_speeds() -> None:
    assert is_constant(np.ones(4), np.full(4, 0.2))
    assert not is_constant(np.array([1.0, 1.0 + 1e-15]), np.zeros(2))
    assert not is_constant(np.ones(2), np.array([0.0, 1e-12]))
