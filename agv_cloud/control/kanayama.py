"""The control law of Kanayama et al. with a limit on speed."""

from __future__ import annotations

import math


def control_law(
    x_e: float, y_e: float, theta_e: float, v_r: float, w_r: float, kx: float, ky: float, ktheta: float
) -> tuple[float, float]:
    """Command (v [m/s], w [rad/s]) from the tracking error and the reference's speeds (the paper's eq. 15).

        v = v_r cos(theta_e) + K_x x_e
        w = w_r + v_r (K_y y_e + K_theta sin(theta_e))

    K_x [1/s], K_y [1/m^2], K_theta [1/m]. Source: Kanayama et al., ICRA 1990, eq. 10.
    """
    return (
        v_r * math.cos(theta_e) + kx * x_e,
        w_r + v_r * (ky * y_e + ktheta * math.sin(theta_e)),
    )


def limit_speed(v: float, v_max: float) -> float:
    """`v` limited to |v| <= v_max [m/s], in both directions; inf: no limit. NaN stays NaN."""
    return min(max(v, -v_max), v_max)
