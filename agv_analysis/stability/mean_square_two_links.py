"""Mean square where commands are lost as well as poses.

The plant acts on the error c that the newest command it holds was computed from, the edge computes from the error h
that it takes for the current one (see `linearisation`). With verdicts u of the uplink and d of the downlink on step k,

    h' = e if u is delivered else h            e(k+1) = F e + G c'
    c' = h' if d is delivered else c           h(k+1) = H h',   c(k+1) = c'

for a plant that holds its command through an outage; one that stops feeds nothing back, c' = 0. So xi = (e, h, c) is a
Markov jump linear system with four outcomes a step. Its second moments obey, with Z = E[xi xi'; channels in state s],

    Z_t(k+1) = sum_s T_st sum_o P(o | s) A_o Z_s(k) A_o'

and E[|e|^2] dies out, or stays bounded where lost commands disturb the loop, if and only if this contracts. (A command
that is held while the speeds of the track change, and a plant that stops, disturb it: that does not touch stability.)
Source: Costa, Fragoso and Marques, Discrete-Time Markov Jump Linear Systems, 2005, theorem 3.9; for two links in the
loop Schenato et al., Foundations of control and estimation over lossy networks, Proc. IEEE 95(1), 2007.
"""

from __future__ import annotations

import math

import numpy as np

from agv_analysis.compiled import compiled
from agv_analysis.link.markov_channel import Chain
from agv_analysis.run import Floats
from agv_analysis.stability.linearisation import HELD, Edge, is_constant, reachable, seen, step_matrices
from agv_analysis.stability.mean_square import settled_growth
from agv_cloud.parameters import ControllerParameters

POLICIES = ("hold", "zero")
"""Downlink policies that are a Markov jump linear system of three errors; others remember more."""

_MOST_STATES = 4
"""Joint states of the channels, at most, of which the whole recursion is made a matrix."""

_OUTCOMES = ((True, True), (True, False), (False, True), (False, False))
"""(is the pose delivered, is the command delivered)."""


def lap_growth(
    v_r: Floats, w_r: Floats, gains: ControllerParameters, ts: float, uplink: Chain, downlink: Chain,
    edge: Edge = HELD, stops: bool = False,
) -> float:  # fmt: skip
    """Growth (logarithm) of the second moments over a lap with the speeds v_r [m/s], w_r [rad/s] of shape (N,).

    The links are independent of each other. `stops`: the plant stops where a command is lost, instead of holding the
    one before. Where speeds change by driving laps until the growth settles.
    """
    size = reachable(v_r, w_r)
    F, G = (M[:, :size, :size] for M in step_matrices(v_r, w_r, gains, ts))
    G, H = seen(F, G, edge)
    maps = np.stack([step_maps(F, G, H, *outcome, stops) for outcome in _OUTCOMES], axis=1)
    transition, probabilities = joint(uplink, downlink)
    if is_constant(v_r, w_r) and len(transition) <= _MOST_STATES:
        return len(v_r) * math.log(np.abs(np.linalg.eigvals(operator(maps[0], transition, probabilities))).max())
    moments = np.array(np.broadcast_to(np.eye(3 * size), (len(transition), 3 * size, 3 * size)))
    return settled_growth(
        moments,
        lambda: float(compiled(_drive_lap)(maps, transition, probabilities, moments)),
        lambda: float(np.trace(moments, axis1=1, axis2=2).sum()),
    )


def step_maps(F: Floats, G: Floats, H: Floats | None, pose: bool, command: bool, stops: bool) -> Floats:
    """A_o of one outcome of a step: is the pose delivered, is the command? Shape (..., 3m, 3m).

    F and G of shape (..., m, m), H as of `linearisation.seen`.
    """
    size = F.shape[-1]
    one, zero = np.eye(size), np.zeros((size, size))
    at_edge = np.hstack((one, zero, zero) if pose else (zero, one, zero))
    at_plant = at_edge if command else np.zeros_like(at_edge) if stops else np.hstack((zero, zero, one))
    error = F @ np.hstack((one, zero, zero)) + G @ at_plant
    moved_on = np.broadcast_to(at_edge, error.shape) if H is None else H @ at_edge
    return np.concatenate((error, moved_on, np.broadcast_to(at_plant, error.shape)), axis=-2)


def joint(uplink: Chain, downlink: Chain) -> tuple[Floats, Floats]:
    """T of both channels at once, shape (s, s), and the probability of each outcome in each state, shape (s, 4)."""
    u, d = (grid.ravel() for grid in np.meshgrid(uplink.delivery, downlink.delivery, indexing="ij"))
    outcomes = [(u if pose else 1.0 - u) * (d if command else 1.0 - d) for pose, command in _OUTCOMES]
    return np.asarray(np.kron(uplink.transition, downlink.transition)), np.stack(outcomes, axis=1)


def operator(maps: Floats, transition: Floats, probabilities: Floats) -> Floats:
    """Matrix of the recursion of one step, shape (s n^2, s n^2); maps of its outcomes of shape (4, n, n)."""
    squares = np.stack([np.kron(A, A) for A in maps])
    rows = np.einsum("so,oij->sij", probabilities, squares)
    size = len(transition) * squares.shape[1]
    return np.asarray(np.einsum("st,sij->tisj", transition, rows).reshape(size, size))


def _drive_lap(maps: Floats, transition: Floats, probabilities: Floats, moments: Floats) -> float:
    """Send the moments, shape (s, n, n), through the maps of a lap, shape (N, 4, n, n); in place.

    What is left in them is to be multiplied by exp(return value).
    """
    states, size = moments.shape[0], moments.shape[1]
    log_scale = 0.0
    half, after = np.zeros((size, size)), np.zeros_like(moments)
    for k in range(maps.shape[0]):
        for s in range(states):
            after[s] = 0.0
            for outcome in range(maps.shape[1]):
                weight = probabilities[s, outcome]
                if weight > 0.0:
                    _multiply(maps[k, outcome], moments[s], half)
                    _add_symmetric(half, maps[k, outcome], weight, after[s])
        largest = 0.0
        for t in range(states):
            moments[t] = 0.0
            for s in range(states):
                if transition[s, t] > 0.0:
                    moments[t] += transition[s, t] * after[s]
            for i in range(size):
                largest = max(largest, moments[t, i, i])
        if largest > 1e100 or 0.0 < largest < 1e-100:
            moments /= largest
            log_scale += math.log(largest)
    return log_scale


def _multiply(A: Floats, X: Floats, product: Floats) -> None:
    """`product` = A X, passing over the zeros of A, which are most of it."""
    size = A.shape[0]
    for i in range(size):
        for j in range(size):
            product[i, j] = 0.0
        for m in range(size):
            factor = A[i, m]
            if factor != 0.0:
                for j in range(size):
                    product[i, j] += factor * X[m, j]


def _add_symmetric(half: Floats, A: Floats, weight: float, total: Floats) -> None:
    """`total` += weight * half A', of which only one half is computed: rounding must not make a skew part."""
    size = A.shape[0]
    for i in range(size):
        for j in range(i + 1):
            value = 0.0
            for m in range(size):
                value += half[i, m] * A[j, m]
            total[i, j] += weight * value
            if i != j:
                total[j, i] += weight * value
