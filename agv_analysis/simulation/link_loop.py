"""Runs in which an outcome depends on the place, or messages are under way for longer than their slot.

`loop` takes the outcomes of a whole run as given, and assumes that a message which is not lost arrives at once. Where
that does not hold, this is the same loop, made of the same functions: in each slot both links are evaluated first, with
the pose that the AGV sends, for the freshest message that their receivers now hold; its content is looked up in the run
so far.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import numbers
from agv_analysis.simulation.loop import (
    EdgeOutput,
    EdgeState,
    Flags,
    HeldCommand,
    Loop,
    Numbers,
    PlanState,
    Rows,
    RunInputs,
    RunMetrics,
    Settings,
    are_finite,
    begin,
    compared_reference,
    driven_command,
    edge_step,
    end,
    goes_on,
    plant_step,
    pose_distance,
    reference_at,
    sent_pose,
    update_metrics,
    wheel_noise,
    without_pose,
)
from agv_cloud.staleness.estimate import staleness_policy
from agv_plant.channels.position_dependent import EVERYWHERE, outcome_at
from agv_plant.random_stream import DRAWS
from agv_ros.pose import Pose, direction_of


class LinkInputs(NamedTuple):
    """One direction of the radio on a run of N slots."""

    lost: Flags
    """What is lost wherever the AGV is, shape (N,)."""
    kind: int
    """Which model of those that ask for the place, or EVERYWHERE."""
    spatial_table: Rows
    """What it knows of the floor, shape (M, 5)."""
    levels: Rows
    """Its levels in each slot, shape (N, 2)."""
    random: Rows
    """Random numbers of each slot, uniform in [0, 1), shape (N, DRAWS)."""
    waits: NDArray[np.int64] | list[int]
    """Slots until the message of slot k arrives if it is not lost, shape (N,)."""


class LinkTrace(NamedTuple):
    """What became of the messages of one direction, slot by slot; all of shape (N,)."""

    lost: NDArray[np.bool_]
    held: NDArray[np.int64]
    """Step of the freshest message that the receiver holds after the slot."""
    gain: NDArray[np.float64]
    """The channel's [dB], NaN if it has none."""
    due: NDArray[np.int64]
    """Step of the freshest message that arrives in the slot, 0 if there is none; zeros before the run."""


def empty_trace(steps: int) -> LinkTrace:
    """Traces of a run that has not begun."""
    return LinkTrace(
        np.zeros(steps, dtype=np.bool_), np.zeros(steps, dtype=np.int64), np.full(steps, math.nan),
        np.zeros(steps, dtype=np.int64),
    )  # fmt: skip


def link_that_holds(held: NDArray[np.int64]) -> LinkInputs:
    """A link on which the receiver holds, after slot k, the message of step `held[k]` <= k, never an older one later.

    Messages that it never holds are lost. `held` has shape (N,).
    """
    news = np.flatnonzero(np.diff(held, prepend=-1))
    lost, waits = np.ones(len(held), dtype=np.bool_), np.zeros(len(held), dtype=np.int64)
    lost[held[news]], waits[held[news]] = False, news - held[news]
    nowhere, unused, random = np.zeros((0, 5)), np.zeros((len(held), 2)), np.zeros((len(held), DRAWS))
    return LinkInputs(numbers(lost), EVERYWHERE, numbers(nowhere), numbers(unused), numbers(random), numbers(waits))


def transmit(link: LinkInputs, trace: LinkTrace, k: int, x: float, y: float) -> int:
    """Slot k of a link, of an AGV that is at (x, y) [m]: step of the freshest message that the receiver holds then."""
    lost, gain = link.lost[k], math.nan
    if link.kind != EVERYWHERE:
        is_bad, gain = outcome_at(
            link.kind, link.spatial_table, link.levels[k][0], link.levels[k][1], link.random[k][0], x, y
        )
        lost = lost or (is_bad and k > 0)
    arrival = k + link.waits[k]
    if not lost and arrival < len(trace.due):
        trace.due[arrival] = max(trace.due[arrival], k)
    trace.lost[k], trace.gain[k] = lost, gain
    held: int = max(trace.due[k], trace.held[k - 1] if k > 0 else 0)
    trace.held[k] = held
    return held


def listen(link: LinkInputs, trace: LinkTrace, places: Rows) -> None:
    """A link alone, without a loop: its slots with the AGV at the `places` [m], shape (N, 2)."""
    for k in range(len(trace.held)):
        transmit(link, trace, k, places[k][0], places[k][1])


# -- one slot ----------------------------------------------------------------------------------------------------------


class Past(NamedTuple):
    """What was sent in a run so far, row k at step k."""

    values: NDArray[np.float64]
    """Pose that the AGV sent, command, error that it answers: x, y, theta, v, w, x_e, y_e, theta_e, shape (N, 8)."""
    memory: NDArray[np.float64]
    """Memory of the control law after the step, shape (N, M)."""


def nothing_past(steps: int, memory: Numbers) -> Past:
    """The past of a run of `steps` steps that has not begun."""
    return Past(np.empty((steps, 8)), np.empty((steps, len(memory))))


def send_pose(past: Past, k: int, loop: Loop, noise: Rows | None, settings: Settings) -> None:
    """The AGV sends its pose at step k."""
    pose = sent_pose(loop.motion, noise, k, settings)
    past.values[k, 0], past.values[k, 1], past.values[k, 2] = pose.x, pose.y, pose.theta


def slot_over_links(
    loop: Loop, k: int, taken: int, ordered: int, reference: Rows, inputs: RunInputs, past: Past
) -> tuple[Loop, EdgeOutput]:
    """From one pose to the next, with the pose of step `taken` at the edge, the command of step `ordered` at the AGV.

    `past` is known up to the pose of step k; command and error of step k are written into it.
    """
    settings = inputs.settings
    compared = compared_reference(reference_at(reference, k), reference, k, settings.ahead)
    edge = at_the_edge(loop.edge, k, taken, reference, past, settings)
    sent, memory = edge_step(edge, compared, settings)
    row = past.values[k]
    row[3], row[4], row[5], row[6], row[7] = sent.v, sent.w, sent.x_e, sent.y_e, sent.theta_e
    store_memory(past.memory[k], memory)
    n_left, n_right = wheel_noise(inputs.slip, k)
    held = Loop(loop.motion, edge, loop.command, loop.plan)
    if ordered == k:
        return plant_step(held, sent, memory, False, n_left, n_right, compared, settings), sent
    v, w = past.values[ordered, 3], past.values[ordered, 4]
    if are_finite(v, w, 0.0):  # else the plant has refused it, and goes on with the one before
        is_news = ordered != k - 1 - loop.command.n_dl
        command = HeldCommand(v, w, k - 1 - ordered)
        plan = loop.plan
        if is_news:
            plan = planned(loop, ordered, k, reference, past, settings.plan_arc, settings)
        held = Loop(loop.motion, edge, command, plan)
    return plant_step(held, sent, memory, True, n_left, n_right, compared, settings), sent


def planned(
    loop: Loop, ordered: int, k: int, reference: Rows, past: Past, plan_arc: bool | None, settings: Settings
) -> PlanState:
    """The plant holds the plan of step `ordered`, and has come to its step k."""
    if plan_arc is None:
        return loop.plan
    row = past.values[ordered]
    sent = EdgeOutput(row[5], row[6], row[7], row[3], row[4])
    memory = recall_memory(past.memory[ordered])
    at_step = loop
    for step in range(ordered, k):
        compared = compared_reference(reference_at(reference, step), reference, step, settings.ahead)
        command = HeldCommand(sent.v, sent.w, step - ordered)
        _, _, plan = driven_command(at_step, sent, memory, command, compared, plan_arc, settings)
        at_step = Loop(loop.motion, loop.edge, loop.command, plan)
    return at_step.plan


def recall_memory(row: NDArray[np.float64]) -> Numbers:
    """A row of numbers as the memory of a control law; by default of one without memory. See `parts`."""
    return ()


def store_memory(row: NDArray[np.float64], memory: Numbers) -> None:
    """The memory of a control law as a row of numbers; by default of one without memory. See `parts`."""


def at_the_edge(edge: EdgeState, k: int, taken: int, reference: Rows, past: Past, settings: Settings) -> EdgeState:
    """The edge holds the pose of step `taken`; if that is news, its policy takes it on as far as step k."""
    if taken == k - 1 - edge.n_ul:
        compared = compared_reference(reference_at(reference, k), reference, k, settings.ahead)
        return without_pose(edge, compared, settings)
    row = past.values[taken]
    then = compared_reference(reference_at(reference, taken), reference, taken, settings.ahead)
    held, target = Pose(row[0], row[1], row[2]), Pose(then.x, then.y, then.theta)
    v, w = edge.v, edge.w
    first = taken if settings.is_stepwise else max(taken, k - 1)
    for step in range(first, k):
        if are_finite(past.values[step, 3], past.values[step, 4], 0.0):
            v, w = past.values[step, 3], past.values[step, 4]
        compared = compared_reference(reference_at(reference, step + 1), reference, step + 1, settings.ahead)
        held, target = staleness_policy(
            settings.policy, held, target, compared, v, w, settings.ts, settings.model_arc, settings.policy_parameters
        )
    return EdgeState(held, direction_of(held.theta), target, k - taken, edge.v, edge.w, edge.memory)


# -- whole runs --------------------------------------------------------------------------------------------------------


def history_over_links(
    reference: Rows, inputs: RunInputs, up: LinkInputs, down: LinkInputs, up_trace: LinkTrace, down_trace: LinkTrace,
    rows: NDArray[np.float64],
) -> int:  # fmt: skip
    """One run, recorded: X_c, eps and u of slot k into rows[k], shape (N, 8), and what became of its messages.

    `reference` as of `loop.history`; the outcomes of `inputs` mean nothing. Returns the number of slots until the run
    ended.
    """
    loop, past = inputs.start, nothing_past(len(rows), inputs.start.edge.memory)
    for k in range(len(rows)):
        rows[k, 0], rows[k, 1], rows[k, 2] = loop.motion.x, loop.motion.y, loop.motion.theta
        send_pose(past, k, loop, inputs.noise, inputs.settings)
        taken = transmit(up, up_trace, k, past.values[k, 0], past.values[k, 1])
        ordered = transmit(down, down_trace, k, past.values[k, 0], past.values[k, 1])
        loop, sent = slot_over_links(loop, k, taken, ordered, reference, inputs, past)
        rows[k, 3], rows[k, 4], rows[k, 5] = sent.x_e, sent.y_e, sent.theta_e
        rows[k, 6], rows[k, 7] = sent.v, sent.w
        if not goes_on(loop, sent):
            return k + 1
    return len(rows)


def statistics_over_links(
    reference: Rows, inputs: RunInputs, up: LinkInputs, down: LinkInputs, up_trace: LinkTrace, down_trace: LinkTrace,
    squares: NDArray[np.float64],
) -> RunMetrics:  # fmt: skip
    """One run of which only the metrics are kept, the traces of its links, and its squared distances [m^2], shape (N,).

    When its initial error has settled follows from the traces, and so is not known before it has ended.
    """
    run, past = begin(inputs), nothing_past(len(up_trace.held), inputs.start.edge.memory)
    for k in range(len(up_trace.held)):
        send_pose(past, k, run.loop, inputs.noise, inputs.settings)
        taken = transmit(up, up_trace, k, past.values[k, 0], past.values[k, 1])
        ordered = transmit(down, down_trace, k, past.values[k, 0], past.values[k, 1])
        loop, sent = slot_over_links(run.loop, k, taken, ordered, reference, inputs, past)
        run = update_metrics(run, k, reference_at(reference, k), loop, sent, 0)
        squares[k] = run.square
        if not run.goes_on:
            break
    return end(run, inputs)


def contraction_over_links(
    reference: Rows, inputs: RunInputs, twin: Loop, up_trace: LinkTrace, down_trace: LinkTrace
) -> float:
    """How far a run and its twin, begun elsewhere, are apart in the end, as in `loop.statistics_of_twins`.

    Both meet what the traces of the run hold: the twin loses what the run lost, wherever it is.
    """
    one, other, steps = inputs.start, twin, len(up_trace.held)
    past, past_of_twin = nothing_past(steps, one.edge.memory), nothing_past(steps, one.edge.memory)
    for k in range(steps):
        send_pose(past, k, one, inputs.noise, inputs.settings)
        send_pose(past_of_twin, k, other, inputs.noise, inputs.settings)
        taken, ordered = up_trace.held[k], down_trace.held[k]
        one, sent = slot_over_links(one, k, taken, ordered, reference, inputs, past)
        other, sent_by_twin = slot_over_links(other, k, taken, ordered, reference, inputs, past_of_twin)
        if not (goes_on(one, sent) and goes_on(other, sent_by_twin)):
            return math.inf
    return pose_distance(one.motion, other.motion) / pose_distance(inputs.start.motion, twin.motion)
