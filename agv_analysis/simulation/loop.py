"""One slot of the loop, and whole runs of it, as scalar functions of floats.

What the four nodes do between one pose and the next, in lockstep: the relay passes the pose on or loses it, the error
detector compares the reference with the freshest pose that it holds, the controller answers, the relay passes the
command on or loses it, the plant integrates under the freshest command that it holds. Everything here runs both as
plain Python and compiled, so it keeps to what numba knows: floats, tuples, arrays.

What a run does not have is None: numba compiles a function anew for it, without the branch that nobody takes. The
paper's plant thus costs nothing of what can be had beside it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.metrics.convergence import NEGLIGIBLE, SHARE, TOLERANCE
from agv_cloud.control.kanayama import control_law, limit_speed
from agv_cloud.control.plan import next_error
from agv_cloud.staleness import ALIGN, PREDICT
from agv_cloud.tracking_error import tracking_error
from agv_plant.downlink_policy import share_of_command
from agv_plant.vehicle.motion import Body, Motion, integrate, measured, move

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
    policy: int
    """Staleness policy at the edge, one of `staleness.HOLD`, `ALIGN`, `PREDICT`."""
    model_arc: bool
    """The same as `arc`, for the edge's model of the plant."""
    downlink_policy: int
    policy_steps: float
    plan_arc: bool | None
    """The same as `arc`, for the controller's model, if the plant plays its plans."""
    body: Body | None
    """The AGV, if it is not the paper's, which does what it is told."""
    noise_xy: float
    noise_theta: float


class Loop(NamedTuple):
    """The loop between two slots: [m], [rad] in frame `map`, [m/s], [rad/s]."""

    x: float
    y: float
    theta: float
    x_held: float
    """The freshest pose that the edge holds; under `predict`, moved on to the next slot."""
    y_held: float
    theta_held: float
    x_then: float
    """The reference at the instant of that pose."""
    y_then: float
    theta_then: float
    n_ul: int
    """Steps since it was taken."""
    v: float
    """The newest command that the plant holds: zero before the first one arrives."""
    w: float
    n_dl: int
    """Steps since it was sent."""
    v_driven: float
    """The speeds that the plant drove at in the period before."""
    w_driven: float
    a_driven: float
    """Its acceleration in that period."""
    x_ahead: float
    """The tracking error that the plan which the plant holds expects of the next step."""
    y_ahead: float
    theta_ahead: float


class EdgeOutput(NamedTuple):
    """What the edge made of a slot: eps(k) [m, m, rad] and u(k) [m/s, rad/s]; the command is NaN if it sent none."""

    x_e: float
    y_e: float
    theta_e: float
    v: float
    w: float


class RunInputs(NamedTuple):
    """One run: the verdicts of its slots, shape (N,), the loop before slot 0 and its settings."""

    lost: Flags
    downlink_lost: Flags
    start: Loop
    settings: Settings
    noise: Rows | None = None
    """Normal numbers of its slots for the measured pose, shape (N, 4); None if there is no noise."""
    slip: Rows | None = None
    """The same for the wheels."""


def at_rest(x: float, y: float, theta: float) -> Loop:
    """The loop before slot 0 with the AGV at a pose in frame `map` [m, m, rad]."""
    return Loop(x, y, theta, x, y, theta, math.nan, math.nan, math.nan, 0, 0.0, 0.0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


# -- one slot ----------------------------------------------------------------------------------------------------------


def slot(
    loop: Loop, x_r: float, y_r: float, theta_r: float, v_r: float, w_r: float, case: RunInputs, k: int
) -> tuple[Loop, EdgeOutput]:
    """From one pose to the next, under the verdicts of both links on slot k and with the reference at this step."""
    n_left, n_right = wheels(case.slip, k)
    if case.lost[k]:
        held = outdated(loop)
        sent = edge_step(held, x_r, y_r, theta_r, v_r, w_r, case.settings)
        return plant_step(held, sent, case.downlink_lost[k], n_left, n_right, v_r, w_r, case.settings), sent
    # The same again: here the compiler sees that edge and plant speak of one angle, and takes its sine only once.
    x, y, theta = sent_pose(loop, case.noise, k, case.settings)
    held = received(loop, x, y, theta, x_r, y_r, theta_r, 0)
    sent = edge_step(held, x_r, y_r, theta_r, v_r, w_r, case.settings)
    return plant_step(held, sent, case.downlink_lost[k], n_left, n_right, v_r, w_r, case.settings), sent


def sent_pose(loop: Loop, noise: Rows | None, k: int, settings: Settings) -> tuple[float, float, float]:
    """The pose that the AGV says it has."""
    if noise is None:
        return loop.x, loop.y, loop.theta
    n_x, n_y, n_theta, _ = noise[k]
    return measured(loop.x, loop.y, loop.theta, n_x, n_y, n_theta, settings.noise_xy, settings.noise_theta)


def wheels(slip: Rows | None, k: int) -> tuple[float, float]:
    """Normal numbers of the left and the right wheel in slot k."""
    if slip is None:
        return 0.0, 0.0
    return slip[k][0], slip[k][1]


def outdated(loop: Loop) -> Loop:
    """The edge holds what it held before, one step older."""
    return Loop(
        loop.x, loop.y, loop.theta, loop.x_held, loop.y_held, loop.theta_held, loop.x_then, loop.y_then,
        loop.theta_then, loop.n_ul + 1, loop.v, loop.w, loop.n_dl, loop.v_driven, loop.w_driven,
        loop.a_driven, loop.x_ahead, loop.y_ahead, loop.theta_ahead,
    )  # fmt: skip


def received(
    loop: Loop, x: float, y: float, theta: float, x_then: float, y_then: float, theta_then: float, n_ul: int
) -> Loop:
    """The edge holds a pose that was taken n_ul steps ago, when the reference was at (x_then, y_then, theta_then)."""
    return Loop(
        loop.x, loop.y, loop.theta, x, y, theta, x_then, y_then, theta_then, n_ul, loop.v, loop.w, loop.n_dl,
        loop.v_driven, loop.w_driven, loop.a_driven, loop.x_ahead, loop.y_ahead, loop.theta_ahead,
    )  # fmt: skip


def commanded(loop: Loop, v: float, w: float, n_dl: int) -> Loop:
    """The plant holds a command that was sent n_dl steps ago [m/s, rad/s]."""
    return Loop(
        loop.x, loop.y, loop.theta, loop.x_held, loop.y_held, loop.theta_held, loop.x_then, loop.y_then,
        loop.theta_then, loop.n_ul, v, w, n_dl, loop.v_driven, loop.w_driven, loop.a_driven, loop.x_ahead, loop.y_ahead,
        loop.theta_ahead,
    )  # fmt: skip


def expecting(loop: Loop, x_ahead: float, y_ahead: float, theta_ahead: float) -> Loop:
    """The plan that the plant holds expects this error of the next step."""
    return Loop(
        loop.x, loop.y, loop.theta, loop.x_held, loop.y_held, loop.theta_held, loop.x_then, loop.y_then,
        loop.theta_then, loop.n_ul, loop.v, loop.w, loop.n_dl, loop.v_driven, loop.w_driven, loop.a_driven, x_ahead,
        y_ahead, theta_ahead,
    )  # fmt: skip


def edge_step(
    loop: Loop, x_r: float, y_r: float, theta_r: float, v_r: float, w_r: float, settings: Settings
) -> EdgeOutput:
    """The edge's answer, from the pose that it holds.

    An error beyond the range of numbers is refused by the controller, as it comes in from the wire.
    """
    if settings.policy == ALIGN:
        x_r, y_r, theta_r = loop.x_then, loop.y_then, loop.theta_then
    x_e, y_e, theta_e = tracking_error(x_r, y_r, theta_r, loop.x_held, loop.y_held, loop.theta_held)
    if not are_finite(x_e, y_e, theta_e):
        return EdgeOutput(x_e, y_e, theta_e, math.nan, math.nan)
    v, w = control_law(x_e, y_e, theta_e, v_r, w_r, settings.kx, settings.ky, settings.ktheta)
    return EdgeOutput(x_e, y_e, theta_e, limit_speed(v, settings.v_max), w)


def plant_step(
    loop: Loop, sent: EdgeOutput, lost: bool, n_left: float, n_right: float, v_r: float, w_r: float, settings: Settings
) -> Loop:
    """One sampling period of the plant under the freshest command, and of the edge's model under the one it sent.

    n_left and n_right are the wheels' normal numbers, v_r and w_r the reference's speeds, as a plan knows them. A
    command beyond the range of numbers is refused by the plant, which goes on with the one before.
    """
    v, w, n_dl = sent.v, sent.w, 0
    if lost or not are_finite(v, w, 0.0):
        v, w, n_dl = loop.v, loop.w, loop.n_dl + 1
    plan = played(loop, sent, v, w, n_dl, v_r, w_r, settings.plan_arc, settings)
    moved = period(loop, plan.v, plan.w, n_dl, n_left, n_right, settings.body, settings)
    x_held, y_held, theta_held = loop.x_held, loop.y_held, loop.theta_held
    if settings.policy == PREDICT and are_finite(sent.v, sent.w, 0.0):
        x_held, y_held, theta_held = integrate(
            settings.model_arc, x_held, y_held, theta_held, sent.v, sent.w, settings.ts
        )
    return Loop(
        moved.x, moved.y, moved.theta, x_held, y_held, theta_held, loop.x_then, loop.y_then, loop.theta_then, loop.n_ul,
        v, w, n_dl, moved.v, moved.w, moved.a, plan.x_e, plan.y_e, plan.theta_e,
    )  # fmt: skip


def played(
    loop: Loop, sent: EdgeOutput, v: float, w: float, n_dl: int, v_r: float, w_r: float, plan_arc: bool | None,
    settings: Settings,
) -> EdgeOutput:  # fmt: skip
    """What the plant drives, n_dl steps after (v, w) was sent, and the error that its plan expects of the next step."""
    if plan_arc is None:
        return EdgeOutput(loop.x_ahead, loop.y_ahead, loop.theta_ahead, v, w)
    x_e, y_e, theta_e = sent.x_e, sent.y_e, sent.theta_e
    if n_dl > 0:
        x_e, y_e, theta_e = loop.x_ahead, loop.y_ahead, loop.theta_ahead
        v, w = control_law(x_e, y_e, theta_e, v_r, w_r, settings.kx, settings.ky, settings.ktheta)
        v = limit_speed(v, settings.v_max)
    x_e, y_e, theta_e = next_error(x_e, y_e, theta_e, v, w, v_r, w_r, settings.ts, plan_arc)
    return EdgeOutput(x_e, y_e, theta_e, v, w)


def period(
    loop: Loop, v: float, w: float, n_dl: int, n_left: float, n_right: float, body: Body | None, settings: Settings
) -> Motion:
    """The plant's motion in a period under a command (v, w) that was sent n_dl steps ago."""
    if body is None:
        x, y, theta = integrate(settings.arc, loop.x, loop.y, loop.theta, v, w, settings.ts)
        return Motion(x, y, theta, v, w, 0.0)
    share = share_of_command(n_dl, settings.downlink_policy, settings.policy_steps)
    before = Motion(loop.x, loop.y, loop.theta, loop.v_driven, loop.w_driven, loop.a_driven)
    return move(before, share * v, share * w, n_left, n_right, body)


def goes_on(loop: Loop, sent: EdgeOutput) -> bool:
    """Is there a next slot? Not after a pose beyond the range of numbers, nor if the edge sent no command."""
    return are_finite(loop.x, loop.y, loop.theta) and are_finite(sent.x_e, sent.y_e, sent.theta_e)


def are_finite(a: float, b: float, c: float) -> bool:
    """Are all three finite, and their sum as well? One test instead of three, the third of a slot's time otherwise."""
    return math.isfinite(a + b + c)


# -- whole runs --------------------------------------------------------------------------------------------------------


def history(reference: Rows, case: RunInputs, rows: NDArray[np.float64], n_ul: NDArray[np.int64]) -> int:
    """One run, written down: X_c, eps and u of slot k into rows[k], shape (N, 8), its age into n_ul[k], shape (N,).

    `reference` has shape (N, 5). Returns the number of slots until the run ended, N at most.
    """
    loop = case.start
    for k in range(len(case.lost)):
        x_r, y_r, theta_r, v_r, w_r = reference[k]
        rows[k, 0], rows[k, 1], rows[k, 2] = loop.x, loop.y, loop.theta
        loop, sent = slot(loop, x_r, y_r, theta_r, v_r, w_r, case, k)
        rows[k, 3], rows[k, 4], rows[k, 5] = sent.x_e, sent.y_e, sent.theta_e
        rows[k, 6], rows[k, 7] = sent.v, sent.w
        n_ul[k] = loop.n_ul
        if not goes_on(loop, sent):
            return k + 1
    return len(case.lost)


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
    """Largest distance between AGV and reference [m]; inf where its square is."""
    position_final: float
    n_ul_max: int
    n_ul_mean: float


class MetricsAccumulator(NamedTuple):
    """A run on its way, with what has been seen of its error so far."""

    loop: Loop
    goes_on: bool
    steps: int
    outside_1cm: int
    """Last step outside the band, -1 if there was none."""
    outside_2pct: int
    band_2pct: float
    lowest: float
    highest: float
    e: float
    iae: float
    ise: float
    square: float
    """Distance between AGV and reference, squared [m^2]."""
    farthest: float
    n_ul_max: int
    n_ul_sum: int


def begin(reference: Rows, case: RunInputs) -> MetricsAccumulator:
    """A run before slot 0."""
    band = SHARE * abs(reference[0][1] - case.start.y)
    return MetricsAccumulator(case.start, True, 0, -1, -1, band, math.inf, -math.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0)


def proceed(
    run: MetricsAccumulator, k: int, x_r: float, y_r: float, theta_r: float, v_r: float, w_r: float, case: RunInputs
) -> MetricsAccumulator:
    """The run after slot k."""
    loop, sent = slot(run.loop, x_r, y_r, theta_r, v_r, w_r, case, k)
    return update_metrics(run, k, x_r, y_r, loop, sent)


def update_metrics(
    run: MetricsAccumulator, k: int, x_r: float, y_r: float, loop: Loop, sent: EdgeOutput
) -> MetricsAccumulator:
    """The run after slot k, at which the reference was at (x_r, y_r), from the loop after it and what the edge sent."""
    dx, e = x_r - run.loop.x, y_r - run.loop.y
    size, square = abs(e), dx * dx + e * e
    return MetricsAccumulator(
        loop,
        goes_on(loop, sent),
        k + 1,
        run.outside_1cm if size < TOLERANCE else k,
        run.outside_2pct if size < run.band_2pct else k,
        run.band_2pct,
        min(run.lowest, e),
        max(run.highest, e),
        e,
        run.iae + size,
        run.ise + e * e,
        square,
        max(run.farthest, square),
        max(run.n_ul_max, loop.n_ul),
        run.n_ul_sum + loop.n_ul,
    )


def end(run: MetricsAccumulator, initial: float, ts: float) -> Statistics:
    """The metrics of a run of at least one slot, from the error [m] that it began with."""
    started = abs(initial) > NEGLIGIBLE
    beyond = -run.lowest if initial > 0.0 else run.highest
    return Statistics(
        run.steps,
        run.outside_1cm + 1 if run.outside_1cm + 1 < run.steps else -1,
        run.outside_2pct + 1 if started and run.outside_2pct + 1 < run.steps else -1,
        max(0.0, beyond) / abs(initial) if started else math.nan,
        run.iae * ts,
        run.ise * ts,
        max(-run.lowest, run.highest),
        run.e,
        math.sqrt(run.farthest),
        math.sqrt(run.square),
        run.n_ul_max,
        run.n_ul_sum / run.steps,
    )


def statistics(reference: Rows, case: RunInputs) -> Statistics:
    """One run of which only the metrics are kept; `reference` has shape (N, 5)."""
    run = begin(reference, case)
    for k in range(len(case.lost)):
        x_r, y_r, theta_r, v_r, w_r = reference[k]
        run = proceed(run, k, x_r, y_r, theta_r, v_r, w_r, case)
        if not run.goes_on:
            break
    return end(run, reference[0][1] - case.start.y, case.settings.ts)


def statistics_of_two(reference: Rows, one: RunInputs, other: RunInputs) -> tuple[Statistics, Statistics]:
    """Two runs on one reference, as `statistics`; together they take little longer than one.

    A run is a chain in which everything waits for a sine of what came before; meanwhile the core works on the other.
    """
    first, second = begin(reference, one), begin(reference, other)
    for k in range(len(one.lost)):
        x_r, y_r, theta_r, v_r, w_r = reference[k]
        if first.goes_on:
            first = proceed(first, k, x_r, y_r, theta_r, v_r, w_r, one)
        if second.goes_on:
            second = proceed(second, k, x_r, y_r, theta_r, v_r, w_r, other)
    y_r = reference[0][1]
    return end(first, y_r - one.start.y, one.settings.ts), end(second, y_r - other.start.y, other.settings.ts)


def statistics_of_twins(reference: Rows, case: RunInputs, twin: Loop) -> tuple[Statistics, float]:
    """A run as `statistics`, and how far a twin of it, begun elsewhere and with the same losses, is in the end.

    That is the distance of the two AGVs in (x, y, theta) [m, m, rad] as a multiple of what it was at the beginning: a
    loop that forgets where it began contracts it. inf if either leaves the range of numbers.
    """
    run, begun, ends = begin(reference, case), twin, False
    for k in range(len(case.lost)):
        x_r, y_r, theta_r, v_r, w_r = reference[k]
        run = proceed(run, k, x_r, y_r, theta_r, v_r, w_r, case)
        if not ends:
            twin, sent = slot(twin, x_r, y_r, theta_r, v_r, w_r, case, k)
            ends = not goes_on(twin, sent)
        if not run.goes_on:
            break
    found = end(run, reference[0][1] - case.start.y, case.settings.ts)
    if ends or not run.goes_on:
        return found, math.inf
    return found, apart(run.loop, twin) / apart(case.start, begun)


def apart(one: Loop, other: Loop) -> float:
    """Distance of two AGVs in (x, y, theta) [m, m, rad], a radian counting as a meter."""
    return math.hypot(math.hypot(one.x - other.x, one.y - other.y), one.theta - other.theta)
