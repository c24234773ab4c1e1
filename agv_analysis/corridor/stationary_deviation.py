"""RMS deviation that a loop settles to under random losses: the second moments of its affine jump system.

As in `mean_square`, with z the deviation from the loss-free motion and h the one that the edge takes for it, but with
what disturbs the loop: the drift c(k) of the error that is held, which is the bias of `hold` and what the model of
`predict` does not know, and the noise n of a measured pose, of covariance S. With xi = (z, h, 1):

    received:  z+ = (F + G C) z + G n,   h+ = (H C + K) z + H n + c
    lost:      z+ = F z + G h,           h+ = K z + H h + c

    X_j(k+1) = sum_i T_ij [ g_i (A_1 X_i A_1' + P_i N S N') + (1 - g_i) A_0 X_i A_0' ],   N = (G, H, 0),

X_i = E[xi xi'; channel in state i], P_i = its last entry. Laps are driven until the moments give themselves back. All
of it is of first order: the drift is that of a pose that is one step old, and adds up while the pose grows older.

Source: Costa, Fragoso and Marques, Discrete-Time Markov Jump Linear Systems, 2005, chapter 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from agv_analysis.compiled.functions import compiled, numbers
from agv_analysis.corridor.lap_loop import LapLoop
from agv_analysis.link.markov_channel import Chain
from agv_analysis.run import Floats
from agv_analysis.simulation.loop import Rows, Settings, history, reference_at
from agv_analysis.simulation.parts import replacements_of, run_parts
from agv_analysis.simulation.single import settings_of
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.mean_square import spectral_radius
from agv_analysis.stability.products import multiply
from agv_cloud.staleness.estimate import staleness_policy
from agv_cloud.tracking_error import tracking_error
from agv_ros.pose import Pose

_LAPS, _SETTLED = 60, 1e-7
"""Laps that are driven at most, and relative change of the RMS from one to the next at which it has settled."""

_STEPS = 2000
"""A loop that is the same at every step is driven so many at once."""


@dataclass(frozen=True)
class StationaryDeviation:
    """The stationary deviation, by step of the lap."""

    mean_square: Floats
    """E of the squared distance from the reference [m^2], shape (R,); inf where the mean square does not settle."""
    mean_square_along: Floats
    """The same along the AGV's heading."""
    mean_square_across: Floats
    has_heavy_tail: bool = False
    """Do the squares have no variance? Then outages that hardly any run shows make a large part of their mean."""
    drift: float = 0.0
    """Largest error along the track that a held pose adds in a step [m]."""

    @property
    def rms(self) -> float:
        """Over the lap [m]."""
        return float(np.sqrt(self.mean_square.mean()))

    @property
    def rms_along(self) -> float:
        """Over the lap [m]."""
        return float(np.sqrt(self.mean_square_along.mean()))

    @property
    def rms_across(self) -> float:
        """Over the lap [m]."""
        return float(np.sqrt(self.mean_square_across.mean()))


def stationary_deviation(loop: LapLoop, linear: LinearLoop, chain: Chain) -> StationaryDeviation:
    """Of a loop under a channel; its slip is left out."""
    nominal, drift = nominal_and_drift(loop)
    rows, m, q = len(linear.F), linear.size, linear.outputs
    if linear.is_constant:
        nominal, drift = nominal[:1], drift[:1]
    received, lost = (np.zeros((rows, m + q + 1, m + q + 1)) for _ in range(2))
    F, G = linear.F, linear.G
    H = np.broadcast_to(np.eye(q), (rows, q, q)) if linear.H is None else linear.H
    K = np.zeros((rows, q, m)) if linear.K is None else linear.K
    received[:, :m, :m], lost[:, :m, :m], lost[:, :m, m:-1] = F, F, G
    received[:, :m, :q] += G
    received[:, m:-1, :m], lost[:, m:-1, :m], lost[:, m:-1, m:-1] = K, K, H
    received[:, m:-1, :q] += H
    for maps in (received, lost):
        maps[:, m:-1, -1], maps[:, -1, -1] = drift[:, :q], 1.0
    noise = _noise(loop, np.concatenate((G, H), axis=1), q)
    moments = np.zeros((len(chain.delivery), m + q + 1, m + q + 1))
    moments[:, -1, -1] = chain.stationary
    found = _settled(received, lost, noise, chain, moments, nominal, loop)
    return replace(found, has_heavy_tail=_fourth_moments_grow(linear, chain), drift=float(np.abs(drift[:, 0]).max()))


def _fourth_moments_grow(linear: LinearLoop, chain: Chain) -> bool:
    """Do those of the error along a straight track? False where it does not go its own way."""
    a = linear.along_gain
    if a is None:
        return False
    received, lost = np.array([[1.0 - a, 0.0], [1.0, 0.0]]), np.array([[1.0, -a], [0.0, 1.0]])
    return spectral_radius(np.kron(received, received), np.kron(lost, lost), chain) >= 1.0


def nominal_and_drift(loop: LapLoop) -> tuple[Floats, Floats]:
    """Errors of the loss-free motion, and what a pose that is one step old adds to them, shapes (N, 3).

    Row k of the second is that of the step after k: the policy is asked with the commands that were sent.
    """
    steps, scenario = loop.steps, loop.scenario
    reference, s = loop.reference(2 * steps + 2), settings_of(scenario)
    rows, n_ul = np.full((2 * steps + 1, 8), math.nan), np.empty(2 * steps + 1, dtype=np.int64)
    inputs = loop.inputs(np.zeros(2 * steps + 1, dtype=np.bool_))
    run_parts(history, replacements_of(scenario), numbers(reference), inputs, rows, n_ul)
    drift, ahead = np.empty((steps, 3)), scenario.controller.steps_ahead
    points = np.ascontiguousarray(reference[steps + ahead :])
    run_parts(held_drift, replacements_of(scenario), numbers(rows[steps:]), numbers(points), s, drift)
    return rows[steps : 2 * steps, 3:6], drift


def held_drift(driven: Rows, points: Rows, s: Settings, drift: Floats) -> None:
    """What the policy makes of each pose of a path with its commands after a step, less the path's error there.

    Rows of `driven`: pose, error, command; of `points`: the reference that the edge compares with.
    """
    for k in range(len(drift)):
        now, at = driven[k], reference_at(points, k)
        held, target = staleness_policy(
            s.policy, Pose(now[0], now[1], now[2]), Pose(at.x, at.y, at.theta), reference_at(points, k + 1), now[6],
            now[7], s.ts, s.model_arc, s.policy_parameters,
        )  # fmt: skip
        error = tracking_error(target[0], target[1], target[2], held[0], held[1], held[2])
        for i in range(3):
            drift[k, i] = error[i] - driven[k + 1][3 + i]


def _noise(loop: LapLoop, N: Floats, q: int) -> Floats:
    """N S N' of the measured pose, shape (R, m + q + 1, m + q + 1)."""
    plant = loop.scenario.plant
    S = np.diag(np.square([plant.noise_xy, plant.noise_xy, plant.noise_theta])[:q])
    found = np.zeros((len(N), N.shape[1] + 1, N.shape[1] + 1))
    found[:, :-1, :-1] = N @ S @ N.swapaxes(1, 2)
    return found


def _settled(
    received: Floats, lost: Floats, noise: Floats, chain: Chain, moments: Floats, nominal: Floats, loop: LapLoop
) -> StationaryDeviation:
    steps = len(received) if len(received) > 1 else _STEPS
    squares, before = np.zeros((steps, 2, 2)), math.inf
    arguments = received, lost, noise, np.ascontiguousarray(chain.transition), chain.delivery, nominal
    for _ in range(_LAPS):
        compiled(_drive_moments)(*arguments, moments, squares)
        with np.errstate(over="ignore", invalid="ignore"):
            now = float((squares[:, 0, 0] + squares[:, 1, 1]).mean())
        if not now < 1e12:
            break
        if abs(now - before) <= _SETTLED * now + 1e-30:
            last = squares if len(received) > 1 else squares[-1:]
            along, across = last[:, 0, 0], last[:, 1, 1]
            return StationaryDeviation(along + across, along, across)
        before = now
    endless = np.full(len(received), math.inf)
    return StationaryDeviation(endless, endless, endless)


def _drive_moments(
    received: Floats, lost: Floats, noise: Floats, T: Floats, g: Floats, nominal: Floats, X: Floats, squares: Floats
) -> None:
    """Send the moments X, shape (states, n, n), through a lap in place; squares[k]: E of the errors (x_e, y_e) squared.

    Before step k, with those of the loss-free motion in them.
    """
    states, n = X.shape[0], X.shape[1]
    product, after = np.zeros((n, n)), np.zeros((n, n))
    following = np.zeros(X.shape)
    for k in range(squares.shape[0]):
        row = k % received.shape[0]
        for i in range(min(2, n - 1)):
            value = 0.0
            for j in range(states):
                value += X[j, i, i] + 2.0 * nominal[row, i] * X[j, i, n - 1] + nominal[row, i] ** 2 * X[j, n - 1, n - 1]
            squares[k, i, i] = value
        for j in range(states):
            for p in range(n):
                for r in range(n):
                    following[j, p, r] = 0.0
        for i in range(states):
            for outcome in range(2):
                weight = g[i] if outcome == 0 else 1.0 - g[i]
                if weight == 0.0:
                    continue
                A = received[row] if outcome == 0 else lost[row]
                multiply(A, X[i], False, product, False)
                multiply(product, A, True, after, False)
                for j in range(states):
                    share = weight * T[i, j]
                    for p in range(n):
                        for r in range(n):
                            added = X[i, n - 1, n - 1] * noise[row, p, r] if outcome == 0 else 0.0
                            following[j, p, r] += share * (after[p, r] + added)
        for j in range(states):
            for p in range(n):
                for r in range(n):
                    X[j, p, r] = 0.5 * (following[j, p, r] + following[j, r, p])
