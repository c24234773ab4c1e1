"""Linear state feedback of the tracking error."""

from __future__ import annotations

from typing import Annotated

from agv_ros.parts import Quantity


def state_feedback(
    x_e: float,
    y_e: float,
    theta_e: float,
    v_r: float,
    w_r: float,
    kx: Annotated[float, Quantity("gain k_x of the error along the track", "1/s", low=0.0, high=1e6)] = 2.0,
    ky: Annotated[float, Quantity("gain k_y of the error across the track", "rad/(m s)", low=0.0, high=1e6)] = 1.0,
    ktheta: Annotated[float, Quantity("gain k_theta of the error of heading", "1/s", low=0.0, high=1e6)] = 2.0,
) -> tuple[float, float]:
    """Command (v [m/s], w [rad/s]) that is linear in the tracking error.

        v = v_r + k_x x_e
        w = w_r + k_y y_e + k_theta theta_e

    theta_e [rad] counts turns. While v_r = 0 it cannot bring the AGV back across the track, and turns it all the same;
    with k_y > 0 it is unstable behind a reference that drives backwards.
    Source: the linear design of Canudas de Wit et al., Theory of Robot Control, 1996, 9.4.1, with constant gains.
    """
    return v_r + kx * x_e, w_r + ky * y_e + ktheta * theta_e
