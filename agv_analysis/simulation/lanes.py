"""Runs side by side, so that the compiler makes vector instructions of the loop over them.

Theory of operation. The slots of up to LANES runs are computed in turn, all of them before the next slot; the functions
are those of `loop`, compiled for lanes (`compiled.compiled_over_lanes`): without a library's sine, whose call could not
be vectorised, and with whole numbers and truth values of the settings as constants, so that no branch is left that all
lanes would have to take. Each run is a column of rows (`lane_rows`). The numbers of a run do not depend on the lanes
beside it; they are those of `loop.statistics` up to rounding.

A lane never ends early. A run that does is found by its mark afterwards, and has to be driven again alone, as one whose
AGV turns by more radians than the sine of lanes knows.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from agv_analysis.compiled.functions import compiled_over_lanes
from agv_analysis.compiled.lane_rows import LANES, rows_needed, rows_of, tuples_in
from agv_analysis.metrics.bands import FORGOTTEN_STEPS
from agv_analysis.metrics.order_statistics import P99, not_exceeded_in_columns
from agv_analysis.run import Floats
from agv_analysis.simulation.decay import (
    NOT_SETTLED,
    Decay,
    DecayAccumulator,
    begin_decay,
    end_decay,
    is_at_twin,
    update_decay,
)
from agv_analysis.simulation.loop import (
    Loop,
    MetricsAccumulator,
    Rows,
    RunInputs,
    RunMetrics,
    Settings,
    are_finite,
    begin,
    compared_reference,
    end,
    pose_distance,
    reference_at,
    slot,
    update_metrics,
)
from agv_plant.vehicle.motion import Motion

_BLOCK = 1024
"""Steps whose poses are kept: those after which runs and twins are compared."""

_STRETCH = 4096
"""Steps after which it is looked whether any lane still goes on."""

VECTOR = 8
"""Lanes are driven in multiples of this, the numbers in a vector of AVX-512: a part of one would be computed alone."""

_LARGEST_HEADING = 1e5
"""Of a reference [rad]."""

_OF_THREAD = threading.local()
"""Memory that each thread keeps: to get it anew from the system takes as long as to use it."""

UPLINK, DOWNLINK = 1, 2
"""Which link lost the message of a slot, as bits."""

_WITHOUT: Decay | None = Decay(NOT_SETTLED, NOT_SETTLED, math.nan)

_POSE = (0.0, 0.0, 0.0)

# Choices that all lanes share, constants of `drive`; here those of the paper.
ARC, POLICY, IS_STEPWISE, MODEL_ARC, DOWNLINK_POLICY, AHEAD = False, 0, False, False, 0, None


Choices = tuple[tuple[str, Any], ...]


class LaneState(NamedTuple):
    """A column of rows."""

    run: MetricsAccumulator
    is_whole: bool
    """Has each slot been what a lane can be?"""
    settings: Settings


class LaneResult(NamedTuple):
    """What is known of a run, as of `batch.Result`."""

    metrics: RunMetrics
    decay: Decay
    p99: float
    contraction: float


def load_lane(rows: Floats, first: int, lane: int, like: Any) -> Any:
    """As `lane_memory.load_lane`, which stands in its place where it is compiled."""
    return tuples_in(rows[first:], like)[lane]


def store_lane(rows: Floats, first: int, lane: int, value: Any, zero: int) -> None:
    """As `lane_memory.store_lane`, which stands in its place where it is compiled."""
    column = rows_of([value])[:, 0]
    rows[first : first + len(column), lane] = column


# -- compiled ----------------------------------------------------------------------------------------------------------


def drive(
    reference: Rows, first: int, stop: int, lanes: int, outcomes: Any, like: LaneState, rows: Any, squares: Any,
    poses: Any, zero: int,
) -> None:  # fmt: skip
    """The slots first .. stop - 1 of `lanes` runs, with what was lost in `outcomes`, see `outcomes_of`.

    Writes their squared distances from the reference [m^2] into `squares`, (N, LANES), and the poses before the slots
    into `poses`, (3 * _BLOCK, LANES), that of slot k into the three rows from 3 (k modulo _BLOCK) on.
    """
    for k in range(first, stop):
        now = reference_at(reference, k)
        compared = compared_reference(now, reference, k, AHEAD)
        for lane in range(lanes):
            run, is_whole, s = load_lane(rows, 0, lane, like)
            settings = Settings(
                s.gains, s.v_max, s.ts, s.look_ahead, None, ARC, POLICY, s.policy_parameters, IS_STEPWISE, MODEL_ARC,
                DOWNLINK_POLICY, s.policy_steps, None, None, s.noise_xy, s.noise_theta,
            )  # fmt: skip
            lost: Any = ((outcomes[k, lane] & UPLINK) != 0,)  # which slot 0 of these takes
            downlink_lost: Any = ((outcomes[k, lane] & DOWNLINK) != 0,)
            loop, sent = slot(run.loop, compared, RunInputs(lost, downlink_lost, run.loop, settings, None, None, 0), 0)
            after = update_metrics(run, k, now, loop, sent, 0)
            goes_on = is_whole and after.goes_on and are_finite(sent.v, sent.w, 0.0)
            motion = run.loop.motion
            store_lane(rows, 0, lane, (after, goes_on), zero)
            store_lane(poses, 3 * (k % _BLOCK), lane, (motion.x, motion.y, motion.theta), zero)
            squares[k, lane] = after.square


def compare(
    first: int, stop: int, lanes: int, poses: Any, poses_of_twin: Any, like: DecayAccumulator, rows: Any, zero: int
) -> None:
    """What is seen of the initial errors at the steps first .. stop - 1, until they are forgotten; poses as `drive`."""
    for k in range(first, stop):
        row = 3 * (k % _BLOCK)
        for lane in range(lanes):
            seen = load_lane(rows, 0, lane, like)
            run, twin = load_lane(poses, row, lane, _POSE), load_lane(poses_of_twin, row, lane, _POSE)
            if seen.near < FORGOTTEN_STEPS:
                seen = update_decay(seen, k, Motion(*run), Motion(*twin))
            store_lane(rows, 0, lane, seen, zero)


# -- from Python -------------------------------------------------------------------------------------------------------


def choices_of(settings: Settings) -> Choices | None:
    """What all runs in lanes must have in common, by the names of `drive`; None for a loop that cannot be in a lane."""
    s = settings
    if s.vehicle is not None or s.plan_arc is not None:
        return None
    return (
        ("ARC", s.arc), ("POLICY", s.policy), ("IS_STEPWISE", s.is_stepwise),
        ("MODEL_ARC", s.is_stepwise and s.model_arc), ("DOWNLINK_POLICY", s.downlink_policy), ("AHEAD", s.ahead),
    )  # fmt: skip


def fits_lanes(reference: Floats) -> bool:
    """Is each heading of a reference one of which the sine of lanes can be taken?"""
    return bool(np.abs(reference[:, 2]).max() <= _LARGEST_HEADING)


def statistics_over_lanes(
    reference: Floats, inputs: Sequence[RunInputs], on_reference: Sequence[Loop], twins: Sequence[Loop]
) -> list[LaneResult | None]:
    """At most LANES runs of as many steps and with the same choices; None for each that has to be driven alone.

    `on_reference` are the loops that begin on the reference, `twins` those a little beside each run, if wanted.
    """
    group = Group(reference, inputs)
    apart: Sequence[Motion | None] = [None] * len(inputs)
    if twins:
        rows = group.rows(twins)
        group.drive(rows, 0, group.steps)
        apart = [state.run.loop.motion if state.is_whole else None for state in group.states(rows)]
    rows, decays = group.rows([one.start for one in inputs]), [_WITHOUT] * len(inputs)
    done = _forget(group, rows, on_reference, decays)
    settled = [0 if one is None else max(0, one.settle_1cm_steps) for one in decays]
    group.settle(rows, settled, done)
    group.drive(rows, done, group.steps)
    with np.errstate(invalid="ignore"):  # of runs that are not whole
        p99 = not_exceeded_in_columns(group.squares, settled + [0] * (LANES - len(settled)), P99)
    found: list[LaneResult | None] = [None] * len(inputs)
    for lane, (state, one, of_start, twin) in enumerate(zip(group.states(rows), inputs, decays, apart, strict=True)):
        if state.is_whole and of_start is not None and (twin is not None or not twins):
            metrics = end(state.run, one._replace(settled=settled[lane]))
            contraction = math.nan
            if twin is not None:
                begun = pose_distance(one.start.motion, twins[lane].motion)
                contraction = pose_distance(state.run.loop.motion, twin) / begun
            is_finite = metrics.deviation_max < math.inf
            found[lane] = LaneResult(metrics, of_start, math.sqrt(p99[lane]) if is_finite else math.inf, contraction)
    return found


class Group:
    """Runs that are driven side by side."""

    def __init__(self, reference: Floats, inputs: Sequence[RunInputs]) -> None:
        self._reference, self.inputs, self.steps = reference, inputs, len(inputs[0].lost)
        self.lanes = -(-len(inputs) // VECTOR) * VECTOR
        self._outcomes = outcomes_of(inputs)
        self._like = LaneState(begin(inputs[0]), True, inputs[0].settings)
        self._mark = rows_needed(self._like.run)
        choices = choices_of(inputs[0].settings)
        assert choices is not None
        self._drive = compiled_over_lanes(drive, choices)
        self.squares = _scratch(self.steps)
        self.poses, self.poses_of_twin = np.empty((2, 3 * _BLOCK, LANES))

    def rows(self, starts: Sequence[Loop]) -> Floats:
        """The runs before slot 0, begun at these loops."""
        return rows_of([
            LaneState(begin(one._replace(start=start)), True, one.settings)
            for one, start in zip(self.inputs, starts, strict=True)
        ])  # fmt: skip

    def states(self, rows: Floats) -> list[LaneState]:
        """Those of the runs."""
        return tuples_in(rows, self._like)[: len(self.inputs)]

    def are_whole(self, rows: Floats) -> list[bool]:
        """The marks of the runs."""
        return [bool(mark) for mark in rows.view(np.int64)[self._mark, : len(self.inputs)]]

    def settle(self, rows: Floats, settled: Sequence[int], done: int) -> None:
        """Of the first `done` steps those from `settled` on count as settled, as they will from now on.

        Summed one after the other, as what is added by and by: so the sum does not depend on when this is done.
        """
        states = self.states(rows)
        for lane, (state, first) in enumerate(zip(states, settled, strict=True)):
            squares = self.squares[first:done, lane]
            total = float(np.cumsum(squares)[-1]) if len(squares) else 0.0
            run = state.run._replace(farthest_settled=float(squares.max(initial=0.0)), square_sum=total)
            states[lane] = state._replace(run=run)
        rows[:] = rows_of(states)

    def drive(self, rows: Floats, first: int, stop: int, poses: Floats | None = None) -> None:
        """The slots first .. stop - 1, or fewer if none of the runs goes on."""
        into = self.poses if poses is None else poses
        for begun in range(first, stop, _STRETCH):
            self._drive(
                self._reference, begun, min(begun + _STRETCH, stop), self.lanes, self._outcomes, self._like, rows,
                self.squares, into, 0,
            )  # fmt: skip
            if not any(self.are_whole(rows)):
                return


def _scratch(steps: int) -> Floats:
    """Squared distances of a group's runs, shape (N, LANES): the same memory for each group, in each thread its own."""
    if getattr(_OF_THREAD, "steps", None) != steps:
        _OF_THREAD.steps, _OF_THREAD.squares = steps, np.zeros((steps, LANES))
    found: Floats = _OF_THREAD.squares
    return found


def _forget(group: Group, rows: Floats, on_reference: Sequence[Loop], decays: list[Decay | None]) -> int:
    """Drive runs until their initial errors are forgotten; returns the steps taken.

    Writes what becomes of the errors into `decays`, None where the twin on the reference ends before.
    """
    starts = [one.start.motion for one in group.inputs]
    seen = [begin_decay(one, twin.motion) for one, twin in zip(starts, on_reference, strict=True)]
    without = [is_at_twin(one, twin.motion) for one, twin in zip(starts, on_reference, strict=True)]
    if all(without):
        return 0
    of_errors = rows_of([
        one._replace(near=FORGOTTEN_STEPS if is_without else 0) for one, is_without in zip(seen, without, strict=True)
    ])  # fmt: skip
    done, twins, compared = 0, group.rows(on_reference), compiled_over_lanes(compare, ())
    while done < group.steps and not (of_errors.view(np.int64)[-1] >= FORGOTTEN_STEPS).all():
        begun, done = done, min(done + _BLOCK, group.steps)
        group.drive(twins, begun, done, group.poses_of_twin)
        group.drive(rows, begun, done)
        compared(begun, done, group.lanes, group.poses, group.poses_of_twin, seen[0], of_errors, 0)
    for lane, (one, is_whole) in enumerate(
        zip(tuples_in(of_errors, seen[0])[: len(starts)], group.are_whole(twins), strict=True)
    ):
        if not without[lane]:
            decays[lane] = end_decay(one, group.steps, True) if is_whole else None
    return done


def outcomes_of(inputs: Sequence[RunInputs]) -> Any:
    """What runs of N slots lose, shape (N, LANES), UPLINK or DOWNLINK or both; of the last one in lanes left over."""
    found = np.empty((len(inputs[0].lost), LANES), dtype=np.uint8)
    links = [(one.lost, one.downlink_lost) for one in inputs]
    of_last = None
    for lane, (lost, downlink_lost) in enumerate(links + links[-1:] * (LANES - len(links))):
        if (id(lost), id(downlink_lost)) != of_last:
            of_last, column = (id(lost), id(downlink_lost)), UPLINK * lost + DOWNLINK * downlink_lost
        found[:, lane] = column
    return found
