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

_FINE = 8
"""Every so many steps of the lap it is tried whether a shorter one leaves, before every step is."""

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
    """Largest share of the corridor that an outage of n slots uses, by the step at which it begins, shape (N,)."""


def single_outage(loop: LapLoop) -> SingleOutage:
    """The longest one. Outages of all shorter lengths stay inside as well, as far as the places that were tried."""
    shortest = _shortest_leaving(loop, max(1, loop.steps // _PLACES))
    if shortest is None:
        many = max(1, loop.steps // _MANY)
        all_inside, _ = loop.excursions(outage(LONGEST), many)
        if all_inside.share.max() <= 1.0:
            return _found(loop, None, all_inside.worst * many, all_inside)
        shortest = LONGEST
    while shortest > 0 and loop.excursions(outage(shortest - 1), _FINE, limit=1.0)[0].share.max() > 1.0:
        shortest -= 1
    inside: Excursions | None = None
    outside: Excursions | None = None
    while shortest > 0:
        tried, _ = loop.excursions(outage(shortest - 1))
        if tried.share.max() <= 1.0:
            inside = tried
            break
        outside, shortest = tried, shortest - 1
    if outside is None:
        outside, _ = loop.excursions(outage(shortest))
    return _found(loop, shortest - 1, outside.worst, outside if inside is None else inside)


def roughly(loop: LapLoop, places: int = FEW_PLACES) -> int | None:
    """As `single_outage().n`, from some places of the lap, and none of shorter outages: in a tenth of a second."""
    shortest = _shortest_leaving(loop, max(1, loop.steps // places), shorter=0)
    return None if shortest is None else shortest - 1


def _found(loop: LapLoop, n: int | None, step: int, inside: Excursions) -> SingleOutage:
    x, y = loop.lap[step, :2].tolist()
    shares = np.interp(np.arange(loop.steps), inside.steps, inside.share)
    return SingleOutage(n, step, x, y, float(np.hypot(inside.along, inside.across).max()), shares)


def _shortest_leaving(loop: LapLoop, every: int, shorter: int = _SHORTER) -> int | None:
    """Shortest outage that leads outside from one of some places; None if there is none up to LONGEST.

    By bisection, and by so many of those that are `shorter` than what it finds.
    """

    def leaves(n: int) -> bool:
        return bool(loop.excursions(outage(n), every, limit=1.0)[0].share.max() > 1.0)

    inside, outside = -1, 0
    while not leaves(outside):
        if outside == LONGEST:
            return None
        inside, outside = outside, min(LONGEST, 2 * outside + 1)
    while outside - inside > 1:
        middle = (inside + outside) // 2
        inside, outside = (inside, middle) if leaves(middle) else (middle, outside)
    tried = np.unique(np.linspace(0, max(0, outside - 1), shorter).astype(int)).tolist()
    return next((n for n in tried if leaves(n)), outside)
