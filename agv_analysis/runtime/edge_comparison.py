"""The edge of today against a recording: which errors and commands follow from its poses and slots, and do they agree?

The functions of error detector and controller are called on what was recorded. Where their results are not the recorded
ones, the edge has changed since, or its parameters have.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.metrics.convergence import wrapped
from agv_analysis.run import Floats, Run
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.loop import EdgeState, edge_step
from agv_analysis.simulation.parts import replacements_of
from agv_analysis.simulation.single import settings_of
from agv_cloud.control.registry import CONTROL_LAWS
from agv_cloud.parameters import PATH
from agv_cloud.reference.point import ReferencePoint
from agv_cloud.reference.reference import Reference
from agv_cloud.staleness.estimate import PoseEstimator
from agv_cloud.staleness.registry import STALENESS_POLICIES
from agv_ros.errors import UserError
from agv_ros.parts import PartError, complaint, culprit
from agv_ros.pose import Pose
from agv_ros.substitution import replaced

TOLERANCE = 1e-9
"""Largest difference that is none, as a share of the recorded value where that is above 1."""


@dataclass(frozen=True)
class Difference:
    """How far one answer of the edge is from the recorded one; a size is the largest over its components."""

    compared: int
    """Number of steps with both."""
    first: int | None
    """First step k that differs by more than TOLERANCE; None: none does."""
    first_size: float
    """Difference at that step [m, rad] or [m/s, rad/s], 0 if none differs; inf: today's answer is no number."""
    largest: float
    largest_at: int
    """Step of the largest difference."""


@dataclass(frozen=True)
class Comparison:
    """Errors and commands that follow from the recorded poses and slots, against those in the recording."""

    steps: int
    error: Difference
    command: Difference

    @property
    def differs(self) -> bool:
        """Has the edge changed?"""
        return self.error.first is not None or self.command.first is not None

    def to_json(self) -> dict[str, Any]:
        """The comparison as plain values; an infinite size is null."""
        plain = {"error": dataclasses.asdict(self.error), "command": dataclasses.asdict(self.command)}
        for part in plain.values():
            part.update({name: None for name, value in part.items() if value == math.inf})
        return {"steps": self.steps, "tolerance": TOLERANCE, "differs": self.differs, **plain}


def with_settings(scenario: Scenario, settings: Iterable[str]) -> Scenario:
    """A recorded scenario with settings `node.parameter=value`.

    Raises ParameterError, or UserError if they change the sampling instants.
    """
    changed = scenario.with_settings(settings, "parameters of the recording")
    if changed.grid != scenario.grid:
        raise UserError("ts and start_time are those of the recording, they cannot be set")
    return changed


def compare(run: Run, scenario: Scenario) -> Comparison:
    """Errors and commands of the edge of `scenario` from the recorded poses and slots, against the recorded ones.

    Raises UserError if no step of the recording has both.
    """
    return compare_answers(run, *_answers(run, scenario))


def compare_answers(run: Run, error: Floats, command: Floats) -> Comparison:
    """Errors, shape (N, 3), and commands, shape (N, 2), of the run's steps against those that are recorded.

    NaN is an answer that did not come. Raises UserError if no step of the recording can be compared.
    """
    errors_apart = error - run.error
    errors_apart[:, 2] = wrapped(errors_apart[:, 2])
    return Comparison(
        steps=len(run),
        error=_difference("edge/error", run, errors_apart, run.error),
        command=_difference("edge/cmd_vel", run, command - run.command, run.command),
    )


def _held(run: Run) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Row of the pose that the edge held at each step, and whether it is in the recording; shapes (N,)."""
    held = np.minimum(np.searchsorted(run.k, run.k - run.n_ul), len(run) - 1)
    return held, run.k[held] == run.k - run.n_ul


def _reference(run: Run, scenario: Scenario) -> Callable[[int], ReferencePoint]:
    """What the edge compares with at each step: the scenario's track, or, along paths, the recorded reference.

    Of a path that is not recorded as far ahead as the edge looked the last point that is.
    """
    ahead = scenario.error_detector.steps_ahead
    if scenario.error_detector.track == PATH:
        recorded = [ReferencePoint(*row) for row in run.reference.tolist()]
        rows = {int(k): i for i, k in enumerate(run.k)}
        return lambda k: recorded[rows.get(k + ahead, rows.get(k, -1) if ahead == 0 else -1)]
    reference = Reference(scenario.error_detector)
    return lambda k: reference[k + ahead]


def _answers(run: Run, scenario: Scenario) -> tuple[Floats, Floats]:
    """Errors, shape (N, 3), and commands, shape (N, 2); NaN where the recording does not hold the edge's pose."""
    settings, reference = settings_of(scenario), _reference(run, scenario)
    held, there = _held(run)
    rows = np.full((len(run), 5), np.nan)
    edge, policy = scenario.error_detector, STALENESS_POLICIES.find(scenario.error_detector.policy)
    estimator = PoseEstimator(policy, settings.policy, edge.policy_values, run.ts, settings.model_arc)
    step, memory = replaced(edge_step, replacements_of(scenario)), CONTROL_LAWS.find(scenario.controller.law).memory
    for i in map(int, np.flatnonzero(there)):
        row = int(held[i])
        k, taken = int(run.k[i]), int(run.k[row])
        try:
            estimate = estimator.at(k, taken, Pose(*run.sent_pose[row].tolist()), reference)
            at_edge = EdgeState(*estimate, k - taken, 0.0, 0.0, memory)
            rows[i], memory = step(at_edge, reference(k), settings)
        except Exception as error:  # another package's part, in which anything can go wrong
            if not culprit(error):
                raise
            raise PartError(f"{culprit(error)} {complaint(error)}, at step {k}") from error
        if estimator.uses_commands and np.isfinite(run.command[i]).all():
            estimator.add_command(k, *run.command[i].tolist())
    return rows[:, :3], rows[:, 3:]


def _difference(topic: str, run: Run, apart: Floats, recorded: Floats) -> Difference:
    both = _held(run)[1] & np.isfinite(recorded).all(axis=1)
    if not both.any():
        raise UserError(f"{run.source}: nothing to compare, no step has both {topic} and the pose that the edge held")
    # An answer that is no number, where the recording has one, differs without bound.
    k, sizes = run.k[both], np.nan_to_num(np.abs(apart[both]), nan=np.inf, posinf=np.inf).max(axis=1)
    wrong = np.flatnonzero(sizes > TOLERANCE * np.maximum(1.0, np.abs(recorded[both]).max(axis=1)))
    largest = int(np.argmax(sizes))
    return Difference(
        compared=len(k),
        first=int(k[wrong[0]]) if len(wrong) else None,
        first_size=float(sizes[wrong[0]]) if len(wrong) else 0.0,
        largest=float(sizes[largest]),
        largest_at=int(k[largest]),
    )
