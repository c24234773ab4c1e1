"""Pure pursuit: along the circle that leads to a point of the track ahead."""

from __future__ import annotations

import math
from typing import Annotated

from agv_ros.parts import Quantity


def pure_pursuit(
    x_e: float,
    y_e: float,
    theta_e: float,
    v_r: float,
    w_r: float,
    look_ahead: float,
    kx: Annotated[float, Quantity("gain of the distance along the circle", "1/s", low=0.0, high=1e6)] = 2.0,
    closest: Annotated[
        float,
        Quantity("distance of the point ahead below which the circle does not get tighter", "m", above=0.0, high=100.0),
    ] = 0.1,
) -> tuple[float, float]:
    """Command (v [m/s], w [rad/s]) along the circle from the AGV, tangent to its heading, to the point (x_e, y_e) [m].

    The point is where the reference will be after the time `look_ahead` [s], and v_r is its speed there. With
    d = hypot(x_e, y_e), alpha the angle to the point, and s = d alpha / sin(alpha) the length of the arc:

        v = v_r + k_x (s - v_r look_ahead)
        w = 2 v sin(alpha) / d

    On a straight line and on a circle zero error is an equilibrium; where the curvature changes the AGV cuts corners,
    the more the farther it looks ahead. A point behind the AGV is driven to backwards.
    Source: Coulter, Implementation of the Pure Pursuit Path Tracking Algorithm, CMU-RI-TR-92-01, 1992.
    """
    distance = max(math.hypot(x_e, y_e), closest)
    alpha = math.atan2(y_e, abs(x_e))
    # Below 1e-4 the series of alpha / sin(alpha) is exact in double precision with two terms.
    arc = distance * (alpha / math.sin(alpha) if abs(alpha) > 1e-4 else 1.0 + alpha * alpha / 6.0)
    v = v_r + kx * (math.copysign(arc, x_e) - v_r * look_ahead)
    return v, 2.0 * v * y_e / (distance * distance)
