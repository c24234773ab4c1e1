"""Mean square: does E[|z|^2] die out under random losses?

With what the edge takes for the error, h, the loop (see `linear_loop`) is a Markov jump linear system: xi = (z, h) goes
to A_1 xi = ((F + G C) z, (H C + K) z) at a reception and to A_0 xi = (F z + G h, K z + H h) at a loss. With
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
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import compiled
from agv_analysis.link.markov_channel import Chain, bernoulli, bursty, cycle_of, shortest_mean_burst
from agv_analysis.run import Floats
from agv_analysis.stability.first_border import borders
from agv_analysis.stability.floquet import drop_sequence
from agv_analysis.stability.linear_loop import MARGINAL, LinearLoop
from agv_analysis.stability.moment_growth import SETTLED, moment_growth
from agv_analysis.stability.products import (
    assign,
    column_count,
    divide,
    largest_entry,
    log_spectral_radius,
    multiply,
    of_size_3,
    row_count,
)

_LARGEST = 400
"""Size of the recursion's matrix up to which its eigenvalues are asked for instead of driving laps."""

_STEPS = 128
"""A loop that is the same at every step is driven so many at once, a shorter lap several times."""

MOST_LOST = 0.9999
"""Largest loss probability that is asked for behind a predictor, which may make any of them harmless."""

LONGEST_BURST = 1e6
"""Longest mean burst [steps] that is asked for."""

_TRIED = 25
"""Loss probabilities of the grid on which borders are searched for."""

_ROUGHLY = 1e-3
"""As `moment_growth.SETTLED`, where the sign alone is asked for."""

_DOUBTFUL = 0.1
"""Growth over a lap below which a roughly settled one does not tell the sign."""

_PLACES, _DOUBTFUL_AT_PLACES = 2000, 10.0
"""Places of a lap, at least, at which a growth is asked for first, and up to which size it does not tell the sign."""

_LONG = 0.1
"""Share of a lap from which on outages are too long, on average, to be asked for at places of it."""


def step_maps(loop: LinearLoop, k: int = 0) -> tuple[Floats, Floats]:
    """(A_1, A_0) of step k: maps of (z, h) at a reception and at a loss, shape (m + q, m + q) each."""
    m, q = loop.size, loop.outputs
    C, row = np.eye(q, m), 0 if loop.is_constant else k
    F, G = loop.F[row], loop.G[row]
    H = np.eye(q) if loop.H is None else loop.H[row]
    K = np.zeros((q, m)) if loop.K is None else loop.K[row]
    received = np.block([[F + G @ C, np.zeros((m, q))], [H @ C + K, np.zeros((q, q))]])
    return received, np.block([[F, G], [K, H]])


def operator(received: Floats, missed: Floats, chain: Chain) -> Floats:
    """Matrix of the recursion for the maps of `step_maps`, n = m + q: shape (states * n^2, states * n^2)."""
    rows = [
        np.kron(T_i[:, None], g * np.kron(received, received) + (1.0 - g) * np.kron(missed, missed))
        for T_i, g in zip(chain.transition, chain.delivery, strict=True)
    ]
    return np.hstack(rows).reshape(len(rows) * len(missed) ** 2, -1)


def spectral_radius(received: Floats, missed: Floats, chain: Chain) -> float:
    """Growth of the second moments per step of a loop that stays as it is; arguments as of `operator`."""
    lost = _repeated_outcomes(chain)
    if lost is not None:
        return math.exp(2.0 * log_spectral_radius(np.where(lost[:, None, None], missed, received)) / len(lost))
    return float(np.abs(np.linalg.eigvals(operator(received, missed, chain))).max())


def along_spectral_radius(a: float, chain: Chain) -> float:
    """As `spectral_radius`, of the error along a straight track alone; a = T_s K_x."""
    return spectral_radius(np.array([[1.0 - a, 0.0], [1.0, 0.0]]), np.array([[1.0, -a], [0.0, 1.0]]), chain)


class Moments(NamedTuple):
    """Second moments by channel state."""

    zz: Floats
    """E[z z'], shape (states, m, m)."""
    zh: Floats
    """E[z h'], shape (states, m, q)."""
    hh: Floats
    """E[h h'], shape (states, q, q)."""

    @classmethod
    def unit(cls, loop: LinearLoop, states: int) -> Moments:
        """Moments for `lap_growth` to begin with."""
        m, q = loop.size, loop.outputs
        return cls(
            *(
                np.array(np.broadcast_to(np.eye(*shape), (states, *shape)), order="C")
                for shape in ((m, m), (m, q), (q, q))
            )
        )


def lap_growth(loop: LinearLoop, chain: Chain, moments: Moments | None = None, settled: float = SETTLED) -> float:
    """Growth (logarithm) of the second moments over a lap.

    By Arnoldi's method; `moments` are those to begin with, and are left as they settled, which makes the next call with
    a similar chain faster. Without losses it is twice that of the state itself. `settled`: as of `moment_growth`.
    """
    if loop.is_exact and chain.loss_rate < 1.0:  # from the first reception on the edge knows the error
        chain, moments = bernoulli(0.0), None
    outcomes = _repeated_outcomes(chain)
    if outcomes is not None:
        return _growth_of_repeated(loop, outcomes)
    if loop.is_constant and len(chain.delivery) * (loop.size + loop.outputs) ** 2 <= _LARGEST:
        return loop.steps * math.log(spectral_radius(*step_maps(loop), chain))
    if chain.loss_rate == 0.0:  # X(k+1) = A_1 X(k) A_1': eigenvalues are products of two of those of the lap of A_1
        received = loop.F.copy()
        received[:, :, : loop.outputs] += loop.G
        return 2.0 * log_spectral_radius(received) * (loop.steps / len(received))
    if moments is None:
        moments = Moments.unit(loop, len(chain.delivery))
    return growth_over_lap(loop, moments, _drive(loop, chain, moments), settled)


def _repeated_outcomes(chain: Chain) -> NDArray[np.bool_] | None:
    """Which slots are lost of a chain that leaves nothing to chance, over its period; None if it does, or none arrive.

    Second moments by state would cost as many times a lap as the period has slots, for what one trajectory shows.
    """
    states, delivered = cycle_of(chain.transition), chain.delivery == 1.0
    is_certain = states is not None and bool(np.isin(chain.delivery, (0.0, 1.0)).all()) and bool(delivered.any())
    return ~delivered[states] if is_certain else None


def _growth_of_repeated(loop: LinearLoop, lost: NDArray[np.bool_]) -> float:
    """Growth of the second moments over a lap if `lost`, shape (P,), repeats."""
    rows = 1 if loop.is_constant else loop.steps
    repeated = np.resize(lost, math.lcm(rows, len(lost)))

    def log_radius(begin: int) -> float:
        return float(drop_sequence(loop, np.roll(repeated, begin), 1)[0])

    return growth_of_repeated(rows, len(lost), log_radius) * (loop.steps / rows)


def growth_of_repeated(rows: int, period: int, log_radius: Callable[[int], float]) -> float:
    """Growth of second moments over `rows` steps, after which a loop is as before, if outcomes repeat every `period`.

    Both are as before after their least common multiple; `log_radius` is that of the loop over so many steps, if it and
    the outcomes begin so many steps apart. Of the places to begin that lead to different ones the worst counts.
    """
    largest = max(map(log_radius, range(math.gcd(rows, period))))
    return 2.0 * largest * (rows / math.lcm(rows, period))


def _drive(loop: LinearLoop, chain: Chain, moments: Moments) -> Callable[[int], float]:
    """Sends the moments through so many steps, in place; they are to be multiplied by exp(what it returns)."""
    drive = compiled(_drive_lap, of_size_3(loop.F, loop.G))
    return lambda steps: float(drive(loop.F, loop.G, loop.H, loop.K, chain.transition, chain.delivery, steps, *moments))


def growth_over_lap(
    loop: LinearLoop, moments: tuple[Floats, ...], drive: Callable[[int], float], settled: float = SETTLED
) -> float:
    """Growth (logarithm) of second moments over a lap; -inf if nothing is left.

    `drive` sends them through so many steps in place, to be multiplied by exp(what it returns); see `moment_growth`.
    """
    steps = _STEPS if loop.is_constant else math.ceil(_STEPS / loop.steps) * loop.steps
    return moment_growth(moments, lambda: drive(steps), steps, settled) * (loop.steps / steps)


def _drive_lap(
    F: Floats,
    G: Floats,
    H: Floats | None,
    K: Floats | None,
    T: Floats,
    g: Floats,
    steps: int,
    zz: Floats,
    zh: Floats,
    hh: Floats,
) -> float:
    """Send `Moments` through so many steps; in place, to be multiplied by exp(return value).

    H is None where it is the identity, K where it is zero: the branches that this leaves out are not compiled.
    """
    states, m, q = zh.shape
    log_scale = 0.0
    # Of each state: what goes on if its slot is received, and if it is lost.
    received_zz, received_zh, received_hh = np.zeros_like(zz), np.zeros_like(zh), np.zeros_like(hh)
    missed_zz, missed_zh, missed_hh = np.zeros_like(zz), np.zeros_like(zh), np.zeros_like(hh)
    of_z, of_h, M = np.zeros((m, m)), np.zeros((m, q)), np.zeros((m, m))
    h_of_z, h_of_h, N = np.zeros((q, m)), np.zeros((q, q)), np.zeros((q, m))
    for k in range(steps):
        row = k % F.shape[0]
        for i in range(m):
            for j in range(m):
                M[i, j] = F[row, i, j] + G[row, i, j] if j < q else F[row, i, j]
        if H is not None:
            for i in range(q):
                for j in range(m):
                    N[i, j] = H[row, i, j] if j < q else 0.0
                    if K is not None:
                        N[i, j] += K[row, i, j]
        for i in range(states):
            multiply(M, zz[i], False, of_z, False)
            _symmetric_product(of_z, M, received_zz[i], False)
            if H is not None:
                multiply(of_z, N, True, received_zh[i], False)
                multiply(N, zz[i], False, h_of_z, False)
                _symmetric_product(h_of_z, N, received_hh[i], False)
            else:
                assign(of_z, received_zh[i])
                assign(zz[i], received_hh[i])
            multiply(F[row], zh[i], False, of_h, False)
            multiply(G[row], hh[i], False, of_h, True)
            multiply(F[row], zz[i], False, of_z, False)
            multiply(G[row], zh[i], True, of_z, True)
            _symmetric_product(of_z, F[row], missed_zz[i], False)
            _symmetric_product(of_h, G[row], missed_zz[i], True)
            if H is not None:
                multiply(of_h, H[row], True, missed_zh[i], False)
                multiply(H[row], hh[i], False, h_of_h, False)
                if K is not None:
                    multiply(of_z, K[row], True, missed_zh[i], True)
                    multiply(K[row], zh[i], False, h_of_h, True)
                    multiply(K[row], zz[i], False, h_of_z, False)
                    multiply(H[row], zh[i], True, h_of_z, True)
                _symmetric_product(h_of_h, H[row], missed_hh[i], False)
                if K is not None:
                    _symmetric_product(h_of_z, K[row], missed_hh[i], True)
            else:
                assign(of_h, missed_zh[i])
                assign(hh[i], missed_hh[i])
        largest = 0.0
        for j in range(states):
            _mix(T[:, j], g, received_zz, missed_zz, zz[j])
            _mix(T[:, j], g, received_zh, missed_zh, zh[j])
            _mix(T[:, j], g, received_hh, missed_hh, hh[j])
            largest = max(largest, largest_entry(zz[j]), largest_entry(zh[j]), largest_entry(hh[j]))
        if largest > 1e100 or 0.0 < largest < 1e-100:
            for j in range(states):
                divide(zz[j], largest)
                divide(zh[j], largest)
                divide(hh[j], largest)
            log_scale += math.log(largest)
    return log_scale


def _mix(weights: Floats, g: Floats, received: Floats, missed: Floats, mixed: Floats) -> None:
    """What comes into one state: from each state i with weight T_ij, received with probability g_i or lost."""
    for p in range(row_count(mixed)):
        for r in range(column_count(mixed)):
            value = 0.0
            for i in range(len(g)):
                value += weights[i] * (g[i] * received[i, p, r] + (1.0 - g[i]) * missed[i, p, r])
            mixed[p, r] = value


def _symmetric_product(A: Floats, B: Floats, product: Floats, add: bool) -> None:
    """`product` = A B', added to what is there if `add`, of which only one half is computed: the whole is symmetric.

    Rounding must not make a skew part, which would not obey the recursion of the moments and outlive them.
    """
    for i in range(row_count(product)):
        for j in range(i + 1):
            value = product[i, j] if add else 0.0
            for m in range(column_count(A)):
                value += A[i, m] * B[j, m]
            product[i, j] = value
            product[j, i] = value


def loss_borders(loop: LinearLoop) -> tuple[float, ...]:
    """Probabilities of independent losses at which a lap turns mean-square unstable, stable again, and so on.

    (0.0,) if it is unstable without any. Behind a predictor, which may make any losses harmless, up to MOST_LOST.
    """

    def growth_of(part: LinearLoop) -> Callable[[float, float], float]:
        moments = Moments.unit(part, 1)

        def growth(p: float, settled: float) -> float:
            found = lap_growth(part, bernoulli(p), moments, settled) - MARGINAL * part.steps
            return max(found, -MARGINAL) if p == 1.0 else found  # nothing received: what is off stays off

        return growth

    grid = np.append(1.0 - np.logspace(0.0, math.log10(1.0 - MOST_LOST), _TRIED), [] if loop.predicts else [1.0])
    return borders(_sign_first(loop, growth_of, lambda p: 1.0 / (1.0 - p) if p < 1.0 else math.inf), grid.tolist())


def _sign_first(
    loop: LinearLoop, growth_of: Callable[[LinearLoop], Callable[[float, float], float]],
    burst_of: Callable[[float], float],
) -> Callable[[float], float]:  # fmt: skip
    """A growth over a lap that is exact only where its sign is in doubt; values are kept.

    Elsewhere it is that of some places of the lap, where outages are short, or roughly settled. `burst_of`: their mean
    length in steps.
    """
    thinned = loop.thinned(_PLACES)
    growth, at_places = growth_of(loop), growth_of(thinned)
    ratio = loop.steps / thinned.steps

    @functools.cache
    def found(x: float) -> float:
        is_short = ratio > 1.0 and burst_of(x) < _LONG * loop.steps
        if is_short and abs(guess := ratio * at_places(x, _ROUGHLY)) > _DOUBTFUL_AT_PLACES:
            return guess
        rough = growth(x, _ROUGHLY)
        return rough if abs(rough) > _DOUBTFUL else growth(x, SETTLED)

    return found


def critical_loss(loop: LinearLoop) -> float:
    """Loss probability p* up to which independent losses leave a lap mean-square stable; -1: unstable without any.

    1 if they do at every p that was tried. Larger ones may be stable again, see `loss_borders`.
    """
    found = loss_borders(loop)
    return 1.0 if not found else found[0] or -1.0


def burst_borders(loop: LinearLoop, loss_rate: float) -> tuple[float, ...]:
    """Mean bursts [steps] of a Gilbert channel of this loss rate in (0, 1) at which a lap turns unstable, and back.

    Beginning with the shortest possible if it is unstable with that. Up to 1e6, or eight times the first of them.
    """
    shortest = shortest_mean_burst(loss_rate)

    def growth_of(part: LinearLoop) -> Callable[[float, float], float]:
        moments = Moments.unit(part, 2)
        return lambda burst, settled: (
            lap_growth(part, bursty(loss_rate, burst), moments, settled) - MARGINAL * part.steps
        )

    signed, grid, end = _sign_first(loop, growth_of, lambda burst: burst), [shortest], LONGEST_BURST
    while grid[-1] < end:
        if end == LONGEST_BURST and signed(grid[-1]) >= 0.0:
            end = min(end, 8.0 * grid[-1])
        grid.append(1.5 * grid[-1])
    return borders(signed, grid)


def critical_burst(loop: LinearLoop, loss_rate: float) -> float:
    """Mean burst B* [steps] up to which a Gilbert channel of this loss rate in (0, 1) leaves a lap mean-square stable.

    -1 if the shortest bursts possible are too long, inf if 1e6 steps are not. Longer ones may be stable again, see
    `burst_borders`.
    """
    found = burst_borders(loop, loss_rate)
    if not found:
        return math.inf
    return -1.0 if found[0] == shortest_mean_burst(loss_rate) else found[0]


def critical_loss_along(a: float) -> float:
    """p* = (2 - a) / (2 + a) of the error along a straight track, a = T_s K_x; -1 where no loop is stable."""
    return (2.0 - a) / (2.0 + a) if 0.0 < a < 2.0 else -1.0


def critical_mean_age_along(a: float) -> float:
    """E[n_ul] = 1/a - 1/2 [steps], below which the error along a straight track is mean-square stable."""
    return 1.0 / a - 0.5 if 0.0 < a < 2.0 else -1.0
