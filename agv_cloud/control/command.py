"""The command: a control law's answer to the tracking error, within the limits of the controller."""

from __future__ import annotations

from agv_cloud.control.kanayama import kanayama

Memory = tuple[float, ...]
"""What a control law remembers from one step to the next."""

Gains = tuple[float, ...]
"""The parameters of a control law, in the order of its signature."""


def control_law(
    x_e: float, y_e: float, theta_e: float, v_r: float, w_r: float, memory: Memory, gains: Gains, ts: float,
    look_ahead: float,
) -> tuple[float, float, Memory]:  # fmt: skip
    """The law of a loop as the loop calls it: (v [m/s], w [rad/s], memory after the step).

    By default Kanayama's; another one that is chosen replaces it.
    """
    v, w = kanayama(x_e, y_e, theta_e, v_r, w_r, gains[0], gains[1], gains[2])
    return v, w, memory


def command(
    x_e: float, y_e: float, theta_e: float, v_r: float, w_r: float, memory: Memory, gains: Gains, ts: float,
    look_ahead: float, v_max: float,
) -> tuple[float, float, Memory]:  # fmt: skip
    """Command (v [m/s], w [rad/s]) of the chosen law, |v| limited to `v_max` [m/s], and the law's memory after it.

    Tracking error [m, m, rad] in the AGV's frame, speeds of the reference [m/s, rad/s], sampling period `ts` [s]; a law
    that looks ahead gets the error to where the reference will be `look_ahead` [s] later, and its speeds there.
    """
    v, w, memory = control_law(x_e, y_e, theta_e, v_r, w_r, memory, gains, ts, look_ahead)
    return limit_speed(v, v_max), w, memory


def limit_speed(v: float, v_max: float) -> float:
    """`v` limited to |v| <= v_max [m/s], in both directions; inf: no limit. NaN stays NaN."""
    return min(max(v, -v_max), v_max)
