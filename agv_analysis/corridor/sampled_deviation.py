"""RMS deviation near the border of stability, by importance sampling of the nonlinear loop.

There the square of the deviation has no variance: what makes its mean are outages that no run of a sensible length
shows, and these lead so far off a curved track that its loop is not the linear one. So the intervals L between
receptions are drawn from other distributions than their own, P, and each run weighs as much as it is more likely under
the channel. Along a straight track an interval takes an error x to m x + b, with m = 1 - a L and b what disturbs it. In
an excursion that begins with the k-th interval of a run the drawn ones are P b^2 for the k-th and P m^2 for those after
it; k is drawn, too, and the weight is that of the mixture of all k, and of no excursion at all, so that it has a bound.
The deviation is that of the whole loop over the last interval. Everything but `sampled_deviation` runs as plain Python
and compiled.

Source: Veach and Guibas, Optimally Combining Sampling Techniques, SIGGRAPH 1995 (the balance heuristic).
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from agv_analysis.compiled.functions import numbers
from agv_analysis.corridor.excursions import loss_free
from agv_analysis.corridor.lap_loop import LapLoop
from agv_analysis.corridor.rare_leaving import draw_normals
from agv_analysis.corridor.widths import deviation
from agv_analysis.link.channel_fit import Estimate
from agv_analysis.link.markov_channel import Chain
from agv_analysis.run import Floats
from agv_analysis.simulation.batch import cores
from agv_analysis.simulation.loop import Rows, RunInputs, compared_reference, goes_on, reference_at, slot
from agv_analysis.simulation.parts import replacements_of, run_parts
from agv_plant.random_stream import DRAWS

_RUNS = 40_000

_PARTS = 2
"""Of the runs, with random numbers of their own; as many on every machine, so that equal seeds give equal numbers."""

_NO_EXCURSION = 0.15
"""Share of the runs that are drawn from the channel itself."""

_FORGOTTEN, _MOST_INTERVALS = 1e-3, 500
"""Share of the mean square of an error that is left after the intervals of a run, and the most that a run may have."""

_SLOTS = 100_000
"""Slots that a run may last."""

_RAREST = 1e-40
"""Probability of longer intervals that are left out."""


class Draws(NamedTuple):
    """How the intervals of a run are drawn: rows are P, the k-th, later ones, and the k-th where that is the last."""

    cumulative: Floats
    """Of the lengths 1, 2, .., shape (4, longest)."""
    logs: Floats
    """Logarithms of the ratios to P, same shape."""
    first: Floats
    """Share of the runs whose excursion begins with the k-th interval, and of those without, shape (intervals + 1,)."""
    mean: float
    """E[L] under P [slots]."""


def sampled_deviation(loop: LapLoop, chain: Chain, a: float, drift: float) -> Estimate | None:
    """Stationary RMS distance from the reference [m], with its 95 % interval.

    `a`, `drift`: of the error along a straight track, T_s K_x and what a held pose adds to it in a step [m]. None where
    the intervals between receptions depend on each other, errors take too long to die out, or the loop diverges.
    """
    plant = loop.scenario.plant
    intervals = intervals_of(chain)
    draws = None if intervals is None else _draws(intervals, a, drift, plant.noise_xy)
    if draws is None or plant.slip_noise > 0.0:
        return None
    reference, found = numbers(loop.reference(2 * loop.steps + _SLOTS + 1)), np.zeros((_RUNS, 2))
    inputs = loop.inputs(np.zeros(1, dtype=np.bool_))

    def drive(part: int, rows: Floats) -> None:
        random = inputs._replace(
            lost=np.zeros(1, dtype=np.bool_), noise=np.zeros((1, DRAWS)) if plant.is_noisy else None
        )
        rng = np.random.default_rng([loop.scenario.relay.seed, part])
        run_parts(drive_runs, replacements_of(loop.scenario), reference, inputs, random, draws, loop.steps, rng, rows)

    with ThreadPoolExecutor(cores()) as pool:
        list(pool.map(drive, range(_PARTS), np.array_split(found, _PARTS)))
    squares = found.sum(axis=1) / draws.mean
    mean, half = float(squares.mean()), 1.96 * float(squares.std()) / math.sqrt(_RUNS)
    if not math.isfinite(mean) or mean <= half:
        return None
    return Estimate(math.sqrt(mean), math.sqrt(mean - half), math.sqrt(mean + half))


def intervals_of(chain: Chain) -> Floats | None:
    """P of the slots from a reception to the next, 1, 2, ..; None where they depend on each other, or have no end."""
    receiving = np.flatnonzero(chain.delivery)
    if len(receiving) != 1:  # the state after a reception would not be known
        return None
    state = chain.transition[receiving[0]]
    found: list[float] = []
    while state.sum() > _RAREST and len(found) < _SLOTS:
        found.append(float(state @ chain.delivery))
        state = (state * (1.0 - chain.delivery)) @ chain.transition
    P = np.array(found)
    return P / P.sum() if len(found) < _SLOTS else None


def _draws(P: Floats, a: float, drift: float, noise: float) -> Draws | None:
    L = np.arange(1, len(P) + 1)

    def disturbed(L: Any) -> Floats:
        """Mean square of b of an interval."""
        return np.asarray((0.5 * drift * a * L * (L - 1)) ** 2 + (noise * a * L) ** 2)

    least = 1e-3 * (drift**2 + noise**2)
    weights = np.stack((np.ones(len(L)), disturbed(L) + least, (1.0 - a * L) ** 2, np.cumsum(disturbed(L - 1)) + least))
    means = weights @ P
    if least == 0.0 or not means[2] < 1.0:
        return None
    intervals = math.ceil(math.log(_FORGOTTEN) / math.log(means[2]))
    if intervals > _MOST_INTERVALS:
        return None
    with np.errstate(divide="ignore"):
        logs = np.log(weights / means[:, None])
    share = means[2] ** np.arange(intervals - 1, -1, -1.0)
    share = np.append((1.0 - _NO_EXCURSION) * share / share.sum(), _NO_EXCURSION)
    return Draws(np.cumsum(weights * P / means[:, None], axis=1), logs, share, float(P @ L))


def drive_runs(
    reference: Rows, quiet: RunInputs, inputs: RunInputs, draws: Draws, lap: int, rng: Any, found: Floats
) -> None:
    """Drive the runs, which begin everywhere on a lap, on its loss-free motion, that of `quiet`.

    `found`, shape (runs, 2): weighed sum of the squared deviation along and across over the last interval [m^2]; NaN of
    a run that lasts too long, inf of one that diverges.
    """
    base, count, at = quiet.start, len(draws.first) - 1, 0
    upto, lengths = np.cumsum(draws.first), np.empty(len(draws.first) - 1, dtype=np.int64)
    for s in range(len(found)):
        while at < lap + s * lap // len(found):
            base = loss_free(base, reference, at, quiet)
            at += 1
        first, slots = np.searchsorted(upto, rng.random()), 0
        for j in range(count):
            row = 0 if j < first else (2 if j > first else (3 if j == count - 1 else 1))
            length = min(np.searchsorted(draws.cumulative[row], rng.random()), draws.cumulative.shape[1] - 1) + 1
            lengths[j], slots = length, slots + length
        weight, after = draws.first[count], 0.0
        for k in range(count - 1, -1, -1):
            row = 3 if k == count - 1 else 1
            weight += draws.first[k] * math.exp(draws.logs[row, lengths[k] - 1] + after)
            after += draws.logs[2, lengths[k] - 1]
        if slots > len(reference) - 1 - 2 * lap:
            found[s, 0] = math.nan
            continue
        run, k = base, at
        for j in range(count):
            for i in range(lengths[j]):
                now = reference_at(reference, k)
                if j == count - 1:
                    along, across, _ = deviation(run.motion, now)
                    found[s, 0] += along * along / weight
                    found[s, 1] += across * across / weight
                inputs.lost[0] = i > 0
                draw_normals(inputs.noise, rng)
                run, sent = slot(run, compared_reference(now, reference, k, inputs.settings.ahead), inputs, 0)
                k += 1
                if not goes_on(run, sent):
                    found[s, 0] = math.inf
                    break
            if found[s, 0] == math.inf:
                break
