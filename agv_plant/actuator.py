"""The AGV's drive: what its wheels make of a command.

Everything is off by default, and then the command is what is driven, to the last bit: the paper's plant.
"""

from __future__ import annotations

import math


def driven_speeds(
    v: float, w: float, v_before: float, w_before: float, ts: float, w_max: float, a_max: float, lag: float
) -> tuple[float, float]:
    """Speeds [m/s, rad/s] during a period under the command (v, w), after a period at (v_before, w_before).

    |w| is limited to w_max [rad/s]; both speeds follow with a first-order lag [s], as a motor controller does, exactly
    discretised: what is left of a step of the command after a period is exp(-T_s / lag); and |dv/dt| is limited to
    a_max [m/s^2].
    """
    w = min(max(w, -w_max), w_max)
    if lag > 0.0:
        left = math.exp(-ts / lag)
        v, w = v + left * (v_before - v), w + left * (w_before - w)
    if abs(v - v_before) > a_max * ts:
        v = v_before + math.copysign(a_max * ts, v - v_before)
    return v, w
