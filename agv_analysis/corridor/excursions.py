"""Excursions from the loss-free motion: from every step of a lap the loop is driven on under the same outcomes.

The loop is that of the simulation, slot by slot. Everything here runs as plain Python and compiled.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from agv_analysis.corridor.widths import Widths, deviation, share_of
from agv_analysis.run import Floats
from agv_analysis.simulation.loop import (
    Flags,
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

BACK = 0.1
"""An excursion is over when the deviation is below this share of what it was at most."""

LEVER = 1.0
"""Metres that a radian counts as, when it is asked whether an excursion is over."""

COLUMNS = 4
"""Of an excursion: largest share of the corridor, the step after its beginning at which, along and across there."""


class Plan(NamedTuple):
    """Which excursions are driven."""

    first: int
    """Steps that are driven without losses before the first one begins."""
    every: int
    """Steps from the beginning of one to that of the next."""
    losses: int
    """Steps up to and with the last loss: before it no excursion is over."""
    limit: float
    """Share of the corridor at which an excursion ends, inf: at none."""


def excursions(
    reference: Rows, inputs: RunInputs, widths: Widths, plan: Plan, offsets: Rows, chosen: Flags, found: Floats,
    paths: Floats,
) -> None:  # fmt: skip
    """Drive them; excursion s begins at step plan.first + s plan.every, with the reception of a pose.

    With `chosen`, shape (S,), those that are not are left out; without rows: none is. The AGV is displaced by
    offsets[s], in its own frame [m, m, rad]; `offsets` without rows: it is not. Slot i has the outcome inputs.lost[i].
    `found`, shape (S, COLUMNS), is filled in, and the first rows of `paths`, shape (S, steps, 3): x_e, y_e, theta_e of
    the AGV before each slot. If `paths` has no rows nothing is kept. `reference` has as many rows as are driven and
    looked ahead to.
    """
    base = inputs.start
    for k in range(plan.first):
        base = loss_free(base, reference, k, inputs)
    for s in range(len(found)):
        k = plan.first + s * plan.every
        if len(chosen) > 0 and not chosen[s]:
            for step in range(plan.every):
                base = loss_free(base, reference, k + step, inputs)
            continue
        run = base
        if len(offsets) > 0:
            run = displaced(base, offsets[s][0], offsets[s][1], offsets[s][2])
        largest, at, along_there, across_there = -1.0, 0, 0.0, 0.0
        for i in range(len(inputs.lost) + 1):
            now = reference_at(reference, k + i)
            along, across, turned = deviation(run.motion, now)
            share = share_of(along, across, widths)
            if share > largest:
                largest, at, along_there, across_there = share, i, along, across
            if i < paths.shape[1]:
                x_e, y_e, theta_e = tracking_error(
                    now.x, now.y, now.theta, run.motion.x, run.motion.y, run.motion.theta
                )
                paths[s, i, 0], paths[s, i, 1], paths[s, i, 2] = x_e, y_e, theta_e
            if i == len(inputs.lost) or largest > plan.limit:
                break
            size = max(abs(along), abs(across), LEVER * abs(turned))
            if i > plan.losses and size < BACK * max(abs(along_there), abs(across_there)):
                break
            run, sent = slot(run, compared_reference(now, reference, k + i, inputs.settings.ahead), inputs, i)
            if not goes_on(run, sent):
                largest, at = np.inf, i
                break
        found[s, 0], found[s, 1], found[s, 2], found[s, 3] = largest, at, along_there, across_there
        for step in range(plan.every):
            base = loss_free(base, reference, k + step, inputs)


def loss_free(loop: Loop, reference: Rows, k: int, inputs: RunInputs) -> Loop:
    """The loop after a slot without losses; outcome 0 is a reception."""
    now = reference_at(reference, k)
    loop, _ = slot(loop, compared_reference(now, reference, k, inputs.settings.ahead), inputs, 0)
    return loop


def displaced(loop: Loop, ahead: float, left: float, turned: float) -> Loop:
    """The loop with its AGV elsewhere, by so much in its own frame [m, m, rad]."""
    now = loop.motion
    dx, dy, theta = tracking_error(ahead, left, turned, 0.0, 0.0, -now.theta)
    motion = Motion(now.x + dx, now.y + dy, theta, now.v, now.w, now.a, now.states)
    return Loop(motion, loop.edge, loop.command, loop.plan)
