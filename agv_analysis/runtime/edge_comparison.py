"""The edge of today against a recording: which errors and commands follow from its poses and slots, and do they agree?

The functions of error detector and controller are called on what was recorded. Where their results are not the recorded
ones, the edge has changed since, or its parameters have.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from agv_analysis.run import Floats, Run
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.edge_answers import TOLERANCE, Difference, answers_to_poses, compared_with, errors_apart
from agv_ros.errors import UserError


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
    return compare_answers(run, *answers_to_poses(run, scenario))


def compare_answers(run: Run, error: Floats, command: Floats) -> Comparison:
    """Errors, shape (N, 3), and commands, shape (N, 2), of the run's steps against those that are recorded.

    NaN is an answer that did not come. Raises UserError if no step of the recording can be compared.
    """
    return Comparison(
        steps=len(run),
        error=compared_with("edge/error", run, errors_apart(error, run.error), run.error),
        command=compared_with("edge/cmd_vel", run, command - run.command, run.command),
    )
