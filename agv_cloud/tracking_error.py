"""The tracking error: the reference posture seen from the AGV."""

from __future__ import annotations

from agv_ros.pose import Direction, direction_of


def tracking_error(
    x_r: float, y_r: float, theta_r: float, x_c: float, y_c: float, theta_c: float
) -> tuple[float, float, float]:
    """eps = T_e(theta_c) [X_r - X_c] (the paper's eq. 3; eq. 16 with an outdated X_c).

    All postures in frame `map` [m, m, rad]; the result (x_e, y_e, theta_e) in the AGV's frame: x_e ahead of it, y_e to
    its left. theta_e is the plain difference and may exceed pi.
    """
    return tracking_error_along(x_r, y_r, theta_r, x_c, y_c, theta_c, direction_of(theta_c))


def tracking_error_along(
    x_r: float, y_r: float, theta_r: float, x_c: float, y_c: float, theta_c: float, direction: Direction
) -> tuple[float, float, float]:
    """The same where the direction of theta_c is known already: while a pose is held it remains the same."""
    dx, dy = x_r - x_c, y_r - y_c
    cos, sin = direction.cos, direction.sin
    return cos * dx + sin * dy, -sin * dx + cos * dy, theta_r - theta_c
