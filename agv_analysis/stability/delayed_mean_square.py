"""Mean square where poses are late as well as lost: z(k+1) = F z(k) + G y(k), y(k) = C z(k - n(k)), n a Markov chain.

What arrives at a step is the error of i steps ago, C z(k-i), or nothing, and then y stays. So xi = (z(k), C z(k-1) ..
C z(k-D), y(k-1)) is a Markov jump linear system; its modes are those of `agv_analysis.link.age_chain`, and with
X_s = E[xi xi'; mode s]

    X_t(k+1) = sum_s sum_i W_sit A_i(k) X_s(k) A_i(k)'

dies out if and only if E[|z|^2] does. A_i moves the window on, of which most rows are copies: it is never formed.

Behind a predictor with a wrong model the window holds what it makes of each pose by now, h_i(k) of that of i steps ago,
h_0 = C z, and y, what it makes of the one that it holds. All of them move on under the same command:

    h_(i+1)(k+1) = P_h h_i(k) + P_u u(k),   y(k+1) = P_h y + P_u u,   u = L_h y + L_z z,   z(k+1) = A z + B u + D y

where y is h_i if that arrives at the step.
Source: Costa, Fragoso and Marques, Discrete-Time Markov Jump Linear Systems, 2005, theorem 3.9; for delays Xiao,
Hassibi and How, Control with random communication delays via a discrete-time jump system approach, ACC 2000.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import compiled
from agv_analysis.link.age_chain import AgeChain
from agv_analysis.run import Floats
from agv_analysis.stability import floquet
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.mean_square import growth_over_lap
from agv_analysis.stability.products import multiply_sparse

MOST_WORK = 2e9
"""Numbers to be moved over a lap beyond which there is no answer: about ten seconds."""

_WORK_OF_PREDICTED = 8.0
"""So many times the work is a number of what a wrong model makes of late poses, which is not a copy."""

_STEPS_OF_CONSTANT = 1500
"""Steps, about, that are driven of a loop that is the same at every step."""


def work(loop: LinearLoop, ages: AgeChain) -> float:
    """Numbers that are moved over a lap, or over the steps that stand for one where the loop is constant."""
    size = loop.size + loop.outputs * (ages.oldest + 1)
    steps = _STEPS_OF_CONSTANT if loop.is_constant else loop.steps
    of_number = _WORK_OF_PREDICTED if loop.predicts and not loop.is_exact else 1.0
    return float(np.count_nonzero(ages.moves)) * size**2 * steps * of_number


def lap_growth(loop: LinearLoop, ages: AgeChain) -> float:
    """Growth (logarithm) of the second moments over a lap, by Arnoldi's method.

    Behind an exact predictor a late pose is as good as a fresh one.
    """
    if loop.is_exact or ages.is_constant:
        return 2.0 * floquet.constant_delay(loop, ages.oldest)
    size = loop.size + loop.outputs * (ages.oldest + 1)
    moments = np.array(np.broadcast_to(np.eye(size), (len(ages.moves), size, size)))
    if loop.P_h is not None and loop.P_u is not None:
        predicted = loop.A, loop.B, loop.D, loop.L_h, loop.L_z, loop.P_h, loop.P_u
        return growth_over_lap(
            loop, (moments,),
            lambda steps: float(compiled(_drive_predicted_lap)(*predicted, ages.moves, steps, moments)),
        )  # fmt: skip
    return growth_over_lap(
        loop, (moments,),
        lambda steps: float(compiled(_drive_lap)(loop.F, loop.G, ages.moves, steps, moments)),
    )  # fmt: skip


def _drive_lap(F: Floats, G: Floats, moves: Floats, steps: int, moments: Floats) -> float:
    """Send the moments, shape (s, n, n), through so many steps; in place, to be multiplied by exp(return value)."""
    modes, size, m, q = moments.shape[0], moments.shape[1], G.shape[1], G.shape[2]
    arrivals = moves.shape[1]
    after, moved = np.zeros_like(moments), np.zeros((m, size))
    source, log_scale = np.zeros(size, dtype=np.int64), 0.0
    for i in range(size):  # of the window: each error becomes one step older
        source[i] = i - m if i < m + q else i - q
    for k in range(steps):
        row = k % F.shape[0]
        after[:] = 0.0
        for s in range(modes):
            for arrival in range(arrivals):
                if moves[s, arrival].sum() == 0.0:
                    continue
                answered = size - q if arrival == arrivals - 1 else 0 if arrival == 0 else m + (arrival - 1) * q
                for i in range(q):
                    source[size - q + i] = answered + i
                _move_state(F[row], G[row], answered, moments[s], moved)
                for t in range(modes):
                    if moves[s, arrival, t] > 0.0:
                        _add_moved(F[row], G[row], answered, source, moments[s], moved, moves[s, arrival, t], after[t])
        log_scale += _take_over(after, moments)
    return log_scale


def _take_over(after: Floats, moments: Floats) -> float:
    """Make `after`, of which the lower triangles are known, the moments, shapes (S, n, n).

    They are scaled where they would leave the range of floats; returns the logarithm of what they were divided by.
    """
    largest = 0.0
    for t in range(moments.shape[0]):
        for i in range(moments.shape[1]):
            for j in range(i + 1):
                moments[t, i, j] = after[t, i, j]
                moments[t, j, i] = after[t, i, j]
                largest = max(largest, abs(after[t, i, j]))
    if largest > 1e100 or 0.0 < largest < 1e-100:
        moments /= largest
        return math.log(largest)
    return 0.0


def _drive_predicted_lap(
    A: Floats, B: Floats, D: Floats, L_h: Floats, L_z: Floats, P_h: Floats, P_u: Floats, moves: Floats, steps: int,
    moments: Floats,
) -> float:  # fmt: skip
    """As `_drive_lap`, behind a predictor."""
    modes, size = moments.shape[0], moments.shape[1]
    arrivals = moves.shape[1]
    after, moved, crossed = np.zeros_like(moments), np.zeros((size, size)), np.zeros((size, size))
    matrix, log_scale = np.zeros((size, size)), 0.0
    for k in range(steps):
        row = k % A.shape[0]
        after[:] = 0.0
        for arrival in range(arrivals):
            if moves[:, arrival].sum() == 0.0:
                continue
            _step_of_predicted(A[row], B[row], D[row], L_h[row], L_z[row], P_h[row], P_u[row], arrival, matrix)
            for s in range(modes):
                if moves[s, arrival].sum() == 0.0:
                    continue
                multiply_sparse(matrix, moments[s], moved)
                for i in range(size):
                    for j in range(size):
                        crossed[i, j] = moved[j, i]
                multiply_sparse(matrix, crossed, moved)
                for t in range(modes):
                    weight = moves[s, arrival, t]
                    if weight > 0.0:
                        for i in range(size):
                            for j in range(i + 1):
                                after[t, i, j] += weight * moved[i, j]
        log_scale += _take_over(after, moments)
    return log_scale


def _step_of_predicted(
    A: Floats, B: Floats, D: Floats, L_h: Floats, L_z: Floats, P_h: Floats, P_u: Floats, arrival: int, matrix: Floats
) -> None:
    """A_i of one arrival, shape (n, n), of (z, h_1 .. h_D, y)."""
    m, q, size = A.shape[0], D.shape[1], matrix.shape[0]
    answered = size - q if arrival == (size - m) // q else 0 if arrival == 0 else m + (arrival - 1) * q
    matrix[:] = 0.0
    for c in range(2):  # u, by which of the state
        for p in range(m):
            for i in range(m):
                matrix[i, p] += B[i, c] * L_z[c, p]
            for i in range(q):
                for begin in range(m, size, q):
                    matrix[begin + i, p] += P_u[i, c] * L_z[c, p]
        for p in range(q):
            for i in range(m):
                matrix[i, answered + p] += B[i, c] * L_h[c, p]
            for i in range(q):
                for begin in range(m, size, q):
                    matrix[begin + i, answered + p] += P_u[i, c] * L_h[c, p]
    for i in range(m):
        for p in range(m):
            matrix[i, p] += A[i, p]
        for p in range(q):
            matrix[i, answered + p] += D[i, p]
    for begin in range(m, size, q):
        before = answered if begin == size - q else 0 if begin == m else begin - q
        for i in range(q):
            for p in range(q):
                matrix[begin + i, before + p] += P_h[i, p]


def _move_state(F: Floats, G: Floats, answered: int, X: Floats, moved: Floats) -> None:
    """`moved` = the rows of A X that are z, shape (m, n), for one arrival: the errors at `answered` are acted on."""
    for i in range(moved.shape[0]):
        for j in range(X.shape[1]):
            moved[i, j] = 0.0
        for p in range(F.shape[1]):
            for j in range(X.shape[1]):
                moved[i, j] += F[i, p] * X[p, j]
        for p in range(G.shape[1]):
            for j in range(X.shape[1]):
                moved[i, j] += G[i, p] * X[answered + p, j]


def _add_moved(
    F: Floats, G: Floats, answered: int, source: NDArray[np.int64], X: Floats, moved: Floats, weight: float,
    total: Floats,
) -> None:  # fmt: skip
    """`total` += weight A X A', its lower half; all rows of A but those of z, which are in `moved`, are copies."""
    m = moved.shape[0]
    for i in range(m):
        for j in range(i + 1):
            value = 0.0
            for p in range(m):
                value += moved[i, p] * F[j, p]
            for p in range(G.shape[1]):
                value += moved[i, answered + p] * G[j, p]
            total[i, j] += weight * value
    for i in range(m, X.shape[0]):
        for j in range(m):
            total[i, j] += weight * moved[j, source[i]]
        for j in range(m, i + 1):
            total[i, j] += weight * X[source[i], source[j]]
