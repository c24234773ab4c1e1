"""The largest n for which no sequence of outages of up to n slots was found that leads out of the corridor.

Sequences are tried on the nonlinear loop, from many places of the lap: outages of n and of j slots by turns, with one
reception between two, for several j, until they repeat what they do. So this bounds what any sequence does from inside;
`outer_tube` bounds it from outside.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from agv_analysis.corridor.lap_loop import Excursions, LapLoop, Outcomes
from agv_analysis.run import Floats

_PLACES = 200
"""Places of the lap from which each sequence is tried."""

_OTHERS = 8
"""Lengths j that are tried beside n."""

_CYCLES, _STEPS = 4, 600
"""Turns of a sequence at least, and steps at least."""


@dataclass(frozen=True)
class WorstSequence:
    """The sequence of outages of up to n slots that was found to use most of the corridor."""

    n: int
    outcomes: Outcomes
    """Its slots, from a reception on, True where lost."""
    step: int
    """Step of the lap at which it begins."""
    share: float
    """Share of the corridor that it uses."""
    deviation: float
    """Distance from the reference at that moment [m]; inf if the loop diverges."""
    shares: Floats
    """Largest share that any of the sequences used, by the step of the lap at which it did, shape (N,); NaN: none."""

    @property
    def lengths(self) -> list[int]:
        """Lengths of its outages in slots, in their order; those of no slot are receptions that follow each other."""
        received = np.flatnonzero(~self.outcomes)
        lengths: list[int] = (np.diff(np.append(received, len(self.outcomes))) - 1).tolist()
        return lengths


def alternating(n: int, other: int) -> Outcomes:
    """Outages of `n` and `other` slots by turns, a reception before each, the last of n slots."""
    turn = np.concatenate((np.arange(n + 1) > 0, np.arange(other + 1) > 0))
    turns = max(_CYCLES, -(-_STEPS // len(turn)))
    return np.concatenate((*(turn,) * turns, np.arange(n + 1) > 0))


def worst_sequence(loop: LapLoop, n: int, more: Iterable[Outcomes] = ()) -> WorstSequence:
    """The worst of all that were tried with outages of up to `n` slots, and of `more` that the caller knows of."""
    best, shares = None, np.full(loop.steps, np.nan)
    for outcomes, found in _tried(loop, n, more):
        at = (found.steps + found.after) % loop.steps
        shares[at] = np.fmax(shares[at], found.share)
        worst = found.worst
        if best is None or found.share[worst] > best.share:
            distance = float(np.hypot(found.along[worst], found.across[worst]))
            step, share = int(found.steps[worst]), float(found.share[worst])
            best = WorstSequence(n, outcomes, step, share, distance if np.isfinite(share) else np.inf, shares)
    assert best is not None
    return best


def _tried(loop: LapLoop, n: int, more: Iterable[Outcomes] = ()) -> Iterator[tuple[Outcomes, Excursions]]:
    """Sequences with outages of up to `n` slots, and what each does; driven as they are asked for."""
    others = np.unique(np.linspace(0, n, _OTHERS).round().astype(int)).tolist()
    every = max(1, loop.steps // _PLACES)
    for outcomes in (*(alternating(n, other) for other in others), *more):
        yield outcomes, loop.excursions(outcomes, every, limit=_FAR)[0]


_FAR = 1e6
"""Share of the corridor beyond which it does not matter how much further a sequence leads."""


def largest_n(loop: LapLoop, longest: int) -> tuple[int, WorstSequence]:
    """(largest n up to `longest` at which no sequence was found that leaves, the one that leaves at n + 1).

    With `longest` the sequence is the worst of that length, which stays inside. -1: it is left without any outage.
    """
    found = worst_sequence(loop, longest)
    if not found.share > 1.0:
        return longest, found
    # What leaves is mostly just shorter: downwards in growing strides, then by bisection.
    outside, inside, stride = longest, max(-1, longest - 1), 2
    while inside >= 0 and _leaves(loop, inside):
        outside, inside, stride = inside, max(-1, inside - stride), 2 * stride
    while outside - inside > 1:
        middle = (inside + outside) // 2
        inside, outside = (inside, middle) if _leaves(loop, middle) else (middle, outside)
    return inside, found if outside == longest else worst_sequence(loop, outside)


def _leaves(loop: LapLoop, n: int) -> bool:
    """Does any of the sequences with outages of up to `n` slots lead out of the corridor?"""
    return any(found.share[found.worst] > 1.0 for _, found in _tried(loop, n))
