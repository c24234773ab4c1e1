"""The nonlinear loop under the very losses of a run, again and again: does it settle, forget where it began, stay near?

The linear criteria say what a small error does about the nominal motion. Here the loop itself is driven, by the
functions that the nodes call, for as many repetitions of the run's track and losses as ten minutes take:

- without losses, from where the run began and from beside it: does it come to its nominal motion?
- with the losses, from there and from the reference: do the AGVs come together?
- with the losses: does the largest deviation grow from one third of the time to the next?

The losses are those of the run, and the same moved against the track by a third of it and by two. Measurement noise and
slip are left out, but where a deviation is to be compared with the recorded one: what a loop forgets does not depend on
them.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import numbers
from agv_analysis.metrics.error_metrics import body_errors, wrapped
from agv_analysis.metrics.outages import ages
from agv_analysis.run import Floats, Run
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.link_loop import LinkInputs, empty_trace, history_over_links, link_that_holds
from agv_analysis.simulation.loop import Loop, RunInputs, history
from agv_analysis.simulation.noise import normals
from agv_analysis.simulation.parts import replacements_of, run_parts
from agv_analysis.simulation.reference import repeated
from agv_analysis.simulation.single import settings_of, start_of
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.scenario_loop import lap_of
from agv_plant.parameters import PlantParameters, RelayParameters
from agv_plant.vehicle.motion import NOISE, SLIP
from agv_ros.pose import Pose, direction_of

SECONDS = 600.0
"""Time [s] that is driven at least, in whole repetitions of the run, three of them at least."""

_MOST_STEPS = 600_000

_LAPS = 3
"""Laps that are driven without losses."""

_SETTLED = 1e-3
"""Up to this distance [m, m, rad] from the nominal motion a loop has settled."""

_NEAR = 0.01
"""So far [m, m, rad] beside the nominal motion an AGV must come back to it."""

_ARRIVED = 1e-6
"""Within this distance [m, m, rad] of the nominal motion there is no need to drive on."""

_MET = 1e-6
"""Up to this distance [m, m, rad] two AGVs have met."""

_APART = 1e-3
"""Under losses an AGV that begins this far [m, m, rad] beside where the run did must come together with it."""

_BESIDE = (-0.5, -0.2, -0.1, -0.01, -_APART, _APART, 0.01, 0.1, 0.2, 0.5)
"""So far [m, m, rad] beside it a loop must settle without losses as well: one that swings may settle by chance."""

_SHRINKING = 0.7
"""A distance that is below this share of what it was a quarter of the time before, on average, goes on shrinking."""

_TURNS = 3.0 * math.pi
"""Of two AGVs that meet one may have turned around once more [rad]; if more often, chance decided."""

_NOT_FAR = 1.0
"""Beyond this distance [m, m, rad] a loop may wander, and come nearer for a while."""

_GROWING = 1.4
"""A largest deviation above this multiple of that of the third before is growing: a steady drift has 1.5."""


@dataclass(frozen=True)
class RepeatedRun:
    """What the loop does in the repetitions of a run."""

    seconds: float
    """Time that was driven [s]."""
    settles: bool
    """Without losses: does the loop come from where the run began to its nominal motion?"""
    meets: bool
    """With the losses: do an AGV that begins where the run did and one on the reference come together?"""
    stays: bool
    """With the losses: is the largest deviation no larger in the last third of the time than in the one before, of the
    run and of those AGVs that do not come together with it?"""
    largest_deviation: float
    """Largest distance from the reference in the last third [m], of the same runs and of one that does not settle
    without any losses; inf if the loop diverges."""
    largest_in_run: float
    """Largest distance from the reference in the second half of the run, simulated with its noise and slip [m]."""
    unsettled: str = ""
    """Where it does not settle: what does not do what; empty if it settles."""

    @property
    def is_stable(self) -> bool:
        """Do all three hold?"""
        return self.settles and self.meets and self.stays


def repeated_run(run: Run, loop: LinearLoop) -> RepeatedRun | None:
    """Drive the repetitions of a run, with its linear loop over its steps.

    None where steps are missing from the run, so that it cannot be repeated. Raises PartError if a part raises.
    """
    if int(run.k[-1] - run.k[0]) + 1 != len(run):
        return None
    steps = len(run)
    count = min(max(3, math.ceil(SECONDS / (steps * run.ts))), max(3, _MOST_STEPS // steps))
    reference = _repeated_reference(run.scenario, run.reference, count)
    starts, columns = _starts(run.scenario, run.pose[0], run.reference[0]), _moved_by_commands(loop)
    unsettled = _unsettled(run, reference, count, loop)
    meets, thirds, in_run = True, [], np.zeros(0)
    for shift in _shifts(run):
        begun = _under_losses(run, reference, starts[0], count, shift)
        deviation = _deviation(begun, reference)
        thirds.append(_largest_of_thirds(deviation, steps))
        for start in starts[1:]:
            other = _under_losses(run, reference, start, count, shift)
            if not _meets(
                begun, other, columns
            ):  # then that one may drift away, and this one not by chance of symmetry
                meets = False
                thirds.append(_largest_of_thirds(_deviation(other, reference), steps))
        if shift == 0:
            in_run = deviation[:steps]
    if is_disturbed(run.scenario.plant):
        once = reference[: steps + run.scenario.controller.steps_ahead]
        in_run = _deviation(_under_losses(run, once, starts[0], 1, 0, with_noise=True), reference)
    if unsettled is not None:
        thirds.append(_largest_of_thirds(_deviation(unsettled[1], reference), steps))
    return RepeatedRun(
        seconds=count * steps * run.ts,
        settles=unsettled is None,
        meets=meets,
        stays=all(_does_not_grow(before, last) for before, last in thirds),
        largest_deviation=max(last for _, last in thirds),
        largest_in_run=float(in_run[steps // 2 :].max()),
        unsettled="" if unsettled is None else unsettled[0],
    )


def is_disturbed(plant: PlantParameters) -> bool:
    """Do measurement noise or slip keep an AGV moving?"""
    return plant.is_noisy or plant.slip_noise > 0.0


def _unsettled(run: Run, reference: Floats, count: int, loop: LinearLoop) -> tuple[str, Floats] | None:
    """What of the loop without losses does not settle, and the poses of an AGV that does not; None if all of it does.

    From where the run began it must come to the nominal motion, and from beside that motion come back to it; from
    further away it may come to another steady motion. One that has come very near in a quarter of the time is not
    driven any further: from beside it a loop does not come so near to a motion that it leaves again.
    """
    quarter, steps = max(1, count // 4) * len(run), count * len(run)
    begun, nominal = run.pose[0, :3], _pose_of_nominal(reference[run.scenario.controller.steps_ahead], loop)
    starts = [(begun, True, "the loop does not settle on its nominal motion")]
    for offset in (-_NEAR, _NEAR):
        starts.append(
            (nominal + offset, True, f"an AGV that begins {_NEAR:g} m and rad beside the nominal motion stays off it")
        )
    for offset in _BESIDE:
        starts.append(
            (begun + offset, False, f"an AGV that begins {abs(offset):g} m and rad beside this one does not settle")
        )
    for i, (at, must_return, what) in enumerate(starts):
        start = _start(run.scenario, at)
        if i > 0:
            poses = _without_losses(run.scenario, reference, start, quarter)
            last = np.arange(quarter * 19 // 20, quarter)
            if np.isfinite(poses).all() and _distances(poses, reference, run.scenario, loop, last).max() <= _ARRIVED:
                continue
        poses = _without_losses(run.scenario, reference, start, steps)
        if not _settles(poses, reference, run.scenario, loop, may_be_elsewhere=not must_return):
            return what, poses
    return None


def _pose_of_nominal(reference: Floats, loop: LinearLoop) -> Floats:
    """The pose of an AGV on the nominal motion at the first step, X_r(0) and its speeds of shape (5,)."""
    x, y, theta = reference[:3]
    x_e, y_e, theta_e = (0.0, 0.0, 0.0) if loop.nominal is None else loop.nominal[0, :3]
    heading = theta - theta_e
    c, s = math.cos(heading), math.sin(heading)
    return np.array([x - c * x_e + s * y_e, y - s * x_e - c * y_e, heading])


def settles_without_losses(scenario: Scenario) -> bool:
    """Does the loop, driven without losses, forget where it began and stay as near as it came?

    By simulation alone, in milliseconds: three laps, and ten minutes where these do not show it;
    `error_dynamics.nominal_motion` says where it settles, and why it does not.
    Raises TrackFileError if the track's file cannot be used, PartError if a part raises.
    """
    relay = replace(RelayParameters(), ts=scenario.relay.ts, start_time=scenario.relay.start_time)
    return _settles_without_losses(replace(scenario, relay=relay))  # the same whatever the links are


@functools.lru_cache(maxsize=1024)
def _settles_without_losses(scenario: Scenario) -> bool:
    lap = lap_of(scenario)
    longer = math.ceil(SECONDS / (len(lap) * scenario.plant.ts))
    return any(_settles_in(scenario, lap, laps) for laps in (_LAPS, longer) if laps >= _LAPS)


def _settles_in(scenario: Scenario, lap: Floats, laps: int) -> bool:
    reference = _repeated_reference(scenario, lap, laps)
    starts = _starts(scenario, np.array(scenario.plant.initial_pose), lap[0])
    one, two = (_without_losses(scenario, reference, start, laps * len(lap)) for start in (starts[0], starts[-1]))
    moves = bool(lap[:, 3:].any())
    return _does_not_grow(*_largest_of_thirds(_deviation(one, reference), len(lap))) and (
        not moves or _meets(one, two, np.arange(3))
    )


def _repeated_reference(scenario: Scenario, rows: Floats, count: int) -> Floats:
    """X_r(k) and its speeds over the repetitions, and as far beyond as the edge looks ahead, shape (N, 5)."""
    return repeated(rows, count * len(rows) + scenario.controller.steps_ahead, scenario.plant.ts)


def _shifts(run: Run) -> tuple[int, ...]:
    """By how many slots the losses are moved against the track: what a place of it loses is not moved away from it."""
    relay = run.scenario.relay
    is_placed = relay.uplink.is_placed or relay.downlink.is_placed or not run.seed_known
    nothing = not (run.lost.any() or run.downlink_lost.any())
    return (0,) if is_placed or nothing or _is_late(run) else (0, len(run) // 3, 2 * len(run) // 3)


def _starts(scenario: Scenario, pose: Floats, reference: Floats) -> list[Loop]:
    """The loop before the first step, its AGV at a pose, beside it, and at the reference if that is elsewhere."""
    found = [_start(scenario, at) for at in (pose, pose[:3] + _APART, reference)]
    return found[:2] if _distance(found[0], found[2]) < _APART else found


def _start(scenario: Scenario, at: Floats) -> Loop:
    x, y, theta = at[:3].tolist()
    start, pose = start_of(scenario), Pose(x, y, theta)
    return start._replace(
        motion=start.motion._replace(x=x, y=y, theta=theta),
        edge=start.edge._replace(held=pose, direction=direction_of(theta), target=pose),
    )


def _distance(one: Loop, other: Loop) -> float:
    return max(abs(a - b) for a, b in zip(one.motion[:3], other.motion[:3], strict=True))


def _without_losses(scenario: Scenario, reference: Floats, start: Loop, steps: int) -> Floats:
    """Poses of the AGV, shape (N, 3); NaN after the loop has diverged."""
    nothing = numbers(np.zeros(steps, dtype=np.bool_))
    return _direct(scenario, reference, RunInputs(nothing, nothing, start, settings_of(scenario)))


def _under_losses(run: Run, reference: Floats, start: Loop, count: int, shift: int, with_noise: bool = False) -> Floats:
    """As `_without_losses`, under the losses, moved by so many slots, and the delays of a run."""
    lost, downlink_lost = (
        np.resize(np.roll(outcomes, shift), count * len(run)) for outcomes in (run.lost, run.downlink_lost)
    )
    plant = run.scenario.plant
    noise = numbers(normals(plant.seed, NOISE, len(lost))) if with_noise and plant.is_noisy else None
    slip = numbers(normals(plant.seed, SLIP, len(lost))) if with_noise and plant.slip_noise > 0.0 else None
    inputs = RunInputs(numbers(lost), numbers(downlink_lost), start, settings_of(run.scenario), noise, slip)
    if not _is_late(run):
        return _direct(run.scenario, reference, inputs)
    up, down = (_link(age, count) for age in (run.command_age, _downlink_ages(run)))
    traces, rows = (empty_trace(len(lost)), empty_trace(len(lost))), np.full((len(lost), 8), math.nan)
    parts = replacements_of(run.scenario)
    run_parts(history_over_links, parts, numbers(reference), inputs, up, down, *traces, rows)
    return np.array(rows[:, :3])


def _direct(scenario: Scenario, reference: Floats, inputs: RunInputs) -> Floats:
    rows, n_ul = np.full((len(inputs.lost), 8), math.nan), np.empty(len(inputs.lost), dtype=np.int64)
    run_parts(history, replacements_of(scenario), numbers(reference), inputs, rows, n_ul)
    return np.array(rows[:, :3])  # not to keep the rest


def _largest_of_thirds(deviation: Floats, steps: int) -> tuple[float, float]:
    """The largest deviation of the second and of the last third of all repetitions, in whole ones."""
    third = len(deviation) // steps // 3 * steps
    return float(deviation[-2 * third : -third].max()), float(deviation[-third:].max())


def _does_not_grow(before: float, last: float) -> bool:
    return math.isfinite(last) and last <= max(_GROWING * before, before + _SETTLED)


def _is_late(run: Run) -> bool:
    """Is what the receivers hold older than the outcomes of the slots say?"""
    since = np.arange(len(run))
    pairs = (run.command_age, run.lost), (_downlink_ages(run), run.downlink_lost)
    return any(not np.array_equal(np.minimum(age, since), ages(run.k, lost)) for age, lost in pairs)


def _downlink_ages(run: Run) -> NDArray[np.int64]:
    return ages(run.k, run.downlink_lost) if run.n_dl is None else run.n_dl


def _link(age: NDArray[np.int64], count: int) -> LinkInputs:
    """A link under which the receiver holds, at each step of each repetition, a message of the age given, shape (N,).

    At the beginning of a repetition nothing older than it is held.
    """
    steps = len(age)
    within = np.arange(steps) - np.minimum(age, np.arange(steps))
    return link_that_holds(np.maximum.accumulate(np.concatenate([within + i * steps for i in range(count)])))


def _deviation(poses: Floats, reference: Floats) -> Floats:
    """Distance from the reference [m], shape (N,); inf where the loop has diverged."""
    with np.errstate(over="ignore", invalid="ignore"):
        apart = np.hypot(*(poses[:, :2] - reference[: len(poses), :2]).T)
    return np.where(np.isfinite(apart), apart, math.inf)


def _moments(steps: int) -> list[NDArray[np.int64]]:
    """Rows of a twentieth of all: after a quarter, half, three quarters, and at the end."""
    return [np.arange(steps * (part - 1) // 20, steps * part // 20) for part in (5, 10, 15, 20)]


def _is_small_or_shrinks(distances: Sequence[Floats], small: float) -> bool:
    """Is a distance small at the last two of the `_moments`, or does it shrink from each of them to the next?

    One that is no longer far may shrink little from one moment to the next if it does so from each to the next but one:
    after an odd number of half laps the same loop may be nearer than after whole ones.
    """
    a, b, c, d = (float(np.median(distance)) for distance in distances)
    shrinks = b < _SHRINKING * a and c < _SHRINKING * b and d < _SHRINKING * c
    by_two = c < _SHRINKING**2 * a and d < _SHRINKING**2 * b and a <= _NOT_FAR and d < c < b < a
    return math.isfinite(d) and (max(c, d) <= small or shrinks or by_two)


def _settles(poses: Floats, reference: Floats, scenario: Scenario, loop: LinearLoop, may_be_elsewhere: bool) -> bool:
    """Does a loop settle on its nominal motion, or, if it may, on another one that repeats itself over a lap?"""
    if not np.isfinite(poses).all():
        return False
    distances = [_distances(poses, reference, scenario, loop, rows) for rows in _moments(len(poses))]
    if _is_small_or_shrinks(distances, _SETTLED):
        return True
    ahead = scenario.controller.steps_ahead
    return may_be_elsewhere and _repeats(poses, reference[ahead : ahead + len(poses)], loop)


def _distances(
    poses: Floats, reference: Floats, scenario: Scenario, loop: LinearLoop, rows: NDArray[np.int64]
) -> Floats:
    """Distance of the tracking error from that of the nominal motion [m, m, rad], at some steps, shape (n,)."""
    error = body_errors(reference[rows + scenario.controller.steps_ahead], poses[rows])
    if loop.nominal is not None:
        error = error - loop.nominal[rows % len(loop.nominal), :3]
    error[:, 2] = wrapped(error[:, 2])
    return np.asarray(np.abs(error[:, _moved_by_commands(loop)]).max(axis=1))


def _repeats(poses: Floats, compared: Floats, loop: LinearLoop) -> bool:
    """Are the errors of the last lap those of the lap before, where the loop is constant those of the step before?"""
    lag = 1 if loop.is_constant else loop.steps
    errors = body_errors(compared[-loop.steps - lag :], poses[-loop.steps - lag :])
    change = errors[lag:] - errors[:-lag]
    change[:, 2] = wrapped(change[:, 2])
    return float(np.abs(change).max()) <= _SETTLED * (1.0 if lag > 1 else 1e-3)


def _meets(one: Floats, other: Floats, columns: NDArray[np.int64]) -> bool:
    if not (np.isfinite(one).all() and np.isfinite(other).all()):
        return False
    if len(columns) < one.shape[1]:
        return True
    apart = one - other
    if abs(float(apart[-1, 2])) > _TURNS:
        return False
    apart[:, 2] = wrapped(apart[:, 2])
    return _is_small_or_shrinks([np.abs(apart[rows]).max(axis=1) for rows in _moments(len(apart))], _MET)


def _moved_by_commands(loop: LinearLoop) -> NDArray[np.int64]:
    """Which of x_e, y_e, theta_e the commands reach: a parked AGV keeps its error across forever."""
    return np.arange(min(3, loop.size))
