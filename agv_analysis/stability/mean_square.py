"""Mean square: does E[|e|^2] die out under random losses?

With what the edge takes for the error, h, the loop is a Markov jump linear system: xi = (e, h) goes to ((F+G) e, H e)
at a reception and to (F e + G h, H h) at a loss, with H = I where the sample is held (see `linearisation`). With
X_i = E[xi xi'; channel in state i] the second moments obey the linear recursion

    X_j(k+1) = sum_i T_ij [ g_i A_1(k) X_i(k) A_1(k)' + (1 - g_i) A_0(k) X_i(k) A_0(k)' ]

and the loop is mean-square stable if and only if its spectral radius (over a lap: its largest Floquet multiplier) is
below 1. Source: Costa, Fragoso and Marques, Discrete-Time Markov Jump Linear Systems, 2005, theorem 3.9.

Along the track, with a = T_s K_x: for independent bursts E[L^2] / E[L] < 2 / a, that is E[n_ul] < 1/a - 1/2: the mean
age of information plus half a step stays below 1/K_x. Independent losses: p < (2 - a) / (2 + a). Bursts of mean
length B at a loss rate pi: pi B < 1/a - 1/2.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable

import numpy as np

from agv_analysis.compiled import compiled
from agv_analysis.link.markov_channel import Chain, bernoulli, bursty, shortest_mean_burst
from agv_analysis.run import Floats
from agv_analysis.stability.linearisation import HELD, MARGINAL, Edge, is_constant, reachable, seen, step_matrices
from agv_analysis.stability.products import multiply
from agv_cloud.parameters import ControllerParameters

_LAPS = 40

MOST_LOST = 0.9999
"""Largest loss probability that is asked for behind a predictor, which may make any of them harmless."""


def operator(F: Floats, G: Floats, chain: Chain, H: Floats | None = None) -> Floats:
    """Matrix of the recursion at one step's F and G, shape (m, m) each: shape (s, s), s = states * (2 m)^2."""
    size, zero, H = len(F), np.zeros_like(F), np.eye(len(F)) if H is None else H
    received = np.block([[F + G, zero], [H, zero]])
    missed = np.block([[F, G], [zero, H]])
    rows = [
        np.kron(T_i[:, None], g * np.kron(received, received) + (1.0 - g) * np.kron(missed, missed))
        for T_i, g in zip(chain.transition, chain.delivery, strict=True)
    ]
    return np.hstack(rows).reshape(len(rows) * 4 * size * size, -1)


def spectral_radius(F: Floats, G: Floats, chain: Chain, H: Floats | None = None) -> float:
    """Growth of the second moments per step at speeds that do not change; arguments as of `operator`."""
    return float(np.abs(np.linalg.eigvals(operator(F, G, chain, H))).max())


def along_spectral_radius(a: float, chain: Chain) -> float:
    """As `spectral_radius`, of the error along a straight track alone; a = T_s K_x."""
    return spectral_radius(np.ones((1, 1)), np.full((1, 1), -a), chain)


def lap_growth(
    v_r: Floats, w_r: Floats, gains: ControllerParameters, ts: float, chain: Chain, moments: Floats | None = None,
    edge: Edge = HELD,
) -> float:  # fmt: skip
    """Growth (logarithm) of the second moments over a lap with the speeds v_r [m/s], w_r [rad/s] of shape (N,).

    By driving laps until the growth settles; `moments`, shape (3, states, m, m), are those to begin with, and are left
    as they settled, which makes the next call with a similar chain faster.
    """
    size = reachable(v_r, w_r)
    if edge.is_exact and chain.loss_rate < 1.0:  # from the first reception on the edge knows the error
        chain, moments, edge = bernoulli(0.0), None, HELD
    F, G = (np.ascontiguousarray(M[:, :size, :size]) for M in step_matrices(v_r, w_r, gains, ts))
    G, H = seen(F, G, edge)
    if is_constant(v_r, w_r) and len(chain.delivery) <= 8:
        return len(v_r) * math.log(spectral_radius(F[0], G[0], chain, None if H is None else H[0]))
    if H is None:
        H = F[:0]
    if moments is None:
        moments = unit_moments(len(chain.delivery))
    moments = moments[:, :, :size, :size]
    growth = settled_growth(
        moments,
        lambda: float(compiled(_drive_lap)(F, G, H, chain.transition, chain.delivery, moments)),
        lambda: float(np.trace(moments[0] + moments[2], axis1=1, axis2=2).sum()),
    )
    if growth == -math.inf:  # a predictor leaves nothing of the error but rounding
        moments[:] = np.eye(size)
    return growth


def settled_growth(moments: Floats, drive_lap: Callable[[], float], size: Callable[[], float]) -> float:
    """Growth (logarithm) of second moments over a lap, by driving laps until it settles; -inf if nothing is left.

    `drive_lap` sends them through a lap in place, to be multiplied by exp(what it returns); `size` is theirs.
    """
    growth = math.nan
    for _ in range(_LAPS):
        log_scale, size_now = drive_lap(), size()
        if not size_now > 0.0:
            return -math.inf
        # From one lap to the next the moments keep their proportions in the end, so their size says it all.
        moments /= size_now
        before, growth = growth, log_scale + math.log(size_now)
        if abs(growth - before) <= 1e-8 * max(1.0, abs(growth)):
            break
    return growth


def unit_moments(states: int) -> Floats:
    """Moments for `lap_growth` to begin with."""
    return np.array(np.broadcast_to(np.eye(3), (3, states, 3, 3)))


def _drive_lap(F: Floats, G: Floats, H: Floats, T: Floats, g: Floats, moments: Floats) -> float:
    """Send the moments E[e e'], E[e h'], E[h h'] by channel state, shape (3, states, m, m), through a lap; in place.

    H has no row where it is the identity. What is left in them is to be multiplied by exp(return value).
    """
    states, size = moments.shape[1], moments.shape[2]
    log_scale = 0.0
    # Of each state: what goes on if its slot is received, and if it is lost; each as (ee, eh, hh).
    received, missed = np.zeros_like(moments), np.zeros_like(moments)
    upper, M = np.zeros((size, size)), np.zeros((size, size))
    for k in range(F.shape[0]):
        M[:] = F[k] + G[k]
        for i in range(states):
            ee, eh, hh = moments[0, i], moments[1, i], moments[2, i]
            multiply(M, ee, False, received[1, i], False)
            multiply(received[1, i], M, True, received[0, i], False)
            received[2, i] = ee
            multiply(F[k], eh, False, missed[1, i], False)
            multiply(G[k], hh, False, missed[1, i], True)
            multiply(F[k], ee, False, upper, False)
            multiply(G[k], eh, True, upper, True)
            multiply(upper, F[k], True, missed[0, i], False)
            multiply(missed[1, i], G[k], True, missed[0, i], True)
            missed[2, i] = hh
            if len(H):
                for which in (received, missed):
                    multiply(which[1, i], H[k], True, upper, False)
                    which[1, i] = upper
                    multiply(which[2, i], H[k], True, upper, False)
                    multiply(H[k], upper, False, which[2, i], False)
        largest = 0.0
        for j in range(states):
            _mix(T[:, j], g, received, missed, moments[:, j])
            for p in range(size):
                largest = max(largest, moments[0, j, p, p], moments[2, j, p, p])
                for q in range(p):
                    # Rounding makes a skew part, which would not obey the recursion of the moments and outlive them.
                    mean = 0.5 * (moments[0, j, p, q] + moments[0, j, q, p])
                    moments[0, j, p, q], moments[0, j, q, p] = mean, mean
        if largest > 1e100 or 0.0 < largest < 1e-100:
            moments /= largest
            log_scale += math.log(largest)
    return log_scale


def _mix(weights: Floats, g: Floats, received: Floats, missed: Floats, mixed: Floats) -> None:
    """What comes into one state: from each state i with weight T_ij, received with probability g_i or lost."""
    for which in range(3):
        for p in range(mixed.shape[1]):
            for q in range(mixed.shape[1]):
                value = 0.0
                for i in range(len(g)):
                    came = g[i] * received[which, i, p, q] + (1.0 - g[i]) * missed[which, i, p, q]
                    value += weights[i] * came
                mixed[which, p, q] = value


def critical_loss(v_r: Floats, w_r: Floats, gains: ControllerParameters, ts: float, edge: Edge = HELD) -> float:
    """Loss probability p* below which independent losses leave a lap mean-square stable; -1: unstable without any.

    Behind a predictor 1 if they do at every p up to MOST_LOST.
    """
    moments = unit_moments(1)

    @functools.cache  # the ends of an interval are asked for again
    def growth(p: float) -> float:
        return lap_growth(v_r, w_r, gains, ts, bernoulli(p), moments, edge) - MARGINAL * len(v_r)

    if growth(0.0) >= 0.0:
        return -1.0
    if not edge.predicts:
        return crossing(growth, 0.0, 1.0)
    tried = (0.0, 0.5, 0.8, 0.9, 0.95, 0.99, 0.999, MOST_LOST)
    for low, high in itertools.pairwise(tried):
        if growth(high) >= 0.0:
            return crossing(growth, low, high)
    return 1.0


def critical_burst(
    loss_rate: float, v_r: Floats, w_r: Floats, gains: ControllerParameters, ts: float, edge: Edge = HELD
) -> float:
    """Mean burst B* [steps] below which a Gilbert channel of this loss rate in (0, 1) leaves a lap mean-square stable.

    -1 if the shortest bursts possible are too long, inf if 1e6 steps are not.
    """
    moments = unit_moments(2)

    @functools.cache
    def growth(burst: float) -> float:
        return lap_growth(v_r, w_r, gains, ts, bursty(loss_rate, burst), moments, edge) - MARGINAL * len(v_r)

    low, high = 0.0, shortest_mean_burst(loss_rate)
    while growth(high) < 0.0:
        low, high = high, 2.0 * high
        if low > 1e6:
            return math.inf
    return crossing(growth, low, high) if low else -1.0


def crossing(f: Callable[[float], float], low: float, high: float) -> float:
    """Where a continuous function changes its sign between `low` and `high`, to 1e-9 (Chandrupatla, 1997).

    Inverse quadratic interpolation where three points allow it, bisection elsewhere (Adv. Eng. Software 28, 145).
    """
    b, c, share = low, high, 0.5
    fb, fc = f(b), f(c)
    a, fa = c, fc
    for _ in range(100):
        x = b + share * (c - b)
        fx = f(x)
        if (fx > 0.0) == (fb > 0.0):
            a, fa = b, fb
        else:
            a, fa, c, fc = c, fc, b, fb
        b, fb = x, fx
        if fb == 0.0 or abs(c - b) <= 1e-9 * max(1.0, abs(b)):
            break
        share = 0.5
        if math.isfinite(fa) and math.isfinite(fc) and fa != fc and fa != fb:
            along, across = (b - c) / (a - c), (fb - fc) / (fa - fc)
            if across**2 < along and (1.0 - across) ** 2 < 1.0 - along:
                share = fb / (fc - fb) * fa / (fc - fa) + (a - b) / (c - b) * fb / (fa - fb) * fc / (fa - fc)
                share = min(0.999, max(1e-3, share))
    return b if abs(fb) < abs(fc) else c


def critical_loss_along(a: float) -> float:
    """p* = (2 - a) / (2 + a) of the error along a straight track, a = T_s K_x; -1 where no loop is stable."""
    return (2.0 - a) / (2.0 + a) if 0.0 < a < 2.0 else -1.0


def critical_mean_age_along(a: float) -> float:
    """E[n_ul] = 1/a - 1/2 [steps], below which the error along a straight track is mean-square stable."""
    return 1.0 / a - 0.5 if 0.0 < a < 2.0 else -1.0
