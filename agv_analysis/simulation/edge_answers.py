"""What the edge of a scenario answers to recorded inputs, and how far recorded answers are from that.

Two questions, asked of the same functions that the nodes call: which errors and commands follow from the recorded
poses, and which commands follow from the recorded errors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import numbers
from agv_analysis.metrics.error_metrics import body_errors, wrapped
from agv_analysis.run import Floats, Run
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.loop import (
    EdgeState,
    Numbers,
    Rows,
    Settings,
    are_finite,
    at_rest,
    edge_step,
    reference_at,
    with_pose,
    without_pose,
)
from agv_analysis.simulation.parts import replacements_of, run_parts
from agv_analysis.simulation.reference import reference_of
from agv_analysis.simulation.single import settings_of
from agv_cloud.control.command import command, control_law
from agv_cloud.control.registry import CONTROL_LAWS
from agv_cloud.parameters import PATH
from agv_cloud.staleness.registry import HOLD, number_of
from agv_ros.errors import UserError
from agv_ros.parts import PartError
from agv_ros.pose import Pose, direction_of

TOLERANCE = 1e-9
"""Largest difference that is none, as a share of the recorded value where that is above 1."""

Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Difference:
    """How far one answer of the edge is from the recorded one; a size is the largest over its components."""

    compared: int
    """Number of steps with both."""
    first: int | None
    """First step k that differs by more than TOLERANCE; None: none does."""
    first_size: float
    """Difference at that step [m, rad] or [m/s, rad/s], 0 if none differs; inf: today's answer is not a number."""
    largest: float
    largest_at: int
    """Step of the largest difference."""


def sizes_of(apart: Floats) -> Floats:
    """Largest difference of each step over its components, shape (N,).

    A computed answer that is not a number, where the recording has one, differs without bound.
    """
    return np.asarray(np.nan_to_num(np.abs(apart), nan=np.inf, posinf=np.inf).max(axis=1, initial=0.0))


def differs(sizes: Floats, recorded: Floats) -> NDArray[np.bool_]:
    """Which steps differ by more than TOLERANCE from the recorded values, shape (N, m)."""
    return np.asarray(sizes > TOLERANCE * np.maximum(1.0, np.abs(recorded).max(axis=1, initial=0.0)))


def difference(k: Integers, apart: Floats, recorded: Floats) -> Difference:
    """How far answers are `apart` from the `recorded` ones at the steps `k`, of which there is at least one."""
    sizes = sizes_of(apart)
    wrong, largest = np.flatnonzero(differs(sizes, recorded)), int(np.argmax(sizes))
    return Difference(
        compared=len(k),
        first=int(k[wrong[0]]) if len(wrong) else None,
        first_size=float(sizes[wrong[0]]) if len(wrong) else 0.0,
        largest=float(sizes[largest]),
        largest_at=int(k[largest]),
    )


def errors_apart(error: Floats, recorded: Floats) -> Floats:
    """Tracking errors minus recorded ones, shape (N, 3); headings within a turn."""
    apart = error - recorded
    apart[:, 2] = wrapped(apart[:, 2])
    return apart


# -- from poses --------------------------------------------------------------------------------------------------------


def held_poses(run: Run) -> tuple[Integers, NDArray[np.bool_]]:
    """Row of the pose that the edge held at each step, and whether it is in the recording; shapes (N,)."""
    held = np.minimum(np.searchsorted(run.k, run.k - run.n_ul), len(run) - 1)
    return held, run.k[held] == run.k - run.n_ul


def answers_to_poses(run: Run, scenario: Scenario) -> tuple[Floats, Floats]:
    """Errors, shape (N, 3), and commands, shape (N, 2), that follow from the poses that the edge held.

    NaN where the recording does not hold the edge's pose. What was sent, as a policy may want to know it, is taken from
    the recorded commands. Raises PartError, naming the step, if a part raises.
    """
    held, there = held_poses(run)
    rows, reached = np.full((len(run), 5), np.nan), np.zeros(1, dtype=np.int64)
    row_at = np.full(int(run.k[-1] - run.k[0]) + 1, -1, dtype=np.int64)
    row_at[run.k - run.k[0]] = np.arange(len(run))
    try:
        run_parts(
            answer_poses, replacements_of(scenario), numbers(run.sent_pose), numbers(np.where(there, held, -1)),
            numbers(run.k), numbers(row_at), numbers(_compared_reference(run, scenario)), numbers(run.command),
            CONTROL_LAWS.find(scenario.controller.law).memory, settings_of(scenario), rows, reached,
        )  # fmt: skip
    except PartError as error:
        raise PartError(f"{error}, at step {run.k[reached[0]]}") from error
    return rows[:, :3], rows[:, 3:]


def errors_of_poses(run: Run, scenario: Scenario) -> Floats:
    """Errors, shape (N, 3), that follow from the poses that the edge held; NaN where the recording does not hold them.

    Raises PartError as `answers_to_poses`.
    """
    if number_of(scenario.error_detector.policy) != HOLD:
        return answers_to_poses(run, scenario)[0]
    held, there = held_poses(run)  # which is all that matters: nothing to be stepped through
    reference = _compared_reference(run, scenario)[run.k - run.k[0]]
    return np.where(there[:, None], body_errors(reference, run.sent_pose[held]), np.nan)


def answer_poses(
    poses: Rows, held: Any, k: Any, row_at: Any, reference: Rows, sent: Rows, memory: Numbers, settings: Settings,
    rows: Floats, reached: Integers,
) -> None:  # fmt: skip
    """Fill in eps and u of each row, shape (N, 5), whose pose is in the row held[i] >= 0 of `poses`.

    `row_at` is the row of each step, -1 for none, and `reference` X_r at each step, from the first of `k` on.
    `reached[0]` is the row that was begun last.
    """
    edge, first = at_rest(0.0, 0.0, 0.0, (), memory).edge, k[0]
    now, taken = -1, -1  # the step that the edge's estimate is for, and that at which its pose was taken
    for i in range(len(k)):
        if held[i] < 0:
            continue
        reached[0] = i
        if k[held[i]] != taken or k[i] < now:
            now = taken = k[held[i]]
            x, y, theta = poses[held[i]]
            edge = with_pose(edge, Pose(x, y, theta), direction_of(theta), reference_at(reference, taken - first))
        if not settings.is_stepwise:
            now = max(now, k[i] - 1)
        while now < k[i]:
            row = row_at[now - first]
            v, w = edge.v, edge.w
            if row >= 0 and are_finite(sent[row][0], sent[row][1], 0.0):
                v, w = sent[row]
            edge = EdgeState(edge.held, edge.direction, edge.target, edge.n_ul, v, w, edge.memory)
            edge = without_pose(edge, reference_at(reference, now + 1 - first), settings)
            now += 1
        answer, after = edge_step(edge, reference_at(reference, k[i] - first), settings)
        edge = EdgeState(edge.held, edge.direction, edge.target, edge.n_ul, edge.v, edge.w, after)
        rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3], rows[i, 4] = answer


def _compared_reference(run: Run, scenario: Scenario) -> Floats:
    """What the edge compares with at each step from the run's first to its last, shape (steps, 5).

    The scenario's track, or, along paths, the recorded reference: of a path that is not recorded as far ahead as the
    edge looked the last point that is.
    """
    first, last, ahead = int(run.k[0]), int(run.k[-1]), scenario.error_detector.steps_ahead
    if scenario.error_detector.track != PATH:
        return reference_of(scenario.error_detector, last + ahead + 1)[first + ahead :]
    steps = np.arange(first, last + 1) + ahead
    row = np.minimum(np.searchsorted(run.k, steps), len(run) - 1)
    return run.reference[np.where(run.k[row] == steps, row, len(run) - 1)]


# -- from errors -------------------------------------------------------------------------------------------------------


def speeds_with_errors(run: Run) -> Floats:
    """Speeds (v_r, w_r) [m/s, rad/s] of the reference that go with the errors of a run, shape (N, 2).

    Raises UserError for a run along paths in which they are not recorded.
    """
    if run.error_speeds is not None:
        return run.error_speeds
    return _compared_reference(run, run.scenario)[run.k - run.k[0], 3:5]


def answers_to_errors(
    error: Floats, speeds: Floats, memory: Numbers, settings: Settings, scenario: Scenario
) -> tuple[Floats, Numbers]:
    """Commands, shape (N, 2), that follow from errors and the reference's speeds, and the law's memory after them.

    NaN for an error that is not finite, and from the first error on that the law cannot answer.
    """
    rows = np.full((len(error), 2), np.nan)
    law = {place: part for place, part in replacements_of(scenario).items() if place is control_law}
    try:
        after = run_parts(answer_errors, law, numbers(error), numbers(speeds), memory, settings, rows)
    except PartError:
        return rows, memory
    return rows, after


def answer_errors(errors: Rows, speeds: Rows, memory: Numbers, settings: Settings, rows: Floats) -> Numbers:
    """Fill in the command of each row, shape (N, 2); returns the law's memory after the last one."""
    for i in range(len(errors)):
        x_e, y_e, theta_e = errors[i]
        if not are_finite(x_e, y_e, theta_e):
            continue
        v_r, w_r = speeds[i]
        v, w, memory = command(
            x_e, y_e, theta_e, v_r, w_r, memory, settings.gains, settings.ts, settings.look_ahead, settings.v_max
        )
        rows[i, 0], rows[i, 1] = v, w
    return memory


def compared_with(topic: str, run: Run, apart: Floats, recorded: Floats) -> Difference:
    """Difference over the steps that have both. Raises UserError if there is none."""
    both = held_poses(run)[1] & np.isfinite(recorded).all(axis=1)
    if not both.any():
        raise UserError(f"{run.source}: nothing to compare, no step has both {topic} and the pose that the edge held")
    return difference(run.k[both], apart[both], recorded[both])
