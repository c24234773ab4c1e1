"""The control law of Kanayama et al., which the paper uses."""

from __future__ import annotations

import math
from typing import Annotated

from agv_ros.parts import Quantity


def kanayama(
    x_e: float,
    y_e: float,
    theta_e: float,
    v_r: float,
    w_r: float,
    kx: Annotated[float, Quantity("gain K_x of the error along the track", "1/s", low=0.0, high=1e6)] = 25.0,
    ky: Annotated[float, Quantity("gain K_y of the error across the track", "1/m^2", low=0.0, high=1e6)] = 1.0,
    ktheta: Annotated[float, Quantity("gain K_theta of the error of heading", "1/m", low=0.0, high=1e6)] = 2.0,
) -> tuple[float, float]:
    """Command (v [m/s], w [rad/s]) from the tracking error and the reference's speeds (the paper's eq. 4).

        v = v_r cos(theta_e) + K_x x_e
        w = w_r + v_r (K_y y_e + K_theta sin(theta_e))

    Source: Kanayama et al., ICRA 1990, eq. 10.
    """
    return (
        v_r * math.cos(theta_e) + kx * x_e,
        w_r + v_r * (ky * y_e + ktheta * math.sin(theta_e)),
    )
