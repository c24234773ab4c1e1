"""The linearised loop against finite differences of the nonlinear one, made of the nodes' own functions."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agv_analysis.stability.linearisation import step_matrices
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
