"""What becomes of a run's initial error, apart from what outages do: the run beside a twin that began on the reference.

The twin meets the same losses, ages, noise and slip. What outages, noise or a wrong drive do to an AGV they do to both,
so that their difference is the initial error, as far as it is still there. All functions run as plain Python and
compiled, as those of `loop`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.metrics.bands import FORGOTTEN_STEPS, NEGLIGIBLE, SHARE, TOLERANCE, forgotten_below
from agv_analysis.simulation.link_loop import nothing_past, send_pose, slot_over_links
from agv_analysis.simulation.loop import (
    Loop,
    Rows,
    RunInputs,
    compared_reference,
    goes_on,
    reference_at,
    slot,
)
from agv_cloud.tracking_error import tracking_error
from agv_plant.vehicle.motion import Motion

Held = NDArray[np.int64] | list[int]

NOT_SETTLED = -1
"""In place of a number of steps: it did not happen before the run ended, or there was nothing that could settle."""


class Decay(NamedTuple):
    """How the initial error of a run dies out, as `metrics.initial_error` defines it; steps from the first one."""

    settle_1cm_steps: int
    """NOT_SETTLED if there is no such step."""
    settle_2pct_steps: int
    """The same."""
    overshoot: float
    """NaN if the run did not begin beside its reference."""


class DecayAccumulator(NamedTuple):
    """What has been seen of an initial error so far."""

    initial: float
    """Distance [m] of run and twin at the beginning."""
    along_side: float
    """On which side of the twin the run began, 1 or -1; 0 where that is less than 2 % of the distance."""
    across_side: float
    outside_1cm: int
    """Last step outside the band, -1 if there was none."""
    outside_2pct: int
    beyond: float
    """How far it has come to the other side [m]."""
    near: int
    """For how many steps, up to now, it has been as small as what is forgotten."""


def begin_decay(run: Motion, twin: Motion) -> DecayAccumulator:
    """Run and twin before slot 0."""
    along, across, _ = seen_from_run(run, twin)
    initial = math.sqrt(along * along + across * across)
    return DecayAccumulator(initial, side(along, initial), side(across, initial), -1, -1, 0.0, 0)


def side(component: float, initial: float) -> float:
    """The sign of a component of the initial error; 0 if it is within 2 % of the whole, so that nothing is beyond."""
    if abs(component) <= SHARE * initial or initial <= NEGLIGIBLE:
        return 0.0
    return math.copysign(1.0, component)


def seen_from_run(run: Motion, twin: Motion) -> tuple[float, float, float]:
    """Where the twin is, in the frame of the run's AGV: along, across [m] and turned [rad]."""
    return tracking_error(twin.x, twin.y, twin.theta, run.x, run.y, run.theta)


def update_decay(seen: DecayAccumulator, k: int, run: Motion, twin: Motion) -> DecayAccumulator:
    """At step k, before its slot."""
    along, across, turned = seen_from_run(run, twin)
    distance = math.sqrt(along * along + across * across)
    beyond = seen.beyond
    if -along * seen.along_side > beyond:
        beyond = -along * seen.along_side
    if -across * seen.across_side > beyond:
        beyond = -across * seen.across_side
    is_near = distance < forgotten_below(seen.initial) and abs(turned) < forgotten_below(seen.initial)
    return DecayAccumulator(
        seen.initial, seen.along_side, seen.across_side,
        seen.outside_1cm if distance < TOLERANCE else k,
        seen.outside_2pct if distance < SHARE * seen.initial else k,
        beyond,
        seen.near + 1 if is_near else 0,
    )  # fmt: skip


def end_decay(seen: DecayAccumulator, steps: int, is_whole: bool) -> Decay:
    """After the last of `steps` steps; not `is_whole` if the twin ended before the run did."""
    has_begun = seen.initial > NEGLIGIBLE
    return Decay(
        settled(seen.outside_1cm, steps, is_whole),
        settled(seen.outside_2pct, steps, is_whole) if has_begun else NOT_SETTLED,
        seen.beyond / seen.initial if has_begun else math.nan,
    )


def settled(outside: int, steps: int, is_whole: bool) -> int:
    """The step after the last one outside of a band."""
    return outside + 1 if is_whole and outside + 1 < steps else NOT_SETTLED


def is_at_twin(run: Motion, twin: Motion) -> bool:
    """Does the run begin where its twin does, so that there is no error to settle?"""
    along, across, turned = seen_from_run(run, twin)
    return abs(along) <= NEGLIGIBLE and abs(across) <= NEGLIGIBLE and abs(turned) <= NEGLIGIBLE


def decay(reference: Rows, inputs: RunInputs, twin: Loop) -> Decay:
    """Of a run as `loop.statistics`; it is driven, with its twin, until the initial error is forgotten."""
    run, steps = inputs.start, len(inputs.lost)
    if is_at_twin(run.motion, twin.motion):
        return Decay(NOT_SETTLED, NOT_SETTLED, math.nan)
    seen = begin_decay(run.motion, twin.motion)
    for k in range(steps):
        seen = update_decay(seen, k, run.motion, twin.motion)
        if seen.near >= FORGOTTEN_STEPS:
            break
        compared = compared_reference(reference_at(reference, k), reference, k, inputs.settings.ahead)
        run, sent = slot(run, compared, inputs, k)
        twin, sent_by_twin = slot(twin, compared, inputs, k)
        if not goes_on(run, sent):
            return end_decay(seen, k + 1, True)
        if not goes_on(twin, sent_by_twin):
            return end_decay(seen, k + 1, k + 1 == steps)
    return end_decay(seen, steps, True)


def decay_over_links(reference: Rows, inputs: RunInputs, twin: Loop, taken: Held, ordered: Held) -> Decay:
    """The same of a run whose messages take time, or depend on the place.

    `taken` and `ordered`, shapes (N,), are the steps of the freshest pose and command that were held after each slot.
    """
    run, steps = inputs.start, len(taken)
    if is_at_twin(run.motion, twin.motion):
        return Decay(NOT_SETTLED, NOT_SETTLED, math.nan)
    past, past_of_twin = nothing_past(steps, run.edge.memory), nothing_past(steps, twin.edge.memory)
    seen = begin_decay(run.motion, twin.motion)
    for k in range(steps):
        seen = update_decay(seen, k, run.motion, twin.motion)
        if seen.near >= FORGOTTEN_STEPS:
            break
        send_pose(past, k, run, inputs.noise, inputs.settings)
        send_pose(past_of_twin, k, twin, inputs.noise, inputs.settings)
        run, sent = slot_over_links(run, k, taken[k], ordered[k], reference, inputs, past)
        twin, sent_by_twin = slot_over_links(twin, k, taken[k], ordered[k], reference, inputs, past_of_twin)
        if not goes_on(run, sent):
            return end_decay(seen, k + 1, True)
        if not goes_on(twin, sent_by_twin):
            return end_decay(seen, k + 1, k + 1 == steps)
    return end_decay(seen, steps, True)
