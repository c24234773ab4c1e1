"""Runs in which a verdict depends on the place, or messages are under way for longer than their slot.

`loop` takes the verdicts of a whole run as given, and a message that is not lost as here. Where that is not so, this is
the same loop, made of the same functions: in each slot both links are asked first, with the pose that the AGV sends,
for the freshest message that their receivers now hold; what it said is looked up in the run so far.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.simulation.loop import (
    EdgeOutput,
    Flags,
    Loop,
    MetricsAccumulator,
    Rows,
    RunInputs,
    Settings,
    Statistics,
    apart,
    are_finite,
    begin,
    commanded,
    edge_step,
    end,
    expecting,
    goes_on,
    outdated,
    plant_step,
    played,
    received,
    sent_pose,
    update_metrics,
    wheels,
)
from agv_cloud.staleness import PREDICT
from agv_plant.channels.position_dependent import EVERYWHERE, verdict_at
from agv_plant.vehicle.motion import integrate


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
    """Marks of a run that has not begun."""
    return LinkTrace(
        np.zeros(steps, dtype=np.bool_), np.zeros(steps, dtype=np.int64), np.full(steps, math.nan),
        np.zeros(steps, dtype=np.int64),
    )  # fmt: skip


def transmit(way: LinkInputs, marks: LinkTrace, k: int, x: float, y: float) -> int:
    """Slot k of a link, of an AGV that is at (x, y) [m]: step of the freshest message that the receiver holds then."""
    lost, gain = way.lost[k], math.nan
    if way.kind != EVERYWHERE:
        is_bad, gain = verdict_at(
            way.kind, way.spatial_table, way.levels[k][0], way.levels[k][1], way.random[k][0], x, y
        )
        lost = lost or (is_bad and k > 0)
    arrival = k + way.waits[k]
    if not lost and arrival < len(marks.due):
        marks.due[arrival] = max(marks.due[arrival], k)
    marks.lost[k], marks.gain[k] = lost, gain
    held: int = max(marks.due[k], marks.held[k - 1] if k > 0 else 0)
    marks.held[k] = held
    return held


def listen(way: LinkInputs, marks: LinkTrace, places: Rows) -> None:
    """A link alone, without a loop: its slots with the AGV at the `places` [m], shape (N, 2)."""
    for k in range(len(marks.held)):
        transmit(way, marks, k, places[k][0], places[k][1])


# -- one slot ----------------------------------------------------------------------------------------------------------


def slot_over_links(
    loop: Loop, k: int, taken: int, ordered: int, reference: Rows, case: RunInputs, past: NDArray[np.float64]
) -> tuple[Loop, EdgeOutput]:
    """From one pose to the next, with the pose of step `taken` at the edge, the command of step `ordered` at the AGV.

    `past` has the poses that were sent, the commands, and the errors that they answer, (x, y, theta, v, w, x_e, y_e,
    theta_e) in a row, up to the pose of step k; command and error of step k are written into it.
    """
    x_r, y_r, theta_r, v_r, w_r = reference[k]
    held = at_the_edge(loop, k, taken, reference, past, case.settings)
    sent = edge_step(held, x_r, y_r, theta_r, v_r, w_r, case.settings)
    past[k, 3], past[k, 4] = sent.v, sent.w
    past[k, 5], past[k, 6], past[k, 7] = sent.x_e, sent.y_e, sent.theta_e
    n_left, n_right = wheels(case.slip, k)
    if ordered == k:
        return plant_step(held, sent, False, n_left, n_right, v_r, w_r, case.settings), sent
    v, w = past[ordered, 3], past[ordered, 4]
    if are_finite(v, w, 0.0):  # else the plant has refused it, and goes on with the one before
        is_news = ordered != k - 1 - loop.n_dl
        held = commanded(held, v, w, k - 1 - ordered)
        if is_news:
            held = planned(held, ordered, k, reference, past, case.settings.plan_arc, case.settings)
    return plant_step(held, sent, True, n_left, n_right, v_r, w_r, case.settings), sent


def planned(
    loop: Loop, ordered: int, k: int, reference: Rows, past: NDArray[np.float64], plan_arc: bool | None,
    settings: Settings,
) -> Loop:  # fmt: skip
    """The plant holds the plan of step `ordered`, and has come to its step k."""
    if plan_arc is None:
        return loop
    sent = EdgeOutput(past[ordered, 5], past[ordered, 6], past[ordered, 7], past[ordered, 3], past[ordered, 4])
    x, y, theta = loop.x_ahead, loop.y_ahead, loop.theta_ahead
    for step in range(ordered, k):
        _, _, _, v_r, w_r = reference[step]
        at_step = expecting(loop, x, y, theta)
        plan = played(at_step, sent, sent.v, sent.w, step - ordered, v_r, w_r, plan_arc, settings)
        x, y, theta = plan.x_e, plan.y_e, plan.theta_e
    return expecting(loop, x, y, theta)


def at_the_edge(loop: Loop, k: int, taken: int, reference: Rows, past: NDArray[np.float64], settings: Settings) -> Loop:
    """The edge holds the pose of step `taken`; if that is news, it goes through its model as far as the step k."""
    if taken == k - 1 - loop.n_ul:
        return outdated(loop)
    x, y, theta = past[taken, 0], past[taken, 1], past[taken, 2]
    if settings.policy == PREDICT:
        for step in range(taken, k):
            v, w = past[step, 3], past[step, 4]
            if are_finite(v, w, 0.0):
                x, y, theta = integrate(settings.model_arc, x, y, theta, v, w, settings.ts)
    return received(loop, x, y, theta, reference[taken][0], reference[taken][1], reference[taken][2], k - taken)


# -- whole runs --------------------------------------------------------------------------------------------------------


def history_over_links(
    reference: Rows,
    case: RunInputs,
    up: LinkInputs,
    down: LinkInputs,
    up_marks: LinkTrace,
    down_marks: LinkTrace,
    rows: NDArray[np.float64],
) -> int:
    """One run, written down: X_c, eps and u of slot k into rows[k], shape (N, 8), and what became of its messages.

    `reference` has shape (N, 5); the verdicts of `case` mean nothing. Returns the number of slots until the run ended.
    """
    loop, past = case.start, np.empty((len(rows), 8))
    for k in range(len(rows)):
        rows[k, 0], rows[k, 1], rows[k, 2] = loop.x, loop.y, loop.theta
        past[k, 0], past[k, 1], past[k, 2] = sent_pose(loop, case.noise, k, case.settings)
        taken = transmit(up, up_marks, k, past[k, 0], past[k, 1])
        ordered = transmit(down, down_marks, k, past[k, 0], past[k, 1])
        loop, sent = slot_over_links(loop, k, taken, ordered, reference, case, past)
        rows[k, 3], rows[k, 4], rows[k, 5] = sent.x_e, sent.y_e, sent.theta_e
        rows[k, 6], rows[k, 7] = sent.v, sent.w
        if not goes_on(loop, sent):
            return k + 1
    return len(rows)


def statistics_over_links(
    reference: Rows, case: RunInputs, up: LinkInputs, down: LinkInputs, up_marks: LinkTrace, down_marks: LinkTrace
) -> Statistics:
    """One run of which only the metrics are kept, and the marks."""
    run, past = begin(reference, case), np.empty((len(up_marks.held), 8))
    for k in range(len(past)):
        past[k, 0], past[k, 1], past[k, 2] = sent_pose(run.loop, case.noise, k, case.settings)
        taken = transmit(up, up_marks, k, past[k, 0], past[k, 1])
        ordered = transmit(down, down_marks, k, past[k, 0], past[k, 1])
        run = proceed_over_links(run, k, taken, ordered, reference, case, past)
        if not run.goes_on:
            break
    return end(run, reference[0][1] - case.start.y, case.settings.ts)


def proceed_over_links(
    run: MetricsAccumulator,
    k: int,
    taken: int,
    ordered: int,
    reference: Rows,
    case: RunInputs,
    past: NDArray[np.float64],
) -> MetricsAccumulator:
    """The run after slot k, as `loop.proceed`."""
    loop, sent = slot_over_links(run.loop, k, taken, ordered, reference, case, past)
    return update_metrics(run, k, reference[k][0], reference[k][1], loop, sent)


def contraction_over_links(
    reference: Rows, case: RunInputs, twin: Loop, up_marks: LinkTrace, down_marks: LinkTrace
) -> float:
    """How far a run and its twin, begun elsewhere, are apart in the end, as in `loop.statistics_of_twins`.

    Both meet what was marked when the run was made: the twin loses what the run lost, wherever it is.
    """
    one, other = case.start, twin
    past, past_of_twin = np.empty((len(up_marks.held), 8)), np.empty((len(up_marks.held), 8))
    for k in range(len(past)):
        past[k, 0], past[k, 1], past[k, 2] = sent_pose(one, case.noise, k, case.settings)
        past_of_twin[k, 0], past_of_twin[k, 1], past_of_twin[k, 2] = sent_pose(other, case.noise, k, case.settings)
        one, sent = slot_over_links(one, k, up_marks.held[k], down_marks.held[k], reference, case, past)
        other, said = slot_over_links(other, k, up_marks.held[k], down_marks.held[k], reference, case, past_of_twin)
        if not (goes_on(one, sent) and goes_on(other, said)):
            return math.inf
    return apart(one, other) / apart(case.start, twin)
