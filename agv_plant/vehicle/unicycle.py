"""The plant: a unicycle that holds its command for one sampling period.

    dx/dt = v cos(theta),  dy/dt = v sin(theta),  dtheta/dt = w

Scalar functions of floats, SI units, frame `map`. The angle is never wrapped: it counts turns.
"""

from __future__ import annotations

import math


def euler_step(x: float, y: float, theta: float, v: float, w: float, ts: float) -> tuple[float, float, float]:
    """X(k+1) = X(k) + T_s [v cos theta, v sin theta, w] (the paper's eq. 15).

    The reference track is made by this same function, so that a perfect start stays perfect to the last bit.
    """
    return x + ts * (v * math.cos(theta)), y + ts * (v * math.sin(theta)), theta + ts * w


def arc_step(x: float, y: float, theta: float, v: float, w: float, ts: float) -> tuple[float, float, float]:
    """X(k+1) on the exact circular arc of a constant (v, w).

    The chord has length v T_s sinc(w T_s / 2) and direction theta + w T_s / 2, which has no singularity at w = 0.
    """
    half = 0.5 * w * ts
    # Below 1e-4 the series of sin(h)/h is exact in double precision with two terms.
    sinc = math.sin(half) / half if abs(half) > 1e-4 else 1.0 - half * half / 6.0
    chord = v * ts * sinc
    return x + chord * math.cos(theta + half), y + chord * math.sin(theta + half), theta + w * ts


STEPS = {"euler": euler_step, "arc": arc_step}


def integrate(arc: bool, x: float, y: float, theta: float, v: float, w: float, ts: float) -> tuple[float, float, float]:
    """One sampling period along the arc, or by Euler's step."""
    if arc:
        return arc_step(x, y, theta, v, w, ts)
    return euler_step(x, y, theta, v, w, ts)


def unicycle(x: float, y: float, theta: float, v: float, w: float, dt: float, arc: bool) -> tuple[float, float, float]:
    """Pose [m, m, rad] a time `dt` [s] later at the speeds v [m/s], w [rad/s], which the vehicle takes up at once."""
    return integrate(arc, x, y, theta, v, w, dt)
