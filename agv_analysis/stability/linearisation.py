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
from agv_cloud.parameters import ControllerParameters


def plant_matrices(v_r: Floats, w_r: Floats, ts: float | Floats) -> tuple[Floats, Floats]:
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
