"""What is of second order in an outage, and the tube that covers it: that of the nonlinear loop.

From a reception with the deviation z from the loss-free motion, i slots lead the nonlinear loop to Phi_i(z). The
`remainder` is what the linear loop of `outer_tube` leaves out of it,

    r_i(z) = Phi_i(z) - Phi_i(0) - M_i z,    Phi_i(0) = b_i.

Phi_i(z) - Phi_i(0) = J z, where J is the mean of the derivatives of Phi_i on the way from 0 to z, so the mean of those
at the shares [m, m + 1] / F of the way, m < F. `proved_remainder` computes bounds of these, over boxes that hold such
shares of all z, by interval arithmetic on the dual numbers that also give M_i: by the very functions that the nodes
call, slot by slot, at once for all steps of each part of the lap. A tube that adds to each b_i the remainder which its
own states can have holds the nonlinear loop, under any outages of up to n slots.

Where a function takes one branch or the other within the bounds, or a policy is another package's, the remainder is
measured instead, from the corners of the tube at places of the lap, and times a factor: covered, but not proved.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.corridor.biases import Biases, biases
from agv_analysis.corridor.lap_loop import LapLoop, outage
from agv_analysis.corridor.outer_tube import ERRORS, LONG, Tube, outer_tube, shorter, tube_with
from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.loop import Settings
from agv_analysis.stability.derivatives import differentiable
from agv_analysis.stability.derivatives.interval import (
    Interval,
    NoBoundsError,
    bounds_of,
    product,
    slopes,
    stacked,
    variable,
    within,
)
from agv_analysis.stability.error_dynamics import LoopModel, model_of, plant_error_step
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.reception_maps import burst_maps
from agv_cloud.control.command import command
from agv_cloud.reference.point import ReferencePoint
from agv_cloud.staleness.estimate import staleness_policy
from agv_cloud.staleness.registry import COMPILED
from agv_cloud.tracking_error import tracking_error
from agv_plant.vehicle.unicycle import euler_step
from agv_ros.pose import Pose
from agv_ros.substitution import replaced

_PARTS, _MORE_PARTS = 300, 1000
"""Parts of the lap for which the remainder is bounded, or of each of which it is measured where it begins; and those
for the last bounds, of a tube that holds the loop."""

_SHARES = 4
"""F, shares of the way to a state: with one the remainder is twice what it need be, with many half more costs."""

_ROUNDS, _MORE = 12, 1.2
"""How often the tube is widened by the remainder that it has, and by how much more than that."""

_LEAST = 1e-9
"""Remainder that is added at least [m, m, rad]: far above what rounding makes of the numbers here."""

_TIMES = 1.2
"""Factor on the largest remainder that was measured."""

_ATTEMPTS, _TOO_WIDE = 3, 1.2
"""How many n are tried, and the share of the corridor by which the next n is chosen where the tube had no end."""


class NonlinearTube(NamedTuple):
    """A tube that holds the nonlinear loop."""

    tube: Tube
    is_proved: bool
    """Is what is of second order bounded, or was it measured?"""


RemainderOf = Callable[[LapLoop, LinearLoop, Tube, Biases, int], Floats]
"""`proved_remainder` or `measured_remainder`, of a tube, by so many parts of the lap."""


def nonlinear_tube(loop: LapLoop, linear: LinearLoop, tube: Tube) -> NonlinearTube | None:
    """A tube as this one that covers what is of second order, too; its n may be a little smaller.

    None where none was found that stays in the corridor, or where outages are LONG.
    """
    if tube.n > LONG:
        return None
    bias = biases(loop, linear, tube.n)
    try:
        found, is_proved = _of_fewer_slots(loop, linear, tube, bias, proved_remainder), True
    except NoBoundsError:
        found, is_proved = _of_fewer_slots(loop, linear, tube, bias, measured_remainder), False
    return None if found is None else NonlinearTube(found, is_proved)


def _of_fewer_slots(
    loop: LapLoop, linear: LinearLoop, tube: Tube, bias: Biases, remainder_of: RemainderOf
) -> Tube | None:
    """The tube with its remainder, of as many slots as this one or of some less; None if all leave the corridor."""
    n, inner = tube.n, tube
    for attempt in range(_ATTEMPTS):
        found = _with_remainder(loop, linear, inner, bias.up_to(n), remainder_of)
        share = _TOO_WIDE if found is None else found.largest_share
        if found is not None and share <= 1.0:
            return found
        n = min(n - max(1, n // 12) * 2**attempt, int(shorter(n, share, linear.predicts)))
        smaller = outer_tube(loop, linear, n, bias) if n >= 0 else None
        if smaller is None:
            return None
        inner = smaller
    return None


def _with_remainder(
    loop: LapLoop, linear: LinearLoop, tube: Tube, bias: Biases, remainder_of: RemainderOf
) -> Tube | None:
    """The tube that adds to each b_i the remainder of its own states; None if there is no end to it.

    Or one with less than that which leaves the corridor already. `tube`: that of the linear loop.
    """
    parts, finer = (1, 1) if linear.is_constant else (min(_PARTS, loop.steps), min(_MORE_PARTS, loop.steps))
    remainder, found = np.zeros((parts, tube.n + 2, ERRORS)), tube
    for _ in range(_ROUNDS):
        needed = remainder_of(loop, linear, found, bias, parts)
        if not np.isfinite(needed).all():
            return None
        if (needed <= remainder).all():  # the loop stays within it, and so has no more than this
            if remainder_of is proved_remainder:  # measured at other places there may be more
                needed = proved_remainder(loop, linear, found, bias, finer)
            return tube_with(loop, linear, tube.n, bias, np.maximum(needed, _LEAST)) or found
        remainder = np.maximum(remainder, np.maximum(_LEAST, _MORE * needed))
        wider = tube_with(loop, linear, tube.n, bias, remainder)
        if wider is None or wider.largest_share > 1.0:
            return wider
        found = wider
    return None


# -- proved ------------------------------------------------------------------------------------------------------------


def outage_step(
    x_e: float, y_e: float, theta_e: float, x_h: float, y_h: float, theta_h: float, v_r: float, w_r: float,
    v_next: float, w_next: float, settings: Settings,
) -> tuple[float, float, float, float, float, float]:  # fmt: skip
    """The errors of the AGV and those by which the edge steers (x_h, y_h, theta_h), a slot without reception later.

    v_r, w_r are the reference's speeds of this slot, v_next, w_next those of the next one. The policy is one of this
    package: the reference is where it compares its pose with, or it does not ask for it.
    """
    v, w, _ = command(
        x_h, y_h, theta_h, v_r, w_r, (), settings.gains, settings.ts, settings.look_ahead, settings.v_max
    )  # fmt: skip
    x_e, y_e, theta_e, _, _, _, _ = plant_error_step(
        x_e, y_e, theta_e, 0.0, 0.0, 0.0, (), v, w, v_r, w_r, settings
    )  # fmt: skip
    x, y, theta = euler_step(x_h, y_h, theta_h, v_r, w_r, settings.ts)
    held, target = staleness_policy(
        settings.policy, Pose(0.0, 0.0, 0.0), Pose(x_h, y_h, theta_h), ReferencePoint(x, y, theta, v_next, w_next),
        v, w, settings.ts, settings.model_arc, settings.policy_parameters,
    )  # fmt: skip
    x_h, y_h, theta_h = tracking_error(target.x, target.y, target.theta, held.x, held.y, held.theta)
    return x_e, y_e, theta_e, x_h, y_h, theta_h


def proved_remainder(loop: LapLoop, linear: LinearLoop, tube: Tube, bias: Biases, count: int) -> Floats:
    """Bounds of |r_i(z)| for all z in a tube, by so many parts of the lap, shape (count, n + 2, 3).

    Slot by slot: bounds of the derivatives of one slot, over all errors that there can be before it, are multiplied,
    and errors follow from those in the middle of their bounds. Raises NoBoundsError where there are none.
    """
    model, parts, length = model_of(loop.scenario), _Parts.of(loop, linear, count), tube.n + 2
    if not _has_bounds(loop.scenario, model) or bias.every > 1:  # between others the b_i are not exact
        raise NoBoundsError("a loop whose errors do not move on by themselves, or with unknown b_i")
    step = differentiable(replaced(outage_step, model.parts))
    box, found = _box(tube, parts), np.zeros((count, length, ERRORS))
    errors = stacked([_on_the_way(parts.over(tube.nominal[:, j]), box[j]) for j in range(ERRORS)] * 2)
    so_far = Interval(*[np.tile(np.eye(ERRORS), (2, 1))[:, :, None]] * 2)
    try:
        for i, M in enumerate(burst_maps(linear, length - 1, np.arange(parts.steps)), start=1):
            speeds = [within(_repeated(one)) for slot in (i - 1, i) for one in parts.speeds(linear, slot)]
            middle = Interval(*[0.5 * (errors.low + errors.high)] * 2)
            ahead = step(*map(within, middle), *speeds, model.settings)
            moved = step(*map(variable, errors, range(2 * ERRORS)), *speeds, model.settings)
            slope = stacked([stacked(slopes(number, range(2 * ERRORS))) for number in moved])
            so_far = product(slope, so_far)
            errors = stacked([bounds_of(number) for number in ahead]) + product(slope, (errors - middle)[:, None])[:, 0]
            apart = _mean(so_far[:ERRORS]) - parts.over(M)
            found[:, i] = np.einsum("jlp,lp->pj", apart.largest, stacked(box).largest)
    except TypeError as error:  # numbers that the function does not take for floats, or rows that part
        raise NoBoundsError(str(error)) from error
    return found


def _has_bounds(scenario: Scenario, model: LoopModel) -> bool:
    """Do the errors move on by themselves, whatever the drive did before, under one of this package's policies?

    Of another's policy is not known what it compares.
    """
    plant = scenario.plant
    moves_at_once = plant.lag == 0.0 and plant.a_max == plant.j_max == math.inf and model.states == 0
    return moves_at_once and not model.memory and scenario.error_detector.policy in COMPILED


class _Parts(NamedTuple):
    """Parts of a lap, of which values at single steps are joined to bounds."""

    first: NDArray[np.int64]
    """The first step of each."""
    steps: int
    """Steps of the lap; 1 where the loop is the same at each."""

    @classmethod
    def of(cls, loop: LapLoop, linear: LinearLoop, count: int) -> _Parts:
        """Step k of N lies in part floor(k count / N), as in the tube."""
        steps = 1 if linear.is_constant else loop.steps
        return cls(-(-np.arange(count) * steps // count), steps)

    def over(self, values: Floats) -> Interval:
        """Bounds of values at the steps of the lap, shape (steps, ...), over each part, shape (..., parts)."""
        low, high = np.minimum.reduceat(values, self.first), np.maximum.reduceat(values, self.first)
        return Interval(np.moveaxis(low, 0, -1), np.moveaxis(high, 0, -1))

    def speeds(self, linear: LinearLoop, slot: int) -> tuple[Interval, Interval]:
        """Of the reference [m/s, rad/s], so many slots after a step, over each part."""
        v_r, w_r = linear.v_r[: self.steps], linear.w_r[: self.steps]
        return self.over(np.roll(v_r, -slot)), self.over(np.roll(w_r, -slot))


def _box(tube: Tube, parts: _Parts) -> list[Interval]:
    """Bounds of the deviations x_e, y_e, theta_e [m, m, rad] in a tube, over each part."""
    found = []
    for one, other, unit in tube.template.of_errors:
        ahead, behind = parts.over(tube.bounds[:, one]), parts.over(tube.bounds[:, other])
        found.append(Interval(-behind.high / unit, ahead.high / unit))
    return found


def _on_the_way(nominal: Interval, box: Interval) -> Interval:
    """An error from the nominal one to as far as each share of the way to a state, shape (shares times parts,)."""
    to_state = Interval(np.minimum(box.low, 0.0), np.maximum(box.high, 0.0))
    reached = [nominal + to_state * ((m + 1) / _SHARES) for m in range(_SHARES)]
    return Interval(np.concatenate([one.low for one in reached]), np.concatenate([one.high for one in reached]))


def _repeated(of_parts: Interval) -> Interval:
    """The same on each share of the way."""
    return Interval(np.tile(of_parts.low, _SHARES), np.tile(of_parts.high, _SHARES))


def _mean(on_the_way: Interval) -> Interval:
    """Over the shares of the way, shape (..., parts)."""
    shape = *on_the_way.shape[:-1], _SHARES, -1
    return Interval(on_the_way.low.reshape(shape).mean(axis=-2), on_the_way.high.reshape(shape).mean(axis=-2))


# -- measured ----------------------------------------------------------------------------------------------------------


def measured_remainder(loop: LapLoop, linear: LinearLoop, tube: Tube, bias: Biases, parts: int) -> Floats:
    """Largest difference of the nonlinear loop from M_i z + b_i, from the corners of a tube, times a factor.

    Shape (parts, n + 2, 3). Of each part of the lap it is measured from where it begins, and holds for it and the one
    before.
    """
    length, every = tube.n + 2, -(-loop.steps // parts)
    steps = np.arange(0, loop.steps, every)
    widest = np.maximum.reduceat(tube.bounds, np.unique(steps * len(tube.bounds) // loop.steps))
    widest = np.broadcast_to(widest, (len(steps), widest.shape[1]))
    ahead, left, turned = (
        np.stack((widest[:, one], -widest[:, other])) / unit for one, other, unit in tube.template.of_errors
    )
    identity = np.broadcast_to(np.eye(ERRORS), (len(steps), ERRORS, ERRORS))
    maps = np.stack((identity, *burst_maps(linear, length - 1, steps % len(linear.F))))
    pushed, found = bias.at(steps), np.zeros((len(steps), length, ERRORS))
    nominal = tube.nominal[(steps[:, None] + np.arange(length)) % len(tube.nominal)]
    for x, y, theta in itertools.product(ahead, left, turned):
        offsets = np.column_stack(_placed(x, y, theta))
        _, paths = loop.excursions(outage(tube.n), every, offsets=offsets, kept=length, follow=False)
        deviation = paths - nominal
        apart = deviation - np.einsum("isjk,sk->sij", maps, deviation[:, 0]) - pushed
        found = np.fmax(found, np.abs(apart))
    found = np.maximum(found, np.roll(found, -1, axis=0))
    return _TIMES * found[np.arange(parts) * len(steps) // parts]


def _placed(x: Floats, y: Floats, theta: Floats) -> tuple[Floats, Floats, Floats]:
    """How AGVs on their reference must be displaced, in their own frame, to see it at these errors."""
    cos, sin = np.cos(theta), np.sin(theta)
    return -cos * x - sin * y, sin * x - cos * y, -theta
