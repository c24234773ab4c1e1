"""The tracking error: the reference posture seen from the AGV."""

from __future__ import annotations

import math


def tracking_error(
    x_r: float, y_r: float, theta_r: float, x_c: float, y_c: float, theta_c: float
) -> tuple[float, float, float]:
    """eps = T_e(theta_c) [X_r - X_c] (the paper's eq. 10; eq. 1000 with an outdated X_c).

    All postures in frame `map` [m, m, rad]; the result (x_e, y_e, theta_e) in the AGV's frame: x_e ahead of it, y_e to
    its left. theta_e is the plain difference and may exceed pi.
    """
    dx, dy = x_r - x_c, y_r - y_c
    cos, sin = math.cos(theta_c), math.sin(theta_c)
    return cos * dx + sin * dy, -sin * dx + cos * dy, theta_r - theta_c
