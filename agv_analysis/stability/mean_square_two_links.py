"""Mean square where commands are lost as well as poses.

The plant acts on the command u that it holds, the edge computes from the error h that it takes for the current one
(see `linear_loop`). On step k, with the verdicts of both links,

    h_now = C z if the pose is delivered else h         u_sent = L_h h_now + L_z z
    u' = u_sent if the command is delivered else u      z(k+1) = A z + B u' + D h_now
    h(k+1) = P_h h_now + P_u u_sent (held: h_now),      u(k+1) = u'

for a plant that holds its command through an outage; for one that stops u' = 0. So xi = (z, h, u) is a Markov jump
linear system with four outcomes a step. Its second moments obey, with Z = E[xi xi'; channels in state s],

    Z_t(k+1) = sum_s T_st sum_o P(o | s) A_o Z_s(k) A_o'

and E[|z|^2] dies out, or stays bounded where lost commands disturb the loop, if and only if this contracts. What is
exact: u is the deviation of the command from the one of the loss-free motion. A command that is held while that one
changes, or a plant that stops, adds a disturbance that does not depend on xi, which does not touch stability; the
derivatives stay those about the loss-free motion.
Source: Costa, Fragoso and Marques, Discrete-Time Markov Jump Linear Systems, 2005, theorem 3.9; for two links in the
loop Schenato et al., Foundations of control and estimation over lossy networks, Proc. IEEE 95(1), 2007.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import compiled
from agv_analysis.link.joint_chain import OUTCOMES, JointChain
from agv_analysis.link.markov_channel import cycle_of
from agv_analysis.run import Floats
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.mean_square import growth_of_repeated, growth_over_lap
from agv_analysis.stability.products import assign, divide, largest_entry, multiply_sparse

POLICIES = ("hold", "zero")
"""Downlink policies that are a Markov jump linear system of (z, h, u); for others see `mean_square_downlink`."""

_LARGEST = 400
"""Size of the recursion's matrix up to which its eigenvalues are asked for instead of driving laps."""


def lap_growth(loop: LinearLoop, links: JointChain, stops: bool = False) -> float:
    """Growth (logarithm) of the second moments over a lap. Where the loop changes by Arnoldi's method.

    `stops`: the plant stops where a command is lost, instead of holding the one before.
    """
    maps = [step_maps(loop, *outcome, share=0.0 if stops else 1.0) for outcome in OUTCOMES]
    return growth_of_maps(loop, np.stack(maps, axis=1), links)


def growth_of_maps(loop: LinearLoop, maps: Floats, links: JointChain) -> float:
    """The same under the maps of each outcome of `links`, shape (R, outcomes, n, n)."""
    states, size = len(links.transition), maps.shape[-1]
    if loop.is_constant and states * size**2 <= _LARGEST:
        return loop.steps * math.log(np.abs(np.linalg.eigvals(operator(maps[0], links))).max())
    cycle = cycle_of(links.transition)
    if cycle is not None and bool(np.isin(links.outcomes, (0.0, 1.0)).all()):
        repeated = links.outcomes[cycle].argmax(axis=1)
        together = math.lcm(len(maps), len(repeated))
        growth = growth_of_repeated(
            len(maps), len(repeated), lambda begin: _log_spectral_radius(maps, repeated, begin, together)
        )
        return growth * (loop.steps / len(maps))
    moments = np.array(np.broadcast_to(np.eye(size), (states, size, size)), order="C")
    return growth_over_lap(loop, (moments,), lambda steps: float(compiled(_drive_lap)(maps, *links, steps, moments)))


def step_maps(loop: LinearLoop, pose: bool, command: bool, share: float = 1.0) -> Floats:
    """A_o of one outcome of a step: is the pose delivered, is the command? Shape (R, n, n), n = m + q + 2.

    Where the command is lost the plant acts on a `share` of the one that it holds; where that is 0 it holds none.
    """
    m, q = loop.size, loop.outputs
    z, h, u = np.split(np.eye(m + q + 2), [m, m + q])
    h_now = z[:q] if pose else h
    sent = loop.L_h @ h_now + loop.L_z @ z
    kept = sent if command else np.broadcast_to(u if share > 0.0 else np.zeros_like(u), sent.shape)
    moved = loop.A @ z + loop.B @ (kept if command else share * kept) + loop.D @ h_now
    held = np.broadcast_to(h_now, (len(moved), q, m + q + 2))
    h_next = held if loop.P_h is None or loop.P_u is None else loop.P_h @ h_now + loop.P_u @ sent
    return np.concatenate((moved, h_next, kept), axis=1)


def operator(maps: Floats, links: JointChain) -> Floats:
    """Matrix of the recursion of one step, shape (s n^2, s n^2); maps of its outcomes of shape (4, n, n)."""
    squares = np.stack([np.kron(A, A) for A in maps])
    rows = np.einsum("so,oij->sij", links.outcomes, squares)
    size = len(links.transition) * squares.shape[1]
    return np.asarray(np.einsum("st,sij->tisj", links.transition, rows).reshape(size, size))


def _log_spectral_radius(maps: Floats, outcomes: NDArray[np.int64], begin: int, steps: int) -> float:
    """Of the product of so many maps from the one at `begin` of the lap on, logarithm; -inf if nothing is left."""
    product = np.eye(maps.shape[-1])
    log_scale = compiled(_multiply_through)(maps, outcomes, begin, steps, product)
    radius = float(np.abs(np.linalg.eigvals(product)).max())
    return log_scale + math.log(radius) if radius > 0.0 else -math.inf


def _multiply_through(maps: Floats, outcomes: NDArray[np.int64], begin: int, steps: int, product: Floats) -> float:
    """`product` = the maps of the steps after each other times it, to be multiplied by exp(what is returned)."""
    log_scale, before = 0.0, np.empty_like(product)
    for k in range(steps):
        assign(product, before)
        multiply_sparse(maps[(begin + k) % maps.shape[0], outcomes[k % len(outcomes)]], before, product)
        largest = largest_entry(product)
        if largest > 1e100 or 0.0 < largest < 1e-100:
            divide(product, largest)
            log_scale += math.log(largest)
    return log_scale


def _drive_lap(maps: Floats, transition: Floats, probabilities: Floats, steps: int, moments: Floats) -> float:
    """Send the moments, shape (s, n, n), through so many steps with the maps of a lap, shape (R, 4, n, n); in place.

    What is left in them is to be multiplied by exp(return value).
    """
    states, size = moments.shape[0], moments.shape[1]
    log_scale = 0.0
    half, after = np.zeros((size, size)), np.zeros_like(moments)
    for k in range(steps):
        row = k % maps.shape[0]
        for s in range(states):
            for i in range(size):
                for j in range(size):
                    after[s, i, j] = 0.0
            for outcome in range(maps.shape[1]):
                weight = probabilities[s, outcome]
                if weight > 0.0:
                    multiply_sparse(maps[row, outcome], moments[s], half)
                    _add_symmetric(half, maps[row, outcome], weight, after[s])
        largest = 0.0
        for t in range(states):
            for i in range(size):
                for j in range(size):
                    moments[t, i, j] = 0.0
            for s in range(states):
                if transition[s, t] > 0.0:
                    for i in range(size):
                        for j in range(size):
                            moments[t, i, j] += transition[s, t] * after[s, i, j]
            largest = max(largest, largest_entry(moments[t]))
        if largest > 1e100 or 0.0 < largest < 1e-100:
            for t in range(states):
                divide(moments[t], largest)
            log_scale += math.log(largest)
    return log_scale


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
