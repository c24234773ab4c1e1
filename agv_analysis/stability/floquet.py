"""Floquet multipliers: what one lap, driven again and again, does to a small error.

The lap is a linear periodic system, so this is the exact answer for its very speeds and its very drops, where the
criteria at frozen speeds are only indications. Growths are given as natural logarithms, because a lap of 20 000 steps
shrinks errors by hundreds of powers of ten. The loop is stable if the largest one is below 0.

- `constant_delay`: the pose is n steps old at every step (the lifted system of dimension 3 (n+1), never formed), held
  or moved on by the plant's model;
- `drop_sequence`: the sequence of losses is given, one verdict a step; between receptions it is held, or predicted;
- `trajectory`: the same about the motion that was really driven, which may be far from the reference.

Where the AGV does not move on the whole lap, only the errors that it can reach count (see `linearisation.reachable`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled import compiled
from agv_analysis.run import Floats
from agv_analysis.stability.lifted import critical_delay_across, critical_delay_along, spectral_radius
from agv_analysis.stability.linearisation import (
    HELD,
    MARGINAL,
    Edge,
    is_constant,
    loop_jacobians,
    reachable,
    reception_maps,
    seen,
    step_matrices,
)
from agv_analysis.stability.products import growths
from agv_cloud.parameters import ControllerParameters

_COLUMNS = 4
"""Directions followed at once, more than a complex pair of multipliers needs."""

_LAPS = 40

_LAPS_OF_DELAY = 5
"""A lap shorter than so many times the delay is driven several times before the subspace is looked at again."""


def constant_delay(
    n: int, v_r: Floats, w_r: Floats, gains: ControllerParameters, ts: float, edge: Edge = HELD
) -> float:
    """Largest growth (logarithm) over a lap of the error, if the pose is always `n` steps old.

    Speeds v_r [m/s], w_r [rad/s] of shape (N,). By iterating a subspace of the lifted system over laps until its
    largest Ritz value settles.
    """
    if not edge.predicts:
        gains = edge.felt(gains)
        if is_constant(v_r, w_r):
            return len(v_r) * math.log(spectral_radius(n, float(v_r[0]), float(w_r[0]), gains, ts))
    size = reachable(v_r, w_r)
    F, G = (np.ascontiguousarray(M[:, :size, :size]) for M in step_matrices(v_r, w_r, gains, ts))
    if edge.predicts:
        F, G = predicted_delay(n, F, G, edge.delta)
    laps = math.ceil(_LAPS_OF_DELAY * (n + 1) / len(v_r))
    if laps > 1:
        F, G = np.tile(F, (laps, 1, 1)), np.tile(G, (laps, 1, 1))
    columns = min(_COLUMNS, size * (n + 1))
    window = np.random.default_rng(0).standard_normal((n + 1, size, columns))
    growth = math.nan
    for _ in range(_LAPS):
        basis, _ = np.linalg.qr(window.reshape(-1, columns))
        window = basis.reshape(window.shape).copy()
        log_scale = compiled(_drive_lap)(F, G, window)
        ritz = np.abs(np.linalg.eigvals(basis.T @ window.reshape(-1, columns))).max()
        before, growth = growth, log_scale + math.log(ritz) if ritz > 0.0 else -math.inf
        if growth == before or abs(growth - before) <= 1e-10 * max(1.0, abs(growth)):
            break
    return growth / laps


def predicted_delay(n: int, F: Floats, G: Floats, delta: float) -> tuple[Floats, Floats]:
    """F' and G' of h(k+1) = F'(k) h(k) + G'(k) h(k-n): the predicted error h, if the pose is always `n` steps old.

    The edge moves the pose on under the commands that it sent, which it computed from earlier predictions. What it does
    not know is the plant's share D = G_true - G of them: h(k) = e(k) - sum_{j=k-n}^{k-1} F(k-1) ... F(j+1) D(j) h(j).
    Together with e(k+1) = F(k) e(k) + (G + D)(k) h(k) the sum telescopes to

        h(k+1) = (F + G)(k) h(k) + F(k) ... F(k-n+1) D(k-n) h(k-n)

    so an exact model leaves the loop without outages, and along a straight track, where F = 1 and D = -a delta, every
    delay is survived as long as |delta| < 1 and a <= 1. Rows of F and G, shape (N, m, m), are the steps of a lap.
    """
    steps = np.arange(len(F))
    unknown = delta * G[(steps - n) % len(F), :, 0]
    for i in range(n):
        unknown = np.einsum("kij,kj->ki", F[(steps - n + 1 + i) % len(F)], unknown)
    delayed = np.zeros_like(G)
    delayed[:, :, 0] = unknown
    return F + G, delayed


def largest_constant_delay(
    v_r: Floats, w_r: Floats, gains: ControllerParameters, ts: float, limit: int = 10_000, edge: Edge = HELD
) -> int | None:
    """Largest constant n for which the lap contracts the error; -1 if not even 0 does, None if all up to `limit` do.

    Arguments as of `constant_delay`. The closed forms for a straight track at the mean speed say where to look.
    """

    def contracts(n: int) -> bool:
        return constant_delay(n, v_r, w_r, gains, ts, edge) < MARGINAL * len(v_r)

    mean, a = float(np.abs(v_r).mean()), ts * edge.felt(gains).kx
    guess = 0.0 if edge.predicts else min(critical_delay_along(a), critical_delay_across(mean, gains, ts), limit)
    stable, step = math.ceil(guess) - 1, 1
    while stable >= 0 and not contracts(stable):
        stable, step = max(-1, stable - step), 2 * step
    unstable, step = stable + 1, 1
    while unstable <= limit and contracts(unstable):
        stable, unstable, step = unstable, unstable + step, 2 * step
    if unstable > limit:
        return None
    while unstable - stable > 1:
        middle = (stable + unstable) // 2
        stable, unstable = (middle, unstable) if contracts(middle) else (stable, middle)
    return stable


def _drive_lap(F: Floats, G: Floats, window: Floats) -> float:
    """Send the last n + 1 errors, shape (n + 1, m, columns), oldest first, through a lap; in place.

    What is left in `window` is to be multiplied by exp(return value).
    """
    length, size, columns = window.shape
    log_scale, oldest = 0.0, 0
    fresh = np.empty((size, columns))
    for k in range(F.shape[0]):
        newest = oldest - 1 if oldest > 0 else length - 1
        largest = 0.0
        for i in range(size):
            for j in range(columns):
                value = 0.0
                for m in range(size):
                    value += F[k, i, m] * window[newest, m, j] + G[k, i, m] * window[oldest, m, j]
                fresh[i, j] = value
                largest = max(largest, abs(value))
        window[oldest] = fresh
        oldest = oldest + 1 if oldest + 1 < length else 0
        if largest > 1e100 or 0.0 < largest < 1e-100:
            window /= largest
            log_scale += math.log(largest)
    window[:] = np.concatenate((window[oldest:], window[:oldest]))
    return log_scale


def drop_sequence(
    lost: NDArray[np.bool_], v_r: Floats, w_r: Floats, gains: ControllerParameters, ts: float, edge: Edge = HELD
) -> Floats:
    """Growths (logarithms) over the recorded steps of the three directions of the error, largest first, shape (m,).

    `lost` of shape (N,) says which updates were lost at the steps whose speeds are v_r [m/s], w_r [rad/s]; the sequence
    is taken as if driven again and again. 0 for each direction if no update was ever received: an open loop.
    """
    size = reachable(v_r, w_r)
    received = np.flatnonzero(~lost)
    if not len(received):
        return np.zeros(size)
    F, G = (M[:, :size, :size] for M in step_matrices(v_r, w_r, gains, ts))
    G, H = seen(F, G, edge)
    return growths(reception_maps(F, G, received, received[0] + len(lost), H))


def trajectory(
    pose: Floats,
    reference: Floats,
    lost: NDArray[np.bool_],
    gains: ControllerParameters,
    ts: float,
    align: bool = False,
) -> Floats:
    """As `drop_sequence`, linearised about the motion that was driven instead of about the reference.

    X_c(k) of shape (N, 3), X_r(k) and its speeds of shape (N, 5), frame `map`; the policy is `hold` or, with `align`,
    that. The growths are those of a displacement of the whole run, in [m, m, rad] of the map.
    """
    age = np.arange(len(lost)) - np.maximum.accumulate(np.where(lost, 0, np.arange(len(lost))))
    taken = np.arange(len(lost)) - age
    if align:
        reference = np.hstack((reference[taken, :3], reference[:, 3:]))
    now, outdated = loop_jacobians(pose, pose[taken], reference, gains, ts)
    return growths(reception_maps(now, outdated, np.flatnonzero(age == 0), len(lost)))
