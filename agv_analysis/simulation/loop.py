"""One slot of the loop, and whole runs of it, as scalar functions of floats.

What the four nodes do between one pose and the next, in lockstep: the relay passes the pose on or loses it, the error
detector compares the reference with the freshest pose that it holds, the controller answers, the relay passes the
command on or loses it, the plant integrates under the freshest command that it holds. Everything here runs both as
plain Python and compiled, so it keeps to what numba knows: floats, tuples, arrays.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.convergence import NEGLIGIBLE, SHARE, TOLERANCE
from agv_cloud.control_law import control_law, limit_speed
from agv_cloud.tracking_error import tracking_error
from agv_plant.unicycle import arc_step, euler_step

Rows = NDArray[np.float64] | list[list[float]]
Flags = NDArray[np.bool_] | list[bool]


class Settings(NamedTuple):
    """What a slot needs to know of the scenario; K_x [1/s], K_y [1/m^2], K_theta [1/m], v_max [m/s], T_s [s]."""

    kx: float
    ky: float
    ktheta: float
    v_max: float
    ts: float
    arc: bool
    """Does the plant integrate along the arc, or by Euler?"""


class Loop(NamedTuple):
    """The loop between two slots: [m], [rad] in frame `map`, [m/s], [rad/s]."""

    x: float
    y: float
    theta: float
    x_held: float
    """The freshest pose that the edge holds."""
    y_held: float
    theta_held: float
    n_ul: int
    """Steps since it was taken."""
    v: float
    """The command that the plant obeys: zero before the first one arrives."""
    w: float


class Answer(NamedTuple):
    """What the edge made of a slot: eps(k) [m, m, rad] and u(k) [m/s, rad/s]; the command is NaN if it sent none."""

    x_e: float
    y_e: float
    theta_e: float
    v: float
    w: float


def at_rest(x: float, y: float, theta: float) -> Loop:
    """The loop before slot 0 with the AGV at a pose in frame `map` [m, m, rad]."""
    return Loop(x, y, theta, x, y, theta, 0, 0.0, 0.0)


def answer(loop: Loop, x_r: float, y_r: float, theta_r: float, v_r: float, w_r: float, settings: Settings) -> Answer:
    """The edge's answer to a slot, from the pose that it holds and the reference at this step.

    An error beyond the range of numbers is refused by the controller, as it comes in from the wire.
    """
    x_e, y_e, theta_e = tracking_error(x_r, y_r, theta_r, loop.x_held, loop.y_held, loop.theta_held)
    if not (math.isfinite(x_e) and math.isfinite(y_e) and math.isfinite(theta_e)):
        return Answer(x_e, y_e, theta_e, math.nan, math.nan)
    v, w = control_law(x_e, y_e, theta_e, v_r, w_r, settings.kx, settings.ky, settings.ktheta)
    return Answer(x_e, y_e, theta_e, limit_speed(v, settings.v_max), w)


def hear(loop: Loop, lost: bool) -> Loop:
    """The loop after the uplink's verdict: the edge holds the pose of this step, or an outdated one."""
    if lost:
        return Loop(
            loop.x, loop.y, loop.theta, loop.x_held, loop.y_held, loop.theta_held, loop.n_ul + 1, loop.v, loop.w
        )
    return Loop(loop.x, loop.y, loop.theta, loop.x, loop.y, loop.theta, 0, loop.v, loop.w)


def obey(loop: Loop, v: float, w: float, lost: bool, settings: Settings) -> Loop:
    """The loop after the downlink's verdict and one sampling period under the freshest command.

    A command that is not finite is refused by the plant, which goes on with the one before.
    """
    if lost or not (math.isfinite(v) and math.isfinite(w)):
        v, w = loop.v, loop.w
    if settings.arc:
        x, y, theta = arc_step(loop.x, loop.y, loop.theta, v, w, settings.ts)
    else:
        x, y, theta = euler_step(loop.x, loop.y, loop.theta, v, w, settings.ts)
    return Loop(x, y, theta, loop.x_held, loop.y_held, loop.theta_held, loop.n_ul, v, w)


def goes_on(loop: Loop, sent: Answer) -> bool:
    """Is there a next slot? Not after a pose beyond the range of numbers, nor if the edge sent no command."""
    return (
        math.isfinite(loop.x)
        and math.isfinite(loop.y)
        and math.isfinite(loop.theta)
        and math.isfinite(sent.x_e)
        and math.isfinite(sent.y_e)
        and math.isfinite(sent.theta_e)
    )


def history(
    reference: Rows,
    lost: Flags,
    downlink_lost: Flags,
    loop: Loop,
    settings: Settings,
    rows: NDArray[np.float64],
    n_ul: NDArray[np.int64],
) -> int:
    """One run, written down: X_c, eps and u of slot k into rows[k], shape (N, 8), its age into n_ul[k], shape (N,).

    `reference` has shape (N, 5), the verdicts (N,). Returns the number of slots until the run ended, N at most.
    """
    for k in range(len(lost)):
        target = reference[k]
        loop = hear(loop, lost[k])
        sent = answer(loop, target[0], target[1], target[2], target[3], target[4], settings)
        rows[k, 0], rows[k, 1], rows[k, 2] = loop.x, loop.y, loop.theta
        rows[k, 3], rows[k, 4], rows[k, 5] = sent.x_e, sent.y_e, sent.theta_e
        rows[k, 6], rows[k, 7] = sent.v, sent.w
        n_ul[k] = loop.n_ul
        loop = obey(loop, sent.v, sent.w, downlink_lost[k], settings)
        if not goes_on(loop, sent):
            return k + 1
    return len(lost)


class Statistics(NamedTuple):
    """Metrics of one run, as `convergence` and `outages` define them; unless they say otherwise, of y_r - y_c in `map`.

    A settling that did not happen is -1, an overshoot that does not exist NaN.
    """

    steps: int
    """Slots until the run ended: fewer than asked for if the loop left the range of numbers."""
    settle_1cm_steps: int
    settle_2pct_steps: int
    overshoot: float
    iae: float
    ise: float
    peak: float
    final: float
    position_peak: float
    """Largest distance between AGV and reference [m]."""
    position_final: float
    n_ul_max: int
    n_ul_mean: float


def statistics(reference: Rows, lost: Flags, downlink_lost: Flags, loop: Loop, settings: Settings) -> Statistics:
    """One run of which only the metrics are kept; arguments as those of `history`."""
    initial = reference[0][1] - loop.y
    band, started = SHARE * abs(initial), abs(initial) > NEGLIGIBLE
    outside_1cm, outside_2pct, steps, n_ul_max, n_ul_sum = -1, -1, 0, 0, 0
    overshoot, iae, ise, peak, e, distance, farthest = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(lost)):
        target = reference[k]
        e = target[1] - loop.y
        size, distance = abs(e), math.hypot(target[0] - loop.x, e)
        if not size < TOLERANCE:
            outside_1cm = k
        if not size < band:
            outside_2pct = k
        overshoot = max(overshoot, -e if initial > 0.0 else e)
        iae, ise = iae + size, ise + e * e
        peak, farthest = max(peak, size), max(farthest, distance)
        loop = hear(loop, lost[k])
        n_ul_max, n_ul_sum = max(n_ul_max, loop.n_ul), n_ul_sum + loop.n_ul
        sent = answer(loop, target[0], target[1], target[2], target[3], target[4], settings)
        loop = obey(loop, sent.v, sent.w, downlink_lost[k], settings)
        steps = k + 1
        if not goes_on(loop, sent):
            break
    return Statistics(
        steps,
        outside_1cm + 1 if outside_1cm + 1 < steps else -1,
        outside_2pct + 1 if started and outside_2pct + 1 < steps else -1,
        overshoot / abs(initial) if started else math.nan,
        iae * settings.ts,
        ise * settings.ts,
        peak,
        e,
        farthest,
        distance,
        n_ul_max,
        n_ul_sum / steps,
    )
