"""The controller's plan: the commands of the next steps, sent ahead with that of now.

If the downlink loses the command of a step, the AGV goes on with the newest plan that it holds: packetised predictive
control. The plan is what the controller would command if the AGV moved as its model says. Everything is seen from the
AGV, so the controller needs nothing but the tracking error and the speeds of the reference. With an exact model and an
uplink that loses nothing, outages of the downlink that are no longer than the plan do not change the loop.

Source: Bemporad, Predictive control of teleoperated constrained systems with unbounded communication delays, CDC 1998;
Quevedo and Nesic, Input-to-state stability of packetized predictive control over unreliable networks, IEEE TAC 2011.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from agv_cloud.control.command import Gains, Memory, command
from agv_cloud.tracking_error import tracking_error
from agv_plant.vehicle.unicycle import euler_step, integrate


def next_error(
    x_e: float, y_e: float, theta_e: float, v: float, w: float, v_r: float, w_r: float, ts: float, arc: bool
) -> tuple[float, float, float]:
    """eps(k+1) [m, m, rad] if AGV and reference begin at eps(k) and move on at (v, w) and (v_r, w_r) [m/s, rad/s].

    The AGV along the arc or by Euler's step, the reference by the latter, as it is defined.
    """
    x, y, theta = integrate(arc, 0.0, 0.0, 0.0, v, w, ts)
    x_r, y_r, theta_r = euler_step(x_e, y_e, theta_e, v_r, w_r, ts)
    return tracking_error(x_r, y_r, theta_r, x, y, theta)


def planned_commands(
    error: tuple[float, float, float], speeds: Iterable[tuple[float, float]], memory: Memory, gains: Gains, ts: float,
    look_ahead: float, v_max: float, arc: bool, law_command: Any = command,
) -> tuple[list[tuple[float, float]], Memory]:  # fmt: skip
    """Commands (v, w) from now on, one for each of the reference's `speeds` (v_r, w_r), the first for `error`.

    `law_command` is `command` with the chosen law in it. Also returns the law's memory after the first command, for the
    next step.
    """
    commands: list[tuple[float, float]] = []
    after_first = ahead = memory
    for v_r, w_r in speeds:
        v, w, ahead = law_command(*error, v_r, w_r, ahead, gains, ts, look_ahead, v_max)
        after_first = after_first if commands else ahead
        commands.append((v, w))
        error = next_error(*error, v, w, v_r, w_r, ts, arc)
    return commands, after_first
