"""Growth of E[e^2] if the intervals between receptions are drawn from those observed: no model of the link.

With M_L the map from a reception to the next, L steps later, and independent intervals, the second moments at
receptions obey X+ = E[M_L X M_L']; they die out if and only if the spectral radius of that operator is below 1, along a
straight track E[(1 - a L)^2] < 1, that is E[L^2] / E[L] < 2 / a. Intervals that depend on each other are looked at in
blocks of m at a time, whose maps are products: under dependence E[P X P'] of the products P may grow faster than the
m-th power of the operator of single intervals.

How sure: the Bayesian bootstrap. The intervals (or blocks) observed get random weights, and with them one that was not
observed: as the worst one, its second moment times 1/U, U uniform in (0, 1], for a tail that a recording has not shown.
Where a few long outages carry the mean square this makes it uncertain, as it is.

Source: Rubin, The Bayesian Bootstrap, Ann. Statist. 9, 1981; Costa, Fragoso and Marques, Discrete-Time Markov Jump
Linear Systems, 2005.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats
from agv_analysis.stability.linear_loop import MARGINAL, LinearLoop
from agv_analysis.stability.moment_operators import log_radius, places, symmetric_operator
from agv_analysis.stability.reception_maps import interval_maps

_SAMPLES = 200

_SEED = 1

_BLOCKS = 30
"""Fewest blocks of intervals whose mean says anything."""

_SHORTEST = 4
"""Intervals of the shortest block."""

_PLACES_OF_BLOCKS = 3

_WINDOW = 8
"""Intervals of a stretch that is looked at by itself."""

_WINDOWS = 40

_TILTS = 8

_STEEPEST = 10.0
"""Growth per step (logarithm) beyond which none is looked for."""

Lengths = NDArray[np.int64]


@dataclass(frozen=True)
class IntervalGrowth:
    """What the intervals of a recording come to."""

    growth: float
    """Growth of E[e^2] (logarithm, per step) under the intervals observed."""
    samples: Floats
    """The same under random weights, to first order about `growth`, shape (n,)."""
    block: int
    """Intervals that were taken together; 1: as independent ones."""

    @property
    def probability_stable(self) -> float:
        """Share of the samples that die out."""
        return float(np.mean(self.samples < MARGINAL))


def interval_growth(
    loop: LinearLoop, lengths: Lengths, longest: int, dependent: bool, move: float = 0.0
) -> IntervalGrowth:
    """Growth for intervals `lengths` [steps] in the order of time, shape (n,), n >= 1; the least sure one over blocks.

    `longest` is the longest interval seen, complete or not. Blocks of 1, 2, 4, ... intervals are looked at where they
    are `dependent`, else single ones. `move` is what the mean over a few places of the lap leaves out of the growth per
    step, as of `growth_posterior.moved`: that of a Gilbert channel with the same transitions.
    """
    steps = places(loop)
    found = [_of_independent(loop, steps, lengths, longest)]
    if dependent:
        found += _of_blocks(loop, steps, lengths)
    moved = [IntervalGrowth(one.growth + move, one.samples + move, one.block) for one in found]
    return min(moved, key=lambda one: one.probability_stable)


def _of_independent(loop: LinearLoop, steps: NDArray[np.int64], lengths: Lengths, longest: int) -> IntervalGrowth:
    values, counts = np.unique(lengths, return_counts=True)
    operators = _operators(loop, steps, np.append(values, max(longest, int(values[-1]))))
    rng = np.random.default_rng(_SEED)
    weights = np.column_stack((rng.gamma(counts, size=(_SAMPLES, len(values))), _unseen(rng)))
    shares = counts / counts.sum()
    return _growths(operators, shares, weights, values.astype(np.float64), 1)


def _of_blocks(loop: LinearLoop, steps: NDArray[np.int64], lengths: Lengths) -> list[IntervalGrowth]:
    values, which = np.unique(lengths, return_inverse=True)
    steps = steps[:_PLACES_OF_BLOCKS]
    maps = np.stack([interval_maps(loop, np.full(len(values), k), values)[which] for k in steps])
    spans, block, found = lengths.astype(np.float64), 1, []
    while len(spans) // 2 >= _BLOCKS:
        even = len(spans) & ~1
        maps, spans, block = maps[:, 1:even:2] @ maps[:, 0:even:2], spans[0:even:2] + spans[1:even:2], 2 * block
        if block < _SHORTEST and len(spans) // 2 >= _BLOCKS:
            continue
        worst = int(np.argmax(np.abs(maps).max(axis=(0, 2, 3))))
        operators = symmetric_operator(np.concatenate((maps, maps[:, worst : worst + 1]), axis=1))
        rng = np.random.default_rng(_SEED)
        weights = np.column_stack((rng.standard_exponential((_SAMPLES, len(spans))), _unseen(rng)))
        found.append(_growths(operators, np.full(len(spans), 1.0 / len(spans)), weights, spans, block))
    return found


def grows_for_a_while(loop: LinearLoop, lengths: Lengths) -> bool:
    """Are there some successive intervals among `lengths`, (n,), under whose mean operator E[e^2] grows?

    Even without the longest of them: more than one outage. Where intervals depend on each other, the link may stay in
    such a state, and how long it stays decides.
    """
    if len(lengths) < _WINDOW:
        return False
    windows = np.lib.stride_tricks.sliding_window_view(lengths, _WINDOW)
    sums = (windows.astype(np.float64) ** 2).sum(axis=1) - windows.max(axis=1).astype(np.float64) ** 2
    chosen = np.sort(windows[np.argsort(-sums)[:_WINDOWS]], axis=1)[:, :-1]
    values, which = np.unique(chosen, return_inverse=True)
    operators = _operators(loop, places(loop)[:_PLACES_OF_BLOCKS], values)
    means = operators[:, which.reshape(chosen.shape)].mean(axis=2)
    return bool((log_radius(means).mean(axis=0) >= 0.0).any())


def _operators(loop: LinearLoop, steps: NDArray[np.int64], values: Lengths) -> Floats:
    """X -> M_L X M_L' at each place of the lap, for each length: shape (places, lengths, n, n)."""
    return np.stack([symmetric_operator(interval_maps(loop, np.full(len(values), k), values)) for k in steps])


def _unseen(rng: np.random.Generator) -> Floats:
    """Weight of an interval, or a block, like the worst one observed times 1/U, shape (_SAMPLES,)."""
    return np.asarray(rng.standard_exponential(_SAMPLES) / (1.0 - rng.random(_SAMPLES)))


def _growths(operators: Floats, shares: Floats, weights: Floats, spans: Floats, block: int) -> IntervalGrowth:
    """From operators of what was observed and, last, of what was not, shape (places, n + 1, s, s).

    `shares` and `spans` [steps], of shape (n,), are those observed; `weights`, (samples, n + 1), are not normalised.
    """
    points, count, size, _ = operators.shape
    flat = operators.reshape(points, count, size * size)
    total = weights[:, :-1].sum(axis=1, keepdims=True)  # the unseen one adds, as a further one would
    drawn = ((weights / total) @ flat).reshape(points, -1, size, size)
    samples = (log_radius(drawn) / ((weights[:, :-1] / total) @ spans)).mean(axis=0)
    observed = shares @ flat[:, :-1]
    mean = float(shares @ spans)
    at_once = log_radius(observed.reshape(points, size, size)).mean() / mean
    growth = float(np.mean([_tilted(flat[j, :-1], shares, spans) for j in range(points)]))
    scale = growth / at_once if np.isfinite(growth) and at_once != 0.0 and growth * at_once > 0.0 else 1.0
    return IntervalGrowth(growth, samples * scale, block)


def _tilted(flat: Floats, shares: Floats, spans: Floats) -> float:
    """Growth g per step at one place, where the spectral radius of E[exp(-g L) M_L (x) M_L] is 1.

    It falls with g. False position (Illinois) from a first step away from 0 that is doubled until it is too long.
    """
    size = math.isqrt(flat.shape[1])

    def log_at(g: float) -> float:
        tilts = shares * np.exp(np.clip(-g * spans, -700.0, 700.0))
        return float(log_radius((tilts @ flat).reshape(size, size)))

    g, value = 0.0, log_at(0.0)
    if not np.isfinite(value) or value == 0.0:
        return value
    step = math.copysign(min(abs(value) / float(shares @ spans), 1.0 / float(spans.max())), value)
    other = log_at(step)
    while other * value > 0.0 and abs(step) < _STEEPEST:
        g, value, step = step, other, 2.0 * step
        other = log_at(step)
    for _ in range(_TILTS):
        at = (g * other - step * value) / (other - value)
        found = log_at(at)
        if found * value > 0.0:
            g, value, other = at, found, 0.5 * other
        else:
            step, other, value = at, found, 0.5 * value
        if abs(step - g) <= 1e-6 * abs(at):
            break
    return at
