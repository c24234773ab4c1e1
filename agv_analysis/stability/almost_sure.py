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

from agv_analysis.compiled import compiled
from agv_analysis.link.markov_channel import Chain, bernoulli
from agv_analysis.run import Floats
from agv_analysis.stability.linearisation import HELD, Edge, reachable, reception_maps, seen, step_matrices
from agv_analysis.stability.mean_square import crossing
from agv_analysis.stability.products import orthogonalised_pass
from agv_cloud.parameters import ControllerParameters
from agv_plant.random_stream import uniforms

STEPS = 400_000
"""Length of the random sequence: its exponents are good to about 1 %."""

_BATCHES = 20


class Exponents(NamedTuple):
    """Lyapunov exponents per step, largest first, and their standard errors; each of shape (m,)."""

    values: Floats
    errors: Floats


def exponents(
    v_r: Floats, w_r: Floats, gains: ControllerParameters, ts: float, chain: Chain, steps: int = STEPS, seed: int = 1,
    edge: Edge = HELD,
) -> Exponents:  # fmt: skip
    """Lyapunov exponents of laps with the speeds v_r [m/s], w_r [rad/s] of shape (N,), from `steps` steps of losses.

    The standard errors are those of the means of 20 parts of the sequence. Zero without any reception: an open loop.
    """
    size = reachable(v_r, w_r)
    F, G = (M[:, :size, :size] for M in step_matrices(v_r, w_r, gains, ts))
    return _exponents(F, G, chain, steps, seed, edge)


def _exponents(F: Floats, G: Floats, chain: Chain, steps: int, seed: int, edge: Edge) -> Exponents:
    size = F.shape[-1]
    received = np.flatnonzero(~sample_losses(chain, steps, seed))
    if len(received) <= _BATCHES:
        return Exponents(np.zeros(size), np.full(size, math.inf))
    G, H = seen(F, G, edge)
    maps = reception_maps(F, G, received, steps, H)
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


def critical_loss(
    v_r: Floats, w_r: Floats, gains: ControllerParameters, ts: float, seed: int = 1, edge: Edge = HELD
) -> float | None:
    """Smallest loss probability at which the top exponent of a lap reaches 0, independent losses.

    -1 if it is not negative even without losses, None if it stays negative up to 0.999. On a straight track along and
    across are two loops and the former is exact; on others it is found by simulation, good to about 0.002. There the
    little that a curve turns of one error into the other matters: near the border the error along the track makes
    such excursions that the loop diverges before the exponent along alone reaches 0.
    """
    F, G = step_matrices(v_r, w_r, gains, ts)
    if np.any(w_r != 0.0) or edge != HELD:
        size = reachable(v_r, w_r)
        return _simulated_critical_loss(F[:, :size, :size], G[:, :size, :size], seed, edge)
    found = [critical_loss_along(ts * gains.kx)]
    if np.any(v_r != 0.0):
        found.append(_simulated_critical_loss(F[:, 1:, 1:], G[:, 1:, 1:], seed, edge))
    return min((p for p in found if p is not None), default=None)


def _simulated_critical_loss(F: Floats, G: Floats, seed: int, edge: Edge) -> float | None:
    """By bisection of the logarithm of the delivery rate; the same random numbers serve every probability."""

    def is_stable(delivery: float) -> bool:
        return bool(_exponents(F, G, bernoulli(1.0 - delivery), STEPS, seed, edge).values[0] < 0.0)

    high, low = 1.0, 1e-3
    if not is_stable(high):
        return -1.0
    if is_stable(low):
        return None
    while high - low > 1e-3 * min(high, 1.0 - low + 1e-3):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if is_stable(middle) else (middle, high)
    return 1.0 - high
