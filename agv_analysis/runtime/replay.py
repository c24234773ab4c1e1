"""A recording played to the edge's functions again: what would they answer today, and what was lost on the way?

From the recorded poses and slots follow the errors and commands of error detector and controller, as pure functions.
Where they are not the recorded ones, the edge has changed since, or its parameters have.
"""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags import read_bag
from agv_analysis.metrics.convergence import wrapped
from agv_analysis.recordings.recording import TOPICS, loop_topics
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
from agv_ros.codec import decode_slot, stamp_of
from agv_ros.errors import UserError
from agv_ros.messages import Command, InvalidMessageError, TrackingError
from agv_ros.pose import Pose
from agv_ros.stamps import Grid, OffGridError
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
    """What the edge of `scenario` makes of the recorded poses and slots, against what is recorded.

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
    answer, memory = replaced(edge_step, replacements_of(scenario)), CONTROL_LAWS.find(scenario.controller.law).memory
    for i in map(int, np.flatnonzero(there)):
        row = int(held[i])
        k, taken = int(run.k[i]), int(run.k[row])
        estimate = estimator.at(k, taken, Pose(*run.sent_pose[row].tolist()), reference)
        at_edge = EdgeState(*estimate, k - taken, 0.0, 0.0, memory)
        rows[i], memory = answer(at_edge, reference(k), settings)
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


def write_outages(path: Path, run: Run, downlink: bool = False) -> int:
    """Write the outcomes of one link to a CSV file for the channel `trace`; returns the number of slots lost.

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


def with_outages_of(run: Run, scenario: Scenario, folder: Path) -> Scenario:
    """`scenario` in lockstep, for as long as the run and with the outcomes of both its links, in files in `folder`.

    Raises UserError if the recording does not begin with step 0 or slots are missing.
    """
    if run.k[0] != 0:
        raise UserError(f"{run.source}: begins with step {run.k[0]}, so its outages do not fit a run from step 0 on")
    plant = dataclasses.replace(scenario.plant, duration=len(run) * run.ts, clock="lockstep")
    uplink, downlink = (folder / f"{link}.csv" for link in ("uplink", "downlink"))
    write_outages(uplink, run)
    write_outages(downlink, run, downlink=True)
    relay = dataclasses.replace(
        scenario.relay,
        uplink=dataclasses.replace(scenario.relay.uplink, model="trace", trace_file=str(uplink)),
        downlink=dataclasses.replace(scenario.relay.downlink, model="trace", trace_file=str(downlink)),
    )
    return dataclasses.replace(scenario, plant=plant, relay=relay)


# -- what came to the edge --------------------------------------------------------------------------------------------

BEYOND = tuple(topic for topic in TOPICS if topic.startswith("agv/"))
"""The loop's topics on the AGV's side of the radio."""


class Input(NamedTuple):
    """What the edge got in one slot, as it came over the wire."""

    k: int
    stamp_ns: int
    slot: bytes
    pose: bytes | None
    """The fresher pose that came in this slot, None if none did."""
    is_answered: bool
    """Does an edge that knows this recording alone hold the pose that the slot names?"""
    beyond: tuple[tuple[str, bytes], ...] = ()
    """What the recording holds of the step on the AGV's side of the radio, by topic."""


class EdgeInputs(NamedTuple):
    """All that came to the edge, by increasing step."""

    source: str
    """The recording."""
    namespace: str
    slots: tuple[Input, ...]


def read_inputs(path: Path, grid: Grid, namespace: str | None = None) -> EdgeInputs:
    """Recorded slots and forwarded poses of one loop; of a step that is repeated, the first of each.

    Raises UserError if the bag cannot be read or holds none.
    """
    bag = read_bag(path, topics=())
    names = loop_topics(bag, path, namespace)
    if "edge/pose" not in names:
        raise UserError(f"{path}: has no topic edge/pose, so nobody knows what came to the edge: record it, too")
    poses, slots = (_by_step(bag.payloads(names[topic]), grid) for topic in ("edge/pose", "edge/slot"))
    if not slots:
        raise UserError(f"{path}: no slot of {names['edge/slot']} is one of the parameters' sampling instants")
    beyond = {topic: _by_step(bag.payloads(names[topic]), grid) for topic in BEYOND if topic in names}
    inputs = tuple(
        slot._replace(beyond=tuple((topic, data[slot.k]) for topic, data in beyond.items() if slot.k in data))
        for slot in inputs_of(slots, poses, grid)
    )
    return EdgeInputs(str(path), names["edge/slot"].removesuffix("edge/slot").strip("/"), inputs)


def _by_step(payloads: Iterable[bytes], grid: Grid) -> dict[int, bytes]:
    found: dict[int, bytes] = {}
    for data in payloads:
        try:
            found.setdefault(grid.step(stamp_of(data)), data)
        except (InvalidMessageError, OffGridError):  # the reader of the run has said so
            continue
    return dict(sorted(found.items()))


def inputs_of(slots: Mapping[int, bytes], poses: Mapping[int, bytes], grid: Grid) -> Iterator[Input]:
    """What the edge gets in each slot, from slots and forwarded poses by increasing step; damaged slots are dropped.

    A pose comes in the first slot that names it as the freshest: a late one in the slot of its arrival.
    """
    sent: set[int] = set()
    stamps = {grid.stamp(k): k for k in poses}
    for k, data in slots.items():
        try:
            slot = decode_slot(data)
        except InvalidMessageError:
            continue
        freshest, pose = slot.freshest_ns, None
        if freshest not in sent and freshest in stamps:
            pose = poses[stamps[freshest]]
            sent.add(freshest)
        yield Input(k, slot.stamp_ns, data, pose, freshest in sent)


def on_steps(
    run: Run, inputs: EdgeInputs, errors: Mapping[int, TrackingError], commands: Mapping[int, Command]
) -> tuple[Run, Floats, Floats]:
    """The run, without answers that could not be had again, and the edge's new answers for `compare_answers`."""
    answerable = np.isin(run.k, [slot.k for slot in inputs.slots if slot.is_answered])[:, None]
    error, command = np.full((len(run), 3), np.nan), np.full((len(run), 2), np.nan)
    for row, k in enumerate(run.k.tolist()):
        if k in errors:
            error[row] = errors[k].x_e, errors[k].y_e, errors[k].theta_e
        if k in commands:
            command[row] = commands[k].v, commands[k].w
    recorded = dataclasses.replace(
        run, error=np.where(answerable, run.error, np.nan), command=np.where(answerable, run.command, np.nan)
    )
    return recorded, error, command
