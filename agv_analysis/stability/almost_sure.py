"""Almost surely: does the error die out in every run but a set of probability 0?

That is the case if the top Lyapunov exponent of the product of the maps between receptions is negative. It is a
weaker demand than mean square: rare long outages may let E[|e|^2] grow while every single run converges.

Along a straight track the maps are the numbers 1 - a L, a = T_s K_x, so the exponent is E[log|1 - a L|] / E[L], exact
for any channel. It is degenerate where 1/a is an integer: a burst of L = 1/a brings the error to 0 at one stroke, and
the exponent is -inf whatever else happens, a property that no real plant has. Across the track, and on curves, the
exponents come from products of the maps along a long random sequence of losses with orthogonalisation after each
reception (Furstenberg and Kesten, Ann. Math. Stat. 31, 1960; Benettin et al., Meccanica 15, 1980).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import compiled
from agv_analysis.link.markov_channel import Chain, bernoulli
from agv_analysis.run import Floats
from agv_analysis.stability.first_border import borders, crossing
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.products import orthogonalised_pass
from agv_analysis.stability.reception_maps import reception_maps
from agv_plant.random_stream import uniforms

STEPS = 400_000
"""Length of the random sequence: its exponents are good to about 1 %."""

TOLERANCE = 0.01
"""Relative tolerance of the gain over which the exponent along a straight track is averaged."""

_BATCHES = 20


class Exponents(NamedTuple):
    """Lyapunov exponents per step, largest first, and their standard errors; each of shape (m,)."""

    values: Floats
    errors: Floats


def exponents(loop: LinearLoop, chain: Chain, steps: int = STEPS, seed: int = 1) -> Exponents:
    """Lyapunov exponents of laps driven again and again, from `steps` steps of losses.

    The standard errors are those of the means of 20 parts of the sequence. Zero without any reception: an open loop.
    """
    size = loop.size
    received = np.flatnonzero(~sample_losses(chain, steps, seed))
    if len(received) <= _BATCHES:
        return Exponents(np.zeros(size), np.full(size, math.inf))
    maps = reception_maps(loop, received, steps)
    parts = np.array_split(np.arange(len(maps)), _BATCHES)
    lengths = np.diff(np.append(received[[part[0] for part in parts]], steps))
    basis = np.eye(size)
    orthogonalised_pass(maps, basis)  # aligns the directions
    logs = np.array([orthogonalised_pass(maps[part], basis) for part in parts])
    values = logs.sum(axis=0) / lengths.sum()
    with np.errstate(invalid="ignore"):
        scatter = logs - lengths[:, None] * values
        errors = np.sqrt(_BATCHES / (_BATCHES - 1.0) * (scatter**2).sum(axis=0)) / lengths.sum()
    order = np.argsort(values)[::-1]
    return Exponents(values[order], np.nan_to_num(errors[order], nan=0.0))


def sample_losses(chain: Chain, steps: int, seed: int) -> NDArray[np.bool_]:
    """A random sequence of losses of a chain that starts in its stationary distribution, shape (steps,)."""
    lost = np.zeros(steps, dtype=np.bool_)
    random = uniforms(seed, "almost_sure", 0, steps)
    compiled(_sample)(np.cumsum(chain.transition, axis=1), chain.delivery, np.cumsum(chain.stationary), random, lost)
    return lost


def _sample(transition: Floats, delivery: Floats, stationary: Floats, random: Floats, lost: NDArray[np.bool_]) -> None:
    state = _pick(stationary, random[0, 2])
    for k in range(len(lost)):
        lost[k] = random[k, 0] >= delivery[state]
        state = _pick(transition[state], random[k, 1])


def _pick(cumulated: Floats, u: float) -> int:
    state = 0
    while state < len(cumulated) - 1 and u >= cumulated[state]:
        state += 1
    return state


def exponent_along(a: float, chain: Chain) -> float:
    """Exponent per step of the error along a straight track: E[log|1 - a L|] / E[L], a = T_s K_x; may be -inf."""
    probabilities = chain.burst_lengths()
    lengths = np.arange(1, len(probabilities) + 1)
    factors = np.abs(1.0 - a * lengths)
    reached = probabilities > 0.0
    if np.any(reached & (factors < 1e-12 * lengths)):
        return -math.inf
    logs = probabilities[reached] @ np.log(factors[reached])
    return float(logs / (probabilities @ lengths))


def is_degenerate(a: float) -> bool:
    """Is 1/a an integer, so that some burst length brings the error along the track to 0 at one stroke?"""
    return a > 0.0 and abs(1.0 / a - round(1.0 / a)) < 1e-9 / a


def critical_loss_along(a: float) -> float | None:
    """Smallest loss probability at which the exponent along a straight track reaches 0, independent losses.

    -1 if it is not negative even without losses, None where it is degenerate or never reaches 0.
    """
    if is_degenerate(a):
        return None
    if not 0.0 < a < 2.0:
        return -1.0
    grid = 1.0 - np.logspace(0.0, -3.0, 61)
    for below, above in zip(grid[:-1].tolist(), grid[1:].tolist(), strict=True):
        if exponent_along(a, bernoulli(above)) >= 0.0:
            return crossing(lambda p: exponent_along(a, bernoulli(p)), below, above)
    return None


def mean_log(a: float, lengths: NDArray[np.int64], tolerance: float) -> Floats:
    """Mean of log|1 - x L| over x within a relative tolerance of a, by the antiderivative u log|u| - u of log|u|."""
    low = np.asarray(1.0 - a * (1.0 + tolerance) * lengths)
    high = np.asarray(1.0 - a * (1.0 - tolerance) * lengths)
    return np.asarray((_antiderivative(high) - _antiderivative(low)) / (high - low))


def _antiderivative(u: Floats) -> Floats:
    return np.asarray(u * np.log(np.abs(u), where=u != 0.0, out=np.zeros_like(u)) - u)


def averaged_exponent_along(a: float, chain: Chain, tolerance: float = TOLERANCE) -> float:
    """As `exponent_along`, averaged over gains within a relative tolerance; finite, 1/a integer or not."""
    probabilities = chain.burst_lengths()
    lengths = np.arange(1, len(probabilities) + 1)
    return float(probabilities @ mean_log(a, lengths, tolerance) / (probabilities @ lengths))


def averaged_critical_loss_along(a: float, tolerance: float = TOLERANCE) -> float | None:
    """As `critical_loss_along` by the averaged exponent; None if that stays negative up to 0.999."""
    if not 0.0 < a < 2.0:
        return -1.0

    def exponent(p: float) -> float:
        return averaged_exponent_along(a, bernoulli(p), tolerance)

    found = borders(exponent, (1.0 - np.logspace(0.0, -3.0, 31)).tolist())
    if not found:
        return None
    return float(found[0]) or -1.0


def critical_loss(loop: LinearLoop, seed: int = 1) -> float | None:
    """Smallest loss probability at which the top exponent of a lap reaches 0, independent losses.

    -1 if it is not negative even without losses, None if it stays negative up to 0.999. Where the closed form holds,
    along and across a straight track are two loops; the former is averaged over gains within TOLERANCE, since the
    exponent of one gain alone may be -inf, and exact. Others are simulated, good to about 0.002.
    There the little that a curve turns of one error into the other matters: near the border the error along the track
    makes such excursions that the loop diverges before the exponent along alone reaches 0.
    """
    if loop.closed_form is None or loop.predicts or np.any(loop.w_r != 0.0):
        return _simulated_critical_loss(loop, seed)
    found = [averaged_critical_loss_along(loop.ts * loop.closed_form.kx)]
    if loop.size > 1:
        found.append(_simulated_critical_loss(loop.without_along(), seed))
    return min((p for p in found if p is not None), default=None)


def _simulated_critical_loss(loop: LinearLoop, seed: int) -> float | None:
    """The first on a grid, then by bisection of the logarithm of the delivery rate; with the same random numbers."""

    def is_stable(delivery: float) -> bool:
        return bool(exponents(loop, bernoulli(1.0 - delivery), STEPS, seed).values[0] < 0.0)

    tried: list[float] = np.logspace(0.0, -3.0, 13).tolist()
    first = next((i for i, delivery in enumerate(tried) if not is_stable(delivery)), None)
    if first is None:
        return None
    if first == 0:
        return -1.0
    high, low = tried[first - 1], tried[first]
    while high - low > 1e-3 * min(high, 1.0 - low + 1e-3):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if is_stable(middle) else (middle, high)
    return 1.0 - high
