"""One slot of the loop, and whole runs of it, as scalar functions of floats.

What the four nodes do between one pose and the next, in lockstep: the relay passes the pose on or loses it, the error
detector compares the reference with the freshest pose that it holds, the controller answers, the relay passes the
command on or loses it, the plant integrates under the freshest command that it holds. Everything here runs both as
plain Python and compiled, so it keeps to what numba knows: floats, tuples, arrays.

Control law, staleness policy and vehicle are called by placeholders (`control_law`, `staleness_policy`,
`vehicle_step`), which `parts` replaces by those that a scenario chooses; so a loop is compiled for its own parts.

What a run does not have is None: numba compiles a function again for it, without the branch that is never taken. The
paper's plant thus pays nothing for the options that it does not use.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_cloud.control.command import command
from agv_cloud.control.command_plan import next_error
from agv_cloud.reference.point import ReferencePoint
from agv_cloud.staleness.estimate import staleness_policy
from agv_cloud.tracking_error import tracking_error_along
from agv_plant.downlink_policy import share_of_command
from agv_plant.vehicle.motion import Motion, VehicleParameters, measured, move
from agv_plant.vehicle.unicycle import integrate
from agv_ros.pose import Direction, Pose, direction_of

Rows = NDArray[np.float64] | list[list[float]]
Flags = NDArray[np.bool_] | list[bool]
Numbers = tuple[float, ...]


class Settings(NamedTuple):
    """Parameters of the scenario that a slot needs; v_max [m/s], T_s and look-ahead [s]."""

    gains: Numbers
    """Parameters of the control law, in the order of its signature."""
    v_max: float
    ts: float
    look_ahead: float
    ahead: int | None
    """Steps that the edge looks ahead of the reference of now; None: it does not."""
    arc: bool
    """Does the plant integrate along the arc, or by Euler?"""
    policy: int
    """Number of the staleness policy, if it is one of this package."""
    policy_parameters: Numbers
    is_stepwise: bool
    """Does the policy go on from its own last step, so that none may be left out?"""
    model_arc: bool
    """The same as `arc`, for the edge's model of the plant."""
    downlink_policy: int
    policy_steps: float
    plan_arc: bool | None
    """The same as `arc`, for the controller's model, if the plant plays its plans."""
    vehicle: VehicleParameters | None
    """The AGV; None for the paper's, which follows its commands exactly."""
    noise_xy: float
    noise_theta: float


class EdgeState(NamedTuple):
    """What the edge computes from."""

    held: Pose
    """The pose that it takes for the AGV's."""
    direction: Direction
    """That of its heading, computed once for as long as it is held."""
    target: Pose
    """The pose that it compares this with."""
    n_ul: int
    """Steps since the freshest pose was taken."""
    v: float
    """The command that it sent last."""
    w: float
    memory: Numbers
    """What the control law remembers."""


class HeldCommand(NamedTuple):
    """The newest command that the plant holds [m/s, rad/s]: zero before the first one arrives."""

    v: float
    w: float
    n_dl: int
    """Steps since it was sent."""


class PlanState(NamedTuple):
    """What the plan that the plant holds predicts for the next step: the tracking error, and the law's memory."""

    x_e: float
    y_e: float
    theta_e: float
    memory: Numbers


class Loop(NamedTuple):
    """The loop between two slots."""

    motion: Motion
    edge: EdgeState
    command: HeldCommand
    plan: PlanState


class EdgeOutput(NamedTuple):
    """Result of the edge for a slot: eps(k) [m, m, rad] and u(k) [m/s, rad/s]; the command is NaN if it sent none."""

    x_e: float
    y_e: float
    theta_e: float
    v: float
    w: float


class RunInputs(NamedTuple):
    """One run: the outcomes of its slots, shape (N,), the loop before slot 0 and its settings."""

    lost: Flags
    downlink_lost: Flags
    start: Loop
    settings: Settings
    noise: Rows | None = None
    """Normal numbers of its slots for the measured pose, shape (N, 4); None if there is no noise."""
    slip: Rows | None = None
    """The same for the wheels."""
    settled: int = 0
    """Step from which on the metrics of its deviation count: that at which its initial error has settled."""


def at_rest(x: float, y: float, theta: float, states: Numbers = (), memory: Numbers = ()) -> Loop:
    """The loop before slot 0 with the AGV at a pose in frame `map` [m, m, rad].

    `states` are those of its vehicle beyond the pose, `memory` what the control law begins with.
    """
    pose = Pose(x, y, theta)
    return Loop(
        Motion(x, y, theta, 0.0, 0.0, 0.0, states),
        EdgeState(pose, direction_of(theta), pose, 0, 0.0, 0.0, memory),
        HeldCommand(0.0, 0.0, 0),
        PlanState(0.0, 0.0, 0.0, memory),
    )


# -- one slot ----------------------------------------------------------------------------------------------------------


def slot(loop: Loop, reference: ReferencePoint, inputs: RunInputs, k: int) -> tuple[Loop, EdgeOutput]:
    """From one pose to the next, under the outcomes of both links in slot k, with the reference as the edge sees it."""
    n_left, n_right = wheel_noise(inputs.slip, k)
    # Computed before it is known whether the edge needs it: the plant does in any case, and so it is computed once.
    direction = direction_of(loop.motion.theta)
    if inputs.lost[k]:
        edge = without_pose(loop.edge, reference, inputs.settings)
    else:
        pose = sent_pose(loop.motion, inputs.noise, k, inputs.settings)
        if inputs.noise is not None:
            direction = direction_of(pose.theta)
        edge = with_pose(loop.edge, pose, direction, reference)
    sent, memory = edge_step(edge, reference, inputs.settings)
    held = Loop(loop.motion, edge, loop.command, loop.plan)
    return plant_step(held, sent, memory, inputs.downlink_lost[k], n_left, n_right, reference, inputs.settings), sent


def reference_at(reference: Rows, k: int) -> ReferencePoint:
    """The reference at step k."""
    x, y, theta, v, w = reference[k]
    return ReferencePoint(x, y, theta, v, w)


def compared_reference(now: ReferencePoint, reference: Rows, k: int, ahead: int | None) -> ReferencePoint:
    """The reference that the edge compares with at step k: that of now, or the one that it looks ahead to."""
    if ahead is None:
        return now
    return reference_at(reference, k + ahead)


def sent_pose(motion: Motion, noise: Rows | None, k: int, settings: Settings) -> Pose:
    """The pose that the AGV says it has."""
    if noise is None:
        return Pose(motion.x, motion.y, motion.theta)
    n_x, n_y, n_theta, _ = noise[k]
    x, y, theta = measured(
        motion.x, motion.y, motion.theta, n_x, n_y, n_theta, settings.noise_xy, settings.noise_theta
    )  # fmt: skip
    return Pose(x, y, theta)


def wheel_noise(slip: Rows | None, k: int) -> tuple[float, float]:
    """Normal numbers of the left and the right wheel in slot k."""
    if slip is None:
        return 0.0, 0.0
    return slip[k][0], slip[k][1]


def without_pose(edge: EdgeState, reference: ReferencePoint, settings: Settings) -> EdgeState:
    """No pose has arrived: what the edge holds is one step older, and its policy is applied to it."""
    held, target = staleness_policy(
        settings.policy, edge.held, edge.target, reference, edge.v, edge.w, settings.ts, settings.model_arc,
        settings.policy_parameters,
    )  # fmt: skip
    direction = edge.direction
    if settings.is_stepwise:
        direction = direction_of(held.theta)
    return EdgeState(held, direction, target, edge.n_ul + 1, edge.v, edge.w, edge.memory)


def with_pose(edge: EdgeState, pose: Pose, direction: Direction, reference: ReferencePoint) -> EdgeState:
    """The edge holds the pose of now, whose heading has this direction."""
    return EdgeState(pose, direction, Pose(reference.x, reference.y, reference.theta), 0, edge.v, edge.w, edge.memory)


def edge_step(edge: EdgeState, reference: ReferencePoint, settings: Settings) -> tuple[EdgeOutput, Numbers]:
    """The edge's answer, from the pose that it holds, and what the control law remembers after it.

    An error that is not finite is refused by the controller, as one from the wire is.
    """
    held, target = edge.held, edge.target
    x_e, y_e, theta_e = tracking_error_along(
        target.x, target.y, target.theta, held.x, held.y, held.theta, edge.direction
    )
    if not are_finite(x_e, y_e, theta_e):
        return EdgeOutput(x_e, y_e, theta_e, math.nan, math.nan), edge.memory
    v, w, memory = command(
        x_e, y_e, theta_e, reference.v, reference.w, edge.memory, settings.gains, settings.ts, settings.look_ahead,
        settings.v_max,
    )  # fmt: skip
    return EdgeOutput(x_e, y_e, theta_e, v, w), memory


def plant_step(
    loop: Loop, sent: EdgeOutput, memory: Numbers, lost: bool, n_left: float, n_right: float,
    reference: ReferencePoint, settings: Settings,
) -> Loop:  # fmt: skip
    """One sampling period of the plant under the freshest command; the edge keeps in mind what it sent.

    n_left and n_right are the wheels' normal numbers; `memory` is the control law's after this step. A command
    that is not finite is refused by the plant, which continues with the one before.
    """
    edge, held = loop.edge, HeldCommand(sent.v, sent.w, 0)
    is_finite = are_finite(sent.v, sent.w, 0.0)
    if is_finite:
        edge = EdgeState(edge.held, edge.direction, edge.target, edge.n_ul, sent.v, sent.w, memory)
    if lost or not is_finite:
        held = HeldCommand(loop.command.v, loop.command.w, loop.command.n_dl + 1)
    v, w, plan = driven_command(loop, sent, memory, held, reference, settings.plan_arc, settings)
    return Loop(period(loop.motion, v, w, held.n_dl, n_left, n_right, settings.vehicle, settings), edge, held, plan)


def driven_command(
    loop: Loop, sent: EdgeOutput, memory: Numbers, held: HeldCommand, reference: ReferencePoint,
    plan_arc: bool | None, settings: Settings,
) -> tuple[float, float, PlanState]:  # fmt: skip
    """The command that the plant executes, from the one that it holds, and its plan's prediction of the next step."""
    if plan_arc is None:
        return held.v, held.w, loop.plan
    v, w = held.v, held.w
    x_e, y_e, theta_e = sent.x_e, sent.y_e, sent.theta_e
    if held.n_dl > 0:
        x_e, y_e, theta_e = loop.plan.x_e, loop.plan.y_e, loop.plan.theta_e
        v, w, memory = command(
            x_e, y_e, theta_e, reference.v, reference.w, loop.plan.memory, settings.gains, settings.ts,
            settings.look_ahead, settings.v_max,
        )  # fmt: skip
    x_e, y_e, theta_e = next_error(x_e, y_e, theta_e, v, w, reference.v, reference.w, settings.ts, plan_arc)
    return v, w, PlanState(x_e, y_e, theta_e, memory)


def period(
    motion: Motion, v: float, w: float, n_dl: int, n_left: float, n_right: float, vehicle: VehicleParameters | None,
    settings: Settings,
) -> Motion:  # fmt: skip
    """The plant's motion in a period under a command (v, w) that was sent n_dl steps ago."""
    if vehicle is None:
        x, y, theta = integrate(settings.arc, motion.x, motion.y, motion.theta, v, w, settings.ts)
        return Motion(x, y, theta, v, w, 0.0, motion.states)
    share = share_of_command(n_dl, settings.downlink_policy, settings.policy_steps)
    return move(motion, share * v, share * w, n_left, n_right, vehicle)


def goes_on(loop: Loop, sent: EdgeOutput) -> bool:
    """Is there a next slot? Not after a pose that is not finite, nor if the edge sent no command."""
    motion = loop.motion
    return are_finite(motion.x, motion.y, motion.theta) and are_finite(sent.x_e, sent.y_e, sent.theta_e)


def are_finite(a: float, b: float, c: float) -> bool:
    """Are all three finite, and their sum as well? One test instead of three, the third of a slot's time otherwise."""
    return math.isfinite(a + b + c)


# -- whole runs --------------------------------------------------------------------------------------------------------


def history(reference: Rows, inputs: RunInputs, rows: NDArray[np.float64], n_ul: NDArray[np.int64]) -> int:
    """One run, recorded: X_c, eps and u of slot k into rows[k], shape (N, 8), its age into n_ul[k], shape (N,).

    `reference` has shape (N, 5), or as many rows more as the edge looks ahead. Returns the number of slots until the
    run ended, N at most.
    """
    loop = inputs.start
    for k in range(len(inputs.lost)):
        now = reference_at(reference, k)
        rows[k, 0], rows[k, 1], rows[k, 2] = loop.motion.x, loop.motion.y, loop.motion.theta
        loop, sent = slot(loop, compared_reference(now, reference, k, inputs.settings.ahead), inputs, k)
        rows[k, 3], rows[k, 4], rows[k, 5] = sent.x_e, sent.y_e, sent.theta_e
        rows[k, 6], rows[k, 7] = sent.v, sent.w
        n_ul[k] = loop.edge.n_ul
        if not goes_on(loop, sent):
            return k + 1
    return len(inputs.lost)


class RunMetrics(NamedTuple):
    """Metrics of one run as `convergence` and `outages` define them; unless they say otherwise, of y_r - y_c in `map`.

    `decay.decay` says what becomes of the initial error.
    """

    steps: int
    """Slots until the run ended: fewer than asked for if the loop diverged."""
    iae: float
    ise: float
    peak: float
    final: float
    position_peak: float
    """Largest distance between AGV and reference [m]; inf where its square is."""
    position_final: float
    deviation_max: float
    """The same from step `RunInputs.settled` on; 0 of a run that ended before."""
    deviation_rms: float
    """Its root mean square [m]."""
    speed_max: float
    """Largest |v| that the controller asked for [m/s]."""
    n_ul_max: int
    n_ul_mean: float


class MetricsAccumulator(NamedTuple):
    """A run in progress, with the metrics of its error so far."""

    loop: Loop
    goes_on: bool
    steps: int
    peak: float
    e: float
    iae: float
    ise: float
    square: float
    """Distance between AGV and reference, squared [m^2]."""
    farthest: float
    farthest_settled: float
    """The largest since the initial error has settled [m^2]."""
    square_sum: float
    fastest: float
    n_ul_max: int
    n_ul_sum: int


def begin(inputs: RunInputs) -> MetricsAccumulator:
    """A run before slot 0."""
    return MetricsAccumulator(inputs.start, True, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0)


def proceed(
    run: MetricsAccumulator, k: int, now: ReferencePoint, compared: ReferencePoint, inputs: RunInputs
) -> MetricsAccumulator:
    """The run after slot k, at which the reference is at `now`, and the edge compares with `compared`."""
    loop, sent = slot(run.loop, compared, inputs, k)
    return update_metrics(run, k, now, loop, sent, inputs.settled)


def update_metrics(
    run: MetricsAccumulator, k: int, now: ReferencePoint, loop: Loop, sent: EdgeOutput, settled: int
) -> MetricsAccumulator:
    """The run after slot k, from the loop after it and what the edge sent; `settled` as in `RunInputs`."""
    dx, e = now.x - run.loop.motion.x, now.y - run.loop.motion.y
    size, square = abs(e), dx * dx + e * e
    since_settled = square if k >= settled else 0.0
    return MetricsAccumulator(
        loop,
        goes_on(loop, sent),
        k + 1,
        max(run.peak, size),
        e,
        run.iae + size,
        run.ise + e * e,
        square,
        max(run.farthest, square),
        max(run.farthest_settled, since_settled),
        run.square_sum + since_settled,
        max(run.fastest, abs(sent.v)),
        max(run.n_ul_max, loop.edge.n_ul),
        run.n_ul_sum + loop.edge.n_ul,
    )


def end(run: MetricsAccumulator, inputs: RunInputs) -> RunMetrics:
    """The metrics of a run of at least one slot."""
    ts, steps_settled = inputs.settings.ts, max(1, run.steps - inputs.settled)
    return RunMetrics(
        run.steps, run.iae * ts, run.ise * ts, run.peak, run.e, math.sqrt(run.farthest), math.sqrt(run.square),
        math.sqrt(run.farthest_settled), math.sqrt(run.square_sum / steps_settled), run.fastest, run.n_ul_max,
        run.n_ul_sum / run.steps,
    )  # fmt: skip


def statistics(reference: Rows, inputs: RunInputs, squares: NDArray[np.float64]) -> RunMetrics:
    """One run of which only the metrics are kept, and its squared distances [m^2], shape (N,).

    `reference` as of `history`.
    """
    run = begin(inputs)
    for k in range(len(inputs.lost)):
        now = reference_at(reference, k)
        run = proceed(run, k, now, compared_reference(now, reference, k, inputs.settings.ahead), inputs)
        squares[k] = run.square
        if not run.goes_on:
            break
    return end(run, inputs)


def statistics_of_two(
    reference: Rows, one: RunInputs, other: RunInputs, of_one: NDArray[np.float64], of_other: NDArray[np.float64]
) -> tuple[RunMetrics, RunMetrics]:
    """Two runs on one reference, as `statistics`; together they take little longer than one.

    Each step of a run waits for a sine from the step before; meanwhile the core works on the other run.
    """
    first, second = begin(one), begin(other)
    for k in range(len(one.lost)):
        now = reference_at(reference, k)
        if first.goes_on:
            first = proceed(first, k, now, compared_reference(now, reference, k, one.settings.ahead), one)
            of_one[k] = first.square
        if second.goes_on:
            second = proceed(second, k, now, compared_reference(now, reference, k, other.settings.ahead), other)
            of_other[k] = second.square
    return end(first, one), end(second, other)


def statistics_of_twins(
    reference: Rows, inputs: RunInputs, twin: Loop, squares: NDArray[np.float64]
) -> tuple[RunMetrics, float]:
    """A run as `statistics`, and how far a twin of it, begun elsewhere and with the same losses, is in the end.

    That is the distance of the two AGVs in (x, y, theta) [m, m, rad] as a multiple of what it was at the beginning: a
    loop that forgets where it began contracts it. inf if either diverges.
    """
    run, begun, ends = begin(inputs), twin, False
    for k in range(len(inputs.lost)):
        now = reference_at(reference, k)
        compared = compared_reference(now, reference, k, inputs.settings.ahead)
        run = proceed(run, k, now, compared, inputs)
        squares[k] = run.square
        if not ends:
            twin, sent = slot(twin, compared, inputs, k)
            ends = not goes_on(twin, sent)
        if not run.goes_on:
            break
    found = end(run, inputs)
    if ends or not run.goes_on:
        return found, math.inf
    return found, pose_distance(run.loop.motion, twin.motion) / pose_distance(inputs.start.motion, begun.motion)


def pose_distance(one: Motion, other: Motion) -> float:
    """Distance of two AGVs in (x, y, theta) [m, m, rad], a radian counting as a metre."""
    return math.hypot(math.hypot(one.x - other.x, one.y - other.y), one.theta - other.theta)
