"""Floquet multipliers: what one lap, driven again and again, does to a small error.

The lap is a linear periodic system, so this is the exact answer for its very speeds and its very drops, where the
criteria at frozen speeds are only indications. Growths are given as natural logarithms, because a lap of 20 000 steps
shrinks errors by hundreds of powers of ten. The loop is stable if the largest one is below 0.

- `constant_delay`: the pose is n steps old at every step (the lifted system of dimension m + q n, never formed), held
  or moved on by the plant's model;
- `drop_sequence`: the sequence of losses is given, one verdict a step; between receptions it is held, or predicted;

A predictor behind a constant delay. It moves C z(k-n) on under the commands that it sent, so with the innovations
nu(j) = E_z z(j) + E_h h(j), what a step of the plant does and the model does not know (`LinearLoop.innovation`),

    h(k) = C z(k) - S(k),    S(k) = nu(k-1) + P_h(k-1) nu(k-2) + ... + P_h(k-1) ... P_h(k-n+1) nu(k-n)

z and the last n innovations are the state of the loop. The recursion h(k+1) = P_h h + P_u u + P_h(k) ... P_h(k-n+1)
nu(k-n) says the same but holds the modes of the model itself as well, which stay forever and hide those of the loop.
So S is summed anew: a sliding window as two stacks (the older part summed from its end, the younger from its
beginning), which costs the same for every n.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import compiled
from agv_analysis.run import Floats
from agv_analysis.stability.first_border import last_stable
from agv_analysis.stability.kanayama_delay import critical_delay_across, critical_delay_along, spectral_radius
from agv_analysis.stability.linear_loop import MARGINAL, LinearLoop
from agv_analysis.stability.products import assign, divide, growths, largest_entry, multiply
from agv_analysis.stability.reception_maps import reception_maps

_COLUMNS = 4
"""Directions followed at once, more than a complex pair of multipliers needs."""

_LAPS = 40

_LAPS_OF_DELAY = 5
"""A lap shorter than so many times the delay is driven several times before the subspace is looked at again."""

_STEPS = 1000
"""Of a loop that is the same at every step so many are driven at least."""

_SETTLED, _ROUGHLY = 1e-10, 1e-2
"""Change of a growth from one lap to the next, relative where it is above 1, at which it has settled; and where its
sign alone is asked for."""

_DOUBTFUL = 1.0
"""Growth over a lap below which a roughly settled one does not tell the sign."""

_PLAIN = -30.0
"""Logarithm of what a lap leaves of random directions at which it contracts: the share that they have in what grows
most is of the order of one over the square root of their size, and not of a rounding error."""


def constant_delay(loop: LinearLoop, n: int, settled: float = _SETTLED) -> float:
    """Largest growth (logarithm) over a lap of the error, if the pose is always `n` steps old.

    By iterating a subspace of the lifted system over laps until its largest Ritz value settles; roughly, a bound on it
    may do.
    """
    n = 0 if loop.is_exact else n
    is_held = not loop.predicts or loop.is_exact
    if is_held and loop.closed_form is not None and loop.is_constant:
        v, w = float(loop.v_r[0]), float(loop.w_r[0])
        return loop.steps * math.log(spectral_radius(n, v, w, loop.closed_form, loop.ts))
    least = _LAPS_OF_DELAY * (n + 1)
    steps = max(least, _STEPS) if loop.is_constant else math.ceil(least / loop.steps) * loop.steps
    size, q = loop.size, loop.outputs
    columns = min(_COLUMNS, size + q * n)
    state = np.random.default_rng(0).standard_normal((size + q * n, columns))
    drive, growth = _drive(loop, is_held, steps), math.nan
    for _ in range(_LAPS):
        basis, _ = np.linalg.qr(state)
        z, past = basis[:size].copy(), basis[size:].reshape(n, q, columns).copy()
        log_scale = drive(z, past)
        state = np.concatenate((z, past.reshape(-1, columns)))
        left = float(np.linalg.norm(state))
        if settled == _ROUGHLY and (left == 0.0 or log_scale + math.log(left) < _PLAIN):
            growth = log_scale + math.log(left) if left > 0.0 else -math.inf
            break
        ritz = np.abs(np.linalg.eigvals(basis.T @ state)).max()
        before, growth = growth, log_scale + math.log(ritz) if ritz > 0.0 else -math.inf
        if growth == before or abs(growth - before) <= settled * max(1.0, abs(growth)):
            break
    return growth * (loop.steps / steps)


def _drive(loop: LinearLoop, is_held: bool, steps: int) -> Callable[[Floats, Floats], float]:
    """Sends z, shape (m, columns), and what is kept of the last n steps, (n, q, columns), through so many steps.

    Oldest first; in place, to be multiplied by exp(what it returns).
    """
    if is_held or loop.innovation is None or loop.P_h is None:
        return lambda z, past: float(compiled(_drive_held)(loop.F, loop.G, steps, z, past))
    matrices = (loop.F, loop.G, np.ascontiguousarray(loop.P_h), *loop.innovation)
    return lambda z, past: float(compiled(_drive_predicted)(*matrices, steps, z, past))


def _drive_held(F: Floats, G: Floats, steps: int, z: Floats, past: Floats) -> float:
    """As `_drive` says, of a loop whose pose is held; `past` has the errors h(k-n) .. h(k-1)."""
    (n, q, columns), m = past.shape, z.shape[0]
    ring, fresh = np.empty((n + 1, q, columns)), np.empty_like(z)
    for i in range(n):
        assign(past[i], ring[i])
    assign(z, ring[n])
    log_scale, oldest = 0.0, 0
    for k in range(steps):
        row = k % F.shape[0]
        largest = 0.0
        for i in range(m):
            for j in range(columns):
                value = 0.0
                for p in range(m):
                    value += F[row, i, p] * z[p, j]
                for p in range(q):
                    value += G[row, i, p] * ring[oldest, p, j]
                fresh[i, j] = value
                largest = max(largest, abs(value))
        assign(fresh, z)
        assign(fresh, ring[oldest])
        oldest = oldest + 1 if oldest < n else 0
        if largest > 1e100 or 0.0 < largest < 1e-100:
            divide(z, largest)
            for i in range(n + 1):
                divide(ring[i], largest)
            log_scale += math.log(largest)
    for i in range(n):
        assign(ring[(oldest + i) % (n + 1)], past[i])
    return log_scale


def _drive_predicted(
    F: Floats, G: Floats, P: Floats, E_z: Floats, E_h: Floats, steps: int, z: Floats, past: Floats
) -> float:
    """As `_drive` says, behind a predictor; `past` has the innovations nu(k-n) .. nu(k-1).

    With b the step at which the older part of the window ends: S(k) = P(k-1) .. P(b) older(k-n) + younger.
    """
    (n, q, columns), rows = past.shape, F.shape[0]
    older, younger, S, h = (
        np.zeros((n + 1, q, columns)),
        np.zeros((q, columns)),
        np.zeros((q, columns)),
        np.zeros((q, columns)),
    )
    identity, nothing = np.eye(q), np.zeros((q, columns))
    since, product, fresh = np.eye(q), np.eye(q), np.empty_like(z)
    log_scale, at = 0.0, n
    for k in range(steps):
        of_innovation = 0.0
        if n > 0:
            if at == n or k == 0:  # all that is in the window is in `past`, in order
                at = 0
                assign(nothing, younger)
                assign(identity, since)
                for i in range(n - 1, -1, -1):
                    assign(older[i + 1], older[i])
                    multiply(since, past[i], False, older[i], True)
                    multiply(since, P[(k - n + i) % rows], False, product, False)
                    assign(product, since)
                assign(identity, since)
            assign(younger, S)
            multiply(since, older[at], False, S, True)
        for i in range(q):
            for j in range(columns):
                h[i, j] = z[i, j] - S[i, j]
        row = k % rows
        multiply(F[row], z, False, fresh, False)
        multiply(G[row], h, False, fresh, True)
        if n > 0:
            nu = past[at]
            multiply(E_z[row], z, False, nu, False)
            multiply(E_h[row], h, False, nu, True)
            multiply(P[row], younger, False, S, False)
            for i in range(q):
                for j in range(columns):
                    younger[i, j] = S[i, j] + nu[i, j]
            multiply(P[row], since, False, product, False)
            assign(product, since)
            of_innovation = largest_entry(nu)
            at += 1
        assign(fresh, z)
        largest = max(largest_entry(fresh), of_innovation)  # while a limit is active z does not grow with them
        if largest > 1e100 or 0.0 < largest < 1e-100:
            divide(z, largest)
            divide(younger, largest)
            for i in range(n):
                divide(past[i], largest)
            for i in range(n + 1):
                divide(older[i], largest)
            log_scale += math.log(largest)
    at %= max(1, n)
    for i in range(n):
        assign(past[(at + i) % n], older[i])
    for i in range(n):
        assign(older[i], past[i])
    return log_scale


def is_stable_with_delay(loop: LinearLoop, n: int) -> bool:
    """Does a lap contract every small error if the pose is always `n` steps old?"""
    rough = constant_delay(loop, n, _ROUGHLY)
    growth = rough if abs(rough) > _DOUBTFUL else constant_delay(loop, n)
    return growth < MARGINAL * loop.steps


def largest_constant_delay(loop: LinearLoop, limit: int = 10_000) -> int | None:
    """Largest n up to which every constant delay lets the lap contract; -1: not even 0, None: all up to `limit` do.

    The closed forms for a straight track at the mean speed say where to look, if there are any. Longer delays may be
    stable again, see `first_border.stable_again`.
    """
    guess = 0.0
    if not loop.predicts and loop.along_gain is not None:
        guess = min(critical_delay_along(loop.along_gain), limit)
        if loop.closed_form is not None:
            mean = float(np.abs(loop.v_r).mean())
            guess = min(guess, critical_delay_across(mean, loop.closed_form, loop.ts))
    return last_stable(functools.cache(lambda n: is_stable_with_delay(loop, n)), guess, limit)


def drop_sequence(loop: LinearLoop, lost: NDArray[np.bool_], count: int | None = None) -> Floats:
    """Growths (logarithms) over a lap of the directions of the state, largest first, shape (m,), or only the largest.

    `lost` of shape (N,) says which updates were lost; lap and sequence are taken as if driven again and again. 0 for
    each direction if no update was ever received: an open loop.
    """
    received = np.flatnonzero(~lost)
    if not len(received):
        return np.zeros(count or loop.size)
    return growths(reception_maps(loop, received, received[0] + len(lost)), count)
