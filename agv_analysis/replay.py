"""A recording played to the edge's functions again: what would they answer today, and what was lost on the way?

From the recorded poses and slots follow the errors and commands of error detector and controller, as pure functions.
Where they are not the recorded ones, the edge has changed since, or its parameters have.
"""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.convergence import wrapped
from agv_analysis.run import Floats, Run
from agv_analysis.scenario import Scenario, parse_scenario
from agv_analysis.simulation.loop import answer, at_rest, received
from agv_analysis.simulation.single import settings_of
from agv_cloud.reference import Reference
from agv_cloud.staleness import Posture, Prediction
from agv_plant.unicycle import STEPS
from agv_ros.errors import UserError

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
    changed = parse_scenario(scenario.to_yaml(), "parameters of the recording", settings)
    if changed.grid != scenario.grid:
        raise UserError("ts and start_time are those of the recording, they cannot be set")
    return changed


def compare(run: Run, scenario: Scenario) -> Comparison:
    """What the edge of `scenario` makes of the recorded poses and slots, against what is recorded.

    Raises UserError if no step of the recording has both.
    """
    error, command = _answers(run, scenario)
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


def _answers(run: Run, scenario: Scenario) -> tuple[Floats, Floats]:
    """Errors, shape (N, 3), and commands, shape (N, 2); NaN where the recording does not hold the edge's pose."""
    settings, reference = settings_of(scenario), Reference(scenario.error_detector)
    held, there = _held(run)
    rows = np.full((len(run), 5), np.nan)
    predicts = scenario.error_detector.policy == "predict"
    prediction = Prediction(STEPS[scenario.error_detector.integration], run.ts)
    for i in np.flatnonzero(there).tolist():
        k, taken = int(run.k[i]), int(run.k[held[i]])
        pose = Posture(*run.pose[held[i]].tolist())
        if predicts:
            pose = prediction.at(k, taken, pose)
        at_edge = received(at_rest(*pose), *pose, *reference[taken][:3], k - taken)
        rows[i] = answer(at_edge, *reference[k], settings)
        if predicts and np.isfinite(run.command[i]).all():
            prediction.add_command(k, *run.command[i].tolist())
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


def write_outages(path: Path, run: Run, downlink: bool = False) -> int:
    """Write the verdicts of one link to a CSV file for the channel `trace`; returns the number of slots lost.

    Row 0 is the first slot recorded. Raises UserError if slots are missing, or for a path that cannot be written.
    """
    topic, lost = ("agv/slot", run.downlink_lost) if downlink else ("edge/slot", run.lost)
    gaps = int(run.k[-1] - run.k[0]) + 1 - len(run) + run.unexplained.get(topic, 0)
    if gaps:
        raise UserError(f"{run.source}: {gaps} slots of {topic} are missing, so nobody knows whether they were lost")
    try:
        _write(path, lost)
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None
    return int(np.count_nonzero(lost))


def _write(path: Path, lost: NDArray[np.bool_]) -> None:
    with open(path, "w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(("k", "lost"))
        rows.writerows(enumerate(lost.astype(int).tolist()))
