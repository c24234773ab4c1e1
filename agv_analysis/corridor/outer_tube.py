"""A tube about the loss-free motion that no sequence of outages of up to n slots leaves.

With z the deviation of the errors (x_e, y_e, theta_e) from those of the loss-free motion, an outage makes of a state at
a reception

    z(k+i) = M_i(k) z(k) + b_i(k),    i = 1 .. n + 1,

where M_i is the map of the linear loop (`reception_maps`), and b_i what the outage does to an AGV without deviation:
the bias of `hold`, or what the model of `predict` does not know. Any of these states may be the next reception. So the
support function V_k(d) = sup d' z(k), over all sequences, obeys

    V_k(d) = max over i of  d' b_i(k-i) + V_{k-i}(M_i(k-i)' d).

It is bounded from above on a few directions d: both along x_e, and a polygon in the plane of y_e and theta_e. Any
other direction is a sum of three of them with positive weights, and V of a sum is at most the sum. Bounds of a lap that
are no larger at its end than at its beginning hold forever; so do those of its halves, computed side by side, if each
half ends with bounds that are no larger than those with which the other one begins.

This proves the tube for the linear loop with the b_i of the nonlinear one. What is of second order, the `remainder`,
can be added to each b_i as a box: see `second_order`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from agv_analysis.compiled.functions import compiled
from agv_analysis.corridor.biases import Biases, biases, neighbours
from agv_analysis.corridor.lap_loop import LapLoop
from agv_analysis.corridor.widths import Widths
from agv_analysis.run import Floats
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.products import IDENTITY, times

_SIDES, _SIDES_OF_LONG = 32, 16
"""Directions of the polygon, fewer for outages that are LONG; multiples of 4, so that those along y_e and theta_e are
among them."""

LONG = 100
"""Slots from which on an outage is long: tubes then take seconds, and what is of second order is not measured."""

_FARTHER = 3.0
"""Multiple of the corridor's width up to which a tube is followed, to know how much too wide it is."""

ERRORS = 3

_WARM_UP = 4000
"""Steps after which what the tube was before is forgotten; at the end it is tested that it was."""

_SLACK = 1e-6
"""By so much the tube is widened before the lap that must give it back."""

_LAPS = 4
"""Laps after which a tube that still grows counts as one without an end."""

_APART, _BELOW = 5, 0.988
"""Steps between receptions, at most, of a first look at outages that are LONG; share of the n found with which the tube
of all is tried, which is wider by a hundredth or two."""


class Template(NamedTuple):
    """Directions in which the tube is bounded: (1, 0, 0), (-1, 0, 0), then the polygon's."""

    directions: Floats
    """Shape (2 + sides, 3)."""
    lever: float
    """How many metres a radian counts as in the polygon's plane."""

    @property
    def quarter(self) -> int:
        """A quarter of the polygon's sides."""
        return (len(self.directions) - 2) // 4

    @property
    def of_errors(self) -> tuple[tuple[int, int, float], ...]:
        """Of x_e, y_e, theta_e: the directions along and against it, and how many metres one of it counts as."""
        quarter = self.quarter
        return (0, 1, 1.0), (2, 2 + 2 * quarter, 1.0), (2 + quarter, 2 + 3 * quarter, self.lever)


@dataclass(frozen=True)
class Tube:
    """Bounds of the deviation under any outages of up to n slots, by step of the lap."""

    n: int
    bounds: Floats
    """V_k of the template's directions, shape (R, 2 + sides); R is N, or 1 where the loop is the same at every step."""
    template: Template
    nominal: Floats
    """Errors of the loss-free motion, shape (R, 3)."""
    share: Floats
    """Share of the corridor that the tube uses at most, by step, shape (R,)."""
    distance: Floats
    """Largest distance from the reference in it [m], by step, shape (R,)."""

    @property
    def deviation(self) -> float:
        """The same over the lap."""
        return float(self.distance.max())

    @property
    def largest_share(self) -> float:
        """The same over the lap."""
        return float(self.share.max())


def template_of(linear: LinearLoop, sides: int = _SIDES) -> Template:
    """Directions for a loop; the lever makes a turn of its error across the track nearly a circle."""
    k = 0 if linear.is_constant else int(np.argmax(np.abs(linear.v_r)))
    step = linear.F[k].copy()
    step[:, : linear.outputs] += linear.G[k]
    ratio = -step[1, 2] / step[2, 1] if step[2, 1] != 0.0 else 1.0
    lever = math.sqrt(ratio) if ratio > 0.0 else 1.0
    angles = 2.0 * np.pi * np.arange(sides) / sides
    polygon = np.column_stack((np.zeros(sides), np.cos(angles), lever * np.sin(angles)))
    return Template(np.concatenate(([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], polygon)), lever)


def applies_to(linear: LinearLoop) -> bool:
    """Are the errors all the states of the loop?"""
    return linear.size == linear.outputs == ERRORS


def outer_tube(loop: LapLoop, linear: LinearLoop, n: int, bias: Biases | None = None, apart: int = 1) -> Tube | None:
    """The tube for outages of up to `n` slots; None where it grows out of the corridor, or forever.

    `bias` of no shorter ones, if it is known. Of receptions `apart` steps apart, a divisor of a lap, it is no wider
    than of all, and bounds those steps alone.
    """
    bias = biases(loop, linear, n) if bias is None else bias.up_to(n)
    return tube_with(loop, linear, n, bias, np.zeros((1, n + 2, ERRORS)), apart)


def largest_n(loop: LapLoop, linear: LinearLoop, longest: int) -> tuple[int, Tube | None]:
    """(largest n up to `longest` whose tube stays in the corridor, the tube); -1 if not even that without outages does.

    A tube holds those of fewer slots. The n of outages that are LONG is the largest to a fiftieth of it.
    """
    if linear.is_exact:  # an outage leaves nothing, however long
        return longest, outer_tube(loop, linear, 0)
    of_longest, predicts = biases(loop, linear, longest), linear.predicts
    attempt, outside, apart = longest, longest + 1, _apart(loop, linear)

    def of_few_receptions(n: int) -> Tube | None:
        return outer_tube(loop, linear, n, of_longest, apart if n > LONG else 1)

    if longest > LONG and apart > 1:
        inside, outside, _ = _bracket(of_few_receptions, predicts, outside, attempt, _FINER)
        attempt = max(0, int(_BELOW * inside) if inside > LONG else inside)
    inside, _, tube = _bracket(lambda n: outer_tube(loop, linear, n, of_longest), predicts, outside, attempt, _FINE)
    return inside, tube


_FINE, _FINER = 50, 400
"""The n of outages that are LONG is found to such a part of it, and that of receptions at some steps alone."""


def _apart(loop: LapLoop, linear: LinearLoop) -> int:
    """Steps between receptions that a lap is a multiple of, at most _APART."""
    lap = 1 if linear.is_constant else loop.steps
    return _APART if lap == 1 else max(apart for apart in range(1, _APART + 1) if lap % apart == 0)


def _bracket(
    tube_of: Callable[[int], Tube | None], predicts: bool, outside: int, attempt: int, part: int
) -> tuple[int, int, Tube | None]:
    """(largest n whose tube stays in the corridor or -1, one whose does not, the tube of the first).

    Up to `outside`, which does not; `attempt` is tried first. To a `part` of n where that is LONG.
    """
    inside, tube = -1, None
    while outside - inside > max(1, inside // part if inside > LONG else 0):
        found = tube_of(attempt)
        expected = 0.0 if found is None else shorter(attempt, found.largest_share, predicts)
        if found is not None and found.largest_share <= 1.0:
            inside, tube = attempt, found
            wanted = max(int(expected), inside + inside // part) if inside > LONG else 0
        else:
            outside = attempt
            wanted = int((1.0 - 0.5 / part if attempt > LONG else 1.0) * expected)
        attempt = wanted if inside < wanted < outside else (inside + outside) // 2
    return inside, outside, tube


def shorter(n: int, share: float, predicts: bool) -> float:
    """The n whose tube uses all of the corridor, by that share of it which another one's uses.

    How far outages lead grows with their length behind a predictor, with its square where a pose is held.
    """
    return float(n / share ** (1.0 if predicts else 0.5))


def tube_with(
    loop: LapLoop, linear: LinearLoop, n: int, bias: Biases, remainder: Floats, apart: int = 1
) -> Tube | None:
    """As `outer_tube`, with boxes that are added to the b_i, by part of the lap: shape (parts, n + 2, 3)."""
    if not np.isfinite(bias.rows).all():
        return None
    rows, template = len(bias.nominal), template_of(linear, _SIDES_OF_LONG if n > LONG else _SIDES)
    whole, warm_up = math.lcm(rows, apart), -(-_WARM_UP // apart) * apart
    lap = -(-max(rows, n + 2, _WARM_UP) // whole) * whole  # in whole turns of the rows, longer than any memory
    widths = loop.widths
    limit = _FARTHER * min(widths.distance, max(widths.along, widths.across))
    bounds = np.empty((lap, len(template.directions)))
    begins = (0, lap // 2 // apart * apart) if lap >= 2 * max(warm_up, n + 2) else (0,)
    drive = compiled(_push)
    matrices = linear.F, linear.G, linear.H, linear.K
    arguments = *matrices, bias.rows, bias.every, rows, remainder, template.directions, template.lever, apart

    def drive_from(begin: int, window: Floats, of_steps: Floats) -> bool:
        return bool(drive(*arguments, begin % rows, window, of_steps, limit))

    windows = np.zeros((len(begins), n + 2, len(template.directions)))
    with ThreadPoolExecutor(len(begins)) as pool:
        earlier = [begin - warm_up for begin in begins]
        if not all(pool.map(drive_from, earlier, windows, np.empty((len(begins), warm_up, bounds.shape[1])))):
            return None
        for _ in range(_LAPS):
            windows += _SLACK * np.where(np.isfinite(windows), np.abs(windows) + 1e-6, 0.0)
            before = windows.copy()
            if not all(pool.map(drive_from, begins, windows, np.split(bounds, begins[1:]))):
                return None
            windows = np.roll(windows, 1, axis=0)  # each part goes on where the one before it has ended
            if (windows <= before).all():
                of_rows = bounds.reshape(-1, rows, bounds.shape[1]).max(axis=0)[::apart]
                nominal = bias.nominal[::apart]
                return Tube(n, of_rows, template, nominal, *_extent(of_rows, template, nominal, widths))
    return None


def _push(
    F: Floats, G: Floats, H: Floats | None, K: Floats | None, bias: Floats, every: int, lap: int, remainder: Floats,
    directions: Floats, lever: float, apart: int, first: int, window: Floats, bounds: Floats, limit: float,
) -> bool:  # fmt: skip
    """Drive the bounds on: row j of `bounds` is that of step first + j; False where one leaves the limit.

    `window`, row i: the bounds that are known of the state i steps on, all of them for i = 0; in place. Directions that
    are opposite are looked at together.
    """
    count, longest, sides = directions.shape[0], window.shape[0] - 1, directions.shape[0] - 2
    half, per_sine, per_lever = sides // 2, 1.0 / math.sin(2.0 * math.pi / sides), 1.0 / lever
    c_y, t_of = directions[2:, 1].copy(), directions[2:, 2].copy()
    c_t = t_of / lever
    of_y, of_t = np.empty(sides), np.empty(sides)
    sectors = np.zeros(half, dtype=np.int64)
    for j in range(bounds.shape[0]):
        for i in range(count):
            bounds[j, i] = window[0, i]
        if not (max(window[0, 0], window[0, 1]) <= limit and max(window[0, 2], window[0, 2 + half]) <= limit):
            return False
        for side in range(sides):  # in a sector V is of_y p_y + of_t p_t, by the directions at its sides
            further = side + 1 if side + 1 < sides else 0
            near, far = bounds[j, 2 + side] * per_sine, bounds[j, 2 + further] * per_sine
            of_y[side] = c_t[further] * near - c_t[side] * far
            of_t[side] = c_y[side] * far - c_y[further] * near
        for i in range(half):
            sectors[i] = i
        M, N, skipped = IDENTITY, IDENTITY, 0
        until = longest if j % apart == 0 else 0
        begun = (first + j) % lap
        before, after, share = neighbours(begun, every, bias.shape[0], lap)
        part, row = begun * remainder.shape[0] // lap, (first + j) % F.shape[0]
        for length in range(1, until + 1):
            following = times(F[row], M, times(G[row], N))
            if H is not None:
                N = times(H[row], N, times(K[row], M)) if K is not None else times(H[row], N)
            M = following
            row = row + 1 if row + 1 < F.shape[0] else 0
            skipped = skipped + 1 if skipped + 1 < apart else 0  # slots since one that may be a reception
            if skipped != 0:
                continue
            b_x = (1.0 - share) * bias[before, length, 0] + share * bias[after, length, 0]
            b_y = (1.0 - share) * bias[before, length, 1] + share * bias[after, length, 1]
            b_t = (1.0 - share) * bias[before, length, 2] + share * bias[after, length, 2]
            r_x, r_y, r_t = remainder[part, length, 0], remainder[part, length, 1], remainder[part, length, 2]
            for i in range(-1, half):
                if i < 0:  # along x_e
                    p_x, p_y, p_t = M[0], M[1], M[2] * per_lever
                    pushed, unknown, side, one, other = b_x, r_x, sectors[0], 0, 1
                else:  # of the polygon
                    y, theta = c_y[i], t_of[i]
                    p_x, p_y = M[3] * y + M[6] * theta, M[4] * y + M[7] * theta
                    p_t = (M[5] * y + M[8] * theta) * per_lever
                    pushed, unknown = b_y * y + b_t * theta, r_y * abs(y) + r_t * abs(theta)
                    side, one, other = sectors[i], 2 + i, 2 + i + half
                # The sector that holds (p_y, p_t), searched for from where it was after one slot less.
                for _ in range(sides):
                    further = side + 1 if side + 1 < sides else 0
                    if c_y[side] * p_t < c_t[side] * p_y:
                        side = side - 1 if side > 0 else sides - 1
                    elif p_y * c_t[further] < p_t * c_y[further]:
                        side = further
                    else:
                        break
                if i >= 0:
                    sectors[i] = side
                opposite = side + half if side < half else side - half
                ahead, behind = (bounds[j, 0], bounds[j, 1]) if p_x >= 0.0 else (bounds[j, 1], bounds[j, 0])
                value = abs(p_x) * ahead + of_y[side] * p_y + of_t[side] * p_t + pushed + unknown
                against = abs(p_x) * behind - of_y[opposite] * p_y - of_t[opposite] * p_t - pushed + unknown
                window[length, one] = max(window[length, one], value)
                window[length, other] = max(window[length, other], against)
        for length in range(longest):
            for i in range(count):
                window[length, i] = window[length + 1, i]
        for i in range(count):
            window[longest, i] = -math.inf
    return True


def _extent(bounds: Floats, template: Template, nominal: Floats, widths: Widths) -> tuple[Floats, Floats]:
    """Share of the corridor that the tube uses at most at each step, and the largest distance [m]; shapes (R,)."""
    quarter = template.quarter
    x = np.maximum(bounds[:, 0] + nominal[:, 0], bounds[:, 1] - nominal[:, 0])
    y = np.maximum(bounds[:, 2] + nominal[:, 1], bounds[:, 2 + 2 * quarter] - nominal[:, 1])
    turned = np.maximum(bounds[:, 2 + quarter], bounds[:, 2 + 3 * quarter]) / template.lever + np.abs(nominal[:, 2])
    along, across = x + turned * y, y + turned * x  # the errors are seen from the AGV, the corridor from its reference
    distance = np.hypot(x, y)
    return np.maximum(distance / widths.distance, np.maximum(along / widths.along, across / widths.across)), distance
