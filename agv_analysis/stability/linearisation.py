"""Kanayama's law and Euler's unicycle to first order, in closed form.

With eps = T_e(theta_c) [X_r - X_c] the tracking error obeys, for a command computed from an error that is n steps old,

    e(k+1) = F(k) e(k) + G(k) e(k-n),    phi = T_s w_r(k),  v = v_r(k)

                 [1  0  0    ]                     [K_x  0      0        ]              [ cos phi  sin phi  0]
    F = R(-phi)  [0  1  T_s v],   G = -T_s R(-phi) [0    0      0        ],   R(-phi) = [-sin phi  cos phi  0]
                 [0  0  1    ]                     [0    v K_y  v K_theta]              [ 0        0        1]

F and G hold the speeds of step k alone, so speeds may change inside a burst. The equation is exact to first order where
zero error is an equilibrium: X_r(k-n) compared with X_c(k-n). The paper compares X_r(k) with X_c(k-n), so its loop
settles n steps ahead of the reference; about that motion the equation is the same while speeds are constant, and off by
the change of speeds over n steps otherwise.

As a `linear_loop.LinearLoop` it is A = F and G = B L_h: the command (v, w) moves the error by B, and answers it by L_h.
"""

from __future__ import annotations

import numpy as np

from agv_analysis.run import Floats
from agv_cloud.control.command import limit_speed
from agv_cloud.control.kanayama import kanayama
from agv_cloud.parameters import ControllerParameters
from agv_cloud.tracking_error import tracking_error


def plant_matrices(v_r: Floats, w_r: Floats, ts: float) -> tuple[Floats, Floats]:
    """A and B at the speeds v_r [m/s], w_r [rad/s] of shape (N,); shapes (N, 3, 3) and (N, 3, 2)."""
    phi = ts * w_r
    cos, sin, zero, one = np.cos(phi), np.sin(phi), np.zeros(len(v_r)), np.ones(len(v_r))
    A = np.array([[cos, sin, sin * ts * v_r], [-sin, cos, cos * ts * v_r], [zero, zero, one]])
    B = -ts * np.array([[cos, zero], [-sin, zero], [zero, one]])
    return np.moveaxis(A, 2, 0).copy(), np.moveaxis(B, 2, 0).copy()


def command_matrices(v_r: Floats, gains: ControllerParameters) -> Floats:
    """L_h at the speeds v_r [m/s] of shape (N,); shape (N, 2, 3)."""
    L_h = np.zeros((len(v_r), 2, 3))
    L_h[:, 0, 0] = gains.kx
    L_h[:, 1, 1], L_h[:, 1, 2] = v_r * gains.ky, v_r * gains.ktheta
    return L_h


def step_matrices(v_r: Floats, w_r: Floats, gains: ControllerParameters, ts: float) -> tuple[Floats, Floats]:
    """F and G at the speeds v_r [m/s], w_r [rad/s] of shape (N,); each of shape (N, 3, 3)."""
    A, B = plant_matrices(v_r, w_r, ts)
    return A, B @ command_matrices(v_r, gains)


def loop_jacobians(
    pose: Floats, held: Floats, reference: Floats, gains: ControllerParameters, ts: float
) -> tuple[Floats, Floats]:
    """Derivatives of X_c(k+1) with respect to X_c(k) and to X_c(k-n), about any motion; each of shape (N, 3, 3).

    `pose` = X_c(k) and `held` = X_c(k-n) of shape (N, 3), `reference` = x, y, theta, v_r, w_r at step k, shape (N, 5),
    frame `map`. For Euler's step (the paper's eq. 100) under `kanayama` and `limit_speed`; a command at the limit
    does not answer to the error along the track. A(k) of eq. 55 is their sum at zero error.
    """
    theta, v_r = pose[:, 2], reference[:, 3]
    x_e, y_e, theta_e, v = np.array([_answer(r, h, gains) for r, h in zip(reference, held, strict=True)]).T
    free = (np.abs(v) < gains.v_max).astype(np.float64)
    zero = np.zeros(len(pose))
    now = np.broadcast_to(np.eye(3), (len(pose), 3, 3)).copy()
    now[:, 0, 2], now[:, 1, 2] = -ts * v * np.sin(theta), ts * v * np.cos(theta)
    command_of_error = np.array([
        [free * gains.kx, zero, -free * v_r * np.sin(theta_e)],
        [zero, v_r * gains.ky, v_r * gains.ktheta * np.cos(theta_e)],
    ])  # fmt: skip
    cos, sin = np.cos(held[:, 2]), np.sin(held[:, 2])
    error_of_pose = np.array([[-cos, -sin, y_e], [sin, -cos, -x_e], [zero, zero, zero - 1.0]])
    pose_of_command = ts * np.array([[np.cos(theta), zero], [np.sin(theta), zero], [zero, zero + 1.0]])
    return now, np.asarray(np.einsum("ijk,jlk,lmk->kim", pose_of_command, command_of_error, error_of_pose))


def _answer(reference: Floats, held: Floats, gains: ControllerParameters) -> tuple[float, float, float, float]:
    """The error that the edge sees at one step, and the speed that it commands."""
    x_r, y_r, theta_r, v_r, w_r = reference.tolist()
    x_e, y_e, theta_e = tracking_error(x_r, y_r, theta_r, *held.tolist())
    v, _ = kanayama(x_e, y_e, theta_e, v_r, w_r, gains.kx, gains.ky, gains.ktheta)
    return x_e, y_e, theta_e, limit_speed(v, gains.v_max)
