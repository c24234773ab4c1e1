"""The AGV's drive: the speeds that its motors reach under a command.

Everything is off by default, and then the command is executed exactly: the paper's plant.
"""

from __future__ import annotations

import math

_LEAST_CHANGE = 1e-300
"""Of an acceleration [m/s^2] in a step: avoids division by zero."""

_MOST_STEPS = 1e9
"""More steps than any braking takes; keeps a square root that is infinite from becoming an integer."""


def driven_speeds(
    v: float,
    w: float,
    v_before: float,
    w_before: float,
    a_before: float,
    dt: float,
    w_max: float,
    a_max: float,
    j_max: float,
    lag: float,
) -> tuple[float, float, float]:
    """Speeds [m/s, rad/s] and acceleration [m/s^2] during a time dt [s] under the command (v, w), from those before.

    |w| is limited to w_max [rad/s]; both speeds follow with a first-order lag [s], as a motor controller does, exactly
    discretised: what is left of a step of the command after a time dt is exp(-dt / lag); |dv/dt| is limited to
    a_max [m/s^2] and |d2v/dt2| to j_max [m/s^3].
    """
    w, missing = min(max(w, -w_max), w_max), v - v_before
    if lag > 0.0:
        left = math.exp(-dt / lag)
        v, w = v + left * (v_before - v), w + left * (w_before - w)
    if abs(v - v_before) > a_max * dt:
        v = v_before + math.copysign(a_max * dt, v - v_before)
    a = (v - v_before) / dt
    if j_max < math.inf:
        a = smooth_acceleration(a, missing, a_before, dt, j_max)
        v = v_before + dt * a
    return v, w, a


def smooth_acceleration(wanted: float, missing: float, a_before: float, dt: float, j_max: float) -> float:
    """Acceleration [m/s^2] of a step of dt [s], near to `wanted`, that differs from the last by j_max dt at most.

    It is also small enough to be taken back in time: taken back by j_max dt a step, an acceleration a still gains

        a dt + (a - j_max dt) dt + ... = dt ((m + 1) a - j_max dt m (m + 1) / 2),  m = floor(a / (j_max dt)),

    which must not exceed the speed that is `missing` [m/s]; so a constant command is reached without overshoot, and in
    the shortest time. In continuous time that is the double S profile, a <= sqrt(2 j_max |missing|); Biagiotti and
    Melchiorri, Trajectory Planning for Automatic Machines and Robots, 2008, section 3.4.
    """
    change, distance = max(j_max * dt, _LEAST_CHANGE), abs(missing)
    m = math.floor(min(_MOST_STEPS, 0.5 * (math.sqrt(1.0 + 8.0 * (distance / dt) / change) - 1.0)))
    largest = (distance / dt + 0.5 * change * m * (m + 1)) / (m + 1)
    a = min(max(wanted, -largest), largest)  # not by its modulus, which has no derivative at a steady speed
    return min(max(a, a_before - change), a_before + change)
