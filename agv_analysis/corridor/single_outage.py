"""The longest single outage, from anywhere on the lap, that leaves the AGV inside its corridor.

By the nonlinear loop, driven from its loss-free motion: slot by slot it loses the poses of n slots, then none. The
excursion is followed until it is over, for the deviation across the track comes after the outage.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agv_analysis.corridor.lap_loop import Excursions, LapLoop, outage
from agv_analysis.run import Floats

LONGEST = 2000
"""Longest outage [slots] that is tried."""

_PLACES, _SHORTER = 128, 32
"""Places of the lap at which a first bound is searched for; shorter outages that are tried there."""

FEW_PLACES = 40
"""Places of the lap for a rough answer."""

_FINE, _NEAR, _ALIKE = 8, 0.98, 1e-9
"""Every so many steps of the lap an outage is driven; between them where it comes so near to the worst, or outside,
unless places differ by less than that."""

_MANY = 2000
"""Places from which the longest outage is tried."""


@dataclass(frozen=True)
class SingleOutage:
    """What one outage does, wherever on the lap it comes."""

    n: int | None
    """Largest number of slots with which the AGV stays inside; None if it did with all that were tried."""
    step: int
    """Step of the lap after whose reception the first outage begins that leads outside, or comes nearest to it."""
    x: float
    """Where the reference is then [m], frame `map`."""
    y: float
    deviation: float
    """Largest distance from the reference after an outage of n slots, or of the longest tried, from anywhere [m]."""
    shares: Floats
    """Largest share of the corridor that an outage of n slots uses, by the step at which it begins, shape (N,).

    Interpolated between steps of a grid where it is far from the largest.
    """


def single_outage(loop: LapLoop) -> SingleOutage:
    """The longest one. Outages of all shorter lengths stay inside as well, as far as the places that were tried."""
    shortest = _shortest_leaving(loop)
    if shortest is None:
        many = max(1, loop.steps // _MANY)
        all_inside, _ = loop.excursions(outage(LONGEST), many)
        if all_inside.share.max() <= 1.0:
            return _found(loop, None, all_inside.worst * many, all_inside)
        shortest = LONGEST
    inside: Excursions | None = None
    outside: Excursions | None = None
    while shortest > 0:
        tried = _from_all_steps(loop, shortest - 1)
        if np.nanmax(tried.share) <= 1.0:
            inside = tried
            break
        outside, shortest = tried, shortest - 1
    if outside is None:
        outside = _from_all_steps(loop, shortest)
    return _found(loop, shortest - 1, outside.worst, outside if inside is None else inside)


def _from_all_steps(loop: LapLoop, n: int) -> Excursions:
    """Excursions after outages of n slots from every step of the lap that may be the worst one.

    How far an outage leads changes little from one step to the next. So of the steps between two of a grid those are
    driven where it leads nearly as far as anywhere, or nearly outside, at one of the two; the others' share is NaN.
    """
    coarse, _ = loop.excursions(outage(n), _FINE)
    of_both = np.maximum(coarse.share, np.roll(coarse.share, -1))
    largest = float(coarse.share.max())
    near = (of_both >= _NEAR * min(largest, 1.0)) & (largest - float(coarse.share.min()) > _ALIKE * largest)
    chosen = np.repeat(near, _FINE)[: loop.steps]
    fine, _ = loop.excursions(outage(n), chosen=chosen)
    for values, at_grid in zip(fine[1:], coarse[1:], strict=True):
        values[coarse.steps] = at_grid
    return fine


def roughly(loop: LapLoop, places: int = FEW_PLACES) -> int | None:
    """As `single_outage().n`, from some places of the lap, and none of shorter outages: in a tenth of a second.

    The longest outage that is tried shows after how many losses one is outside while it lasts. A shorter one may be so
    afterwards: these are tried from there downwards.
    """
    every = max(1, loop.steps // places)

    def tried(n: int) -> Excursions:
        return loop.excursions(outage(n), every, limit=1.0)[0]

    longest = tried(LONGEST)
    leaves = longest.share > 1.0
    if not leaves.any():
        return None
    outside = min(LONGEST, max(0, int(longest.after[leaves].min()) - 1))
    inside, step = outside - 1, 1
    while inside >= 0 and tried(inside).share.max() > 1.0:
        inside, outside, step = max(-1, inside - step), inside, 2 * step
    while outside - inside > 1:
        middle = (inside + outside) // 2
        inside, outside = (inside, middle) if tried(middle).share.max() > 1.0 else (middle, outside)
    return inside


def _found(loop: LapLoop, n: int | None, step: int, inside: Excursions) -> SingleOutage:
    x, y = loop.lap[step, :2].tolist()
    known = ~np.isnan(inside.share)
    shares = np.interp(np.arange(loop.steps), inside.steps[known], inside.share[known])
    return SingleOutage(n, step, x, y, float(np.nanmax(np.hypot(inside.along, inside.across))), shares)


def _shortest_leaving(loop: LapLoop) -> int | None:
    """Shortest outage that leads outside from one of some places; None if there is none up to LONGEST.

    As `roughly` finds it, and by some of those that are shorter.
    """
    n = roughly(loop, _PLACES)
    if n is None:
        return None
    every = max(1, loop.steps // _PLACES)
    shorter = np.unique(np.linspace(0, max(0, n), _SHORTER).astype(int)).tolist()
    return next((one for one in shorter if loop.excursions(outage(one), every, limit=1.0)[0].share.max() > 1.0), n + 1)
