"""The loop to first order about its reference: what all criteria but the paper's start from.

With eps = T_e(theta_c) [X_r - X_c] the tracking error obeys, for a command computed from an error that is n steps old,

    e(k+1) = F(k) e(k) + G(k) e(k-n),    phi = T_s w_r(k),  v = v_r(k)

                 [1  0  0    ]                     [K_x  0      0        ]              [ cos phi  sin phi  0]
    F = R(-phi)  [0  1  T_s v],   G = -T_s R(-phi) [0    0      0        ],   R(-phi) = [-sin phi  cos phi  0]
                 [0  0  1    ]                     [0    v K_y  v K_theta]              [ 0        0        1]

F and G hold the speeds of step k alone, so speeds may change inside a burst. The equation is exact to first order where
zero error is an equilibrium: X_r(k-n) compared with X_c(k-n). The paper compares X_r(k) with X_c(k-n), so its loop
settles n steps ahead of the reference; about that motion the equation is the same while speeds are constant, and off by
the change of speeds over n steps otherwise.

Staleness policies differ in what the edge takes for the error, h(k). A fresh pose makes it h(k) = e(k); from then on

    e(k+1) = F(k) e(k) + G(k) h(k),    h(k+1) = H(k) h(k),    H = I for hold and align, F + G for predict

so a prediction goes on as the loop would without outages. A true speed of 1 + delta times the commanded one scales the
column of K_x in G, but not in the H of a predictor, whose model does not know of it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled import compiled
from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.stability.products import multiply
from agv_cloud.control.command import limit_speed
from agv_cloud.control.kanayama import kanayama
from agv_cloud.parameters import ControllerParameters
from agv_cloud.tracking_error import tracking_error

MARGINAL = -1e-13
"""Growth per step (logarithm) that counts as none: round-off is 1e-16, and an error that stays is not stable."""


def step_matrices(v_r: Floats, w_r: Floats, gains: ControllerParameters, ts: float) -> tuple[Floats, Floats]:
    """F and G at the speeds v_r [m/s], w_r [rad/s] of shape (N,); each of shape (N, 3, 3)."""
    phi = ts * w_r
    cos, sin, zero, one = np.cos(phi), np.sin(phi), np.zeros(len(v_r)), np.ones(len(v_r))
    F = np.array([[cos, sin, sin * ts * v_r], [-sin, cos, cos * ts * v_r], [zero, zero, one]])
    G = -ts * np.array(
        [[cos * gains.kx, zero, zero], [-sin * gains.kx, zero, zero], [zero, v_r * gains.ky, v_r * gains.ktheta]]
    )
    return np.moveaxis(F, 2, 0).copy(), np.moveaxis(G, 2, 0).copy()


class Edge(NamedTuple):
    """What the criteria must know of a staleness policy, and of the plant behind it."""

    predicts: bool = False
    """Is an outdated pose moved on by the plant's model (`predict`), or taken as it is (`hold`, `align`)?"""
    delta: float = 0.0
    """Error of the true speed: it is 1 + delta times the commanded one."""

    @property
    def is_exact(self) -> bool:
        """Does the edge know the error as well as if no pose were lost?"""
        return self.predicts and self.delta == 0.0

    def felt(self, gains: ControllerParameters) -> ControllerParameters:
        """The gains as the plant feels them: K_x times true over commanded speed."""
        return dataclasses.replace(gains, kx=gains.kx * (1.0 + self.delta))

    @classmethod
    def of(cls, scenario: Scenario) -> Edge:
        """That of a scenario's nodes. To first order a predictor that integrates otherwise than the plant is exact."""
        return cls(scenario.error_detector.policy == "predict", scenario.plant.speed_scale - 1.0)


HELD = Edge()
"""The paper's: the outdated pose as it is, and an AGV that drives what it is told."""


def seen(F: Floats, G: Floats, edge: Edge) -> tuple[Floats, Floats | None]:
    """G with the plant's true speed, and H of the policy, None for the identity; F and G of shape (..., m, m)."""
    model = F + G if edge.predicts else None
    if edge.delta != 0.0:
        G = G.copy()
        G[..., 0] *= 1.0 + edge.delta
    return G, model


def reachable(v_r: Floats, w_r: Floats) -> int:
    """How many of (x_e, y_e, theta_e) the commands can move on a track with these speeds: all 3 if it moves at all.

    A parked AGV reaches only x_e; one that turns on the spot mixes y_e into it and reaches 2. The rest stays as it is.
    """
    if np.any(v_r != 0.0):
        return 3
    return 2 if np.any(w_r != 0.0) else 1


def is_constant(v_r: Floats, w_r: Floats) -> bool:
    """Are the speeds of a track the same at all steps?"""
    return bool(np.ptp(v_r) == 0.0 and np.ptp(w_r) == 0.0)


def burst_maps(F: Floats, G: Floats, longest: int, H: Floats | None = None) -> Iterator[Floats]:
    """Maps of the error from one reception to the next, L = 1 .. longest steps later, each of the shape of F.

    Row k of the L-th is M_L(k): e(k + L) = M_L(k) e(k) if step k was received and the next L - 1 steps were lost:
    M_0 = I, M_{i+1}(k) = F(k+i) M_i(k) + G(k+i); at constant speeds M_L = F^L + sum_{i<L} F^i G. Rows of F and G,
    shape (N, m, m), are the steps of a lap that is driven again and again. With the H of a predictor, of the same
    shape, G(k+i) acts on H(k+i-1) ... H(k) instead of on the error as it was received.
    """
    steps = len(F)
    M = at_edge = np.broadcast_to(np.eye(F.shape[-1]), F.shape)
    for i in range(longest):
        now = (np.arange(steps) + i) % steps
        if H is None:
            M = F[now] @ M + G[now]
        else:
            M, at_edge = F[now] @ M + G[now] @ at_edge, H[now] @ at_edge
        yield M


def reception_maps(F: Floats, G: Floats, received: NDArray[np.int64], end: int, H: Floats | None = None) -> Floats:
    """Maps of the error from each reception to the next, and from the last to step `end`; shape (receptions, m, m).

    `received` holds the steps of the receptions, increasing; steps beyond the rows of F and G, shape (N, m, m), are
    those of further laps. H as of `burst_maps`.
    """
    maps = np.empty((len(received), *F.shape[1:]))
    F, G, H = (np.ascontiguousarray(M) for M in (F, G, F[:0] if H is None else H))
    compiled(_fill_in_maps)(F, G, H, received, np.diff(np.append(received, end)), maps)
    return maps


def _fill_in_maps(
    F: Floats, G: Floats, H: Floats, received: NDArray[np.int64], lengths: NDArray[np.int64], maps: Floats
) -> None:
    """`maps` of `reception_maps`; H has no row where it is the identity."""
    size = F.shape[1]
    M, at_edge, product = np.empty((size, size)), np.empty((size, size)), np.empty((size, size))
    for r in range(len(received)):
        M[:], at_edge[:] = np.eye(size), np.eye(size)
        for i in range(lengths[r]):
            k = (received[r] + i) % len(F)
            if len(H) == 0:
                product[:] = G[k]
            else:
                multiply(G[k], at_edge, False, product, False)
            multiply(F[k], M, False, product, True)
            M[:] = product
            if len(H) != 0:
                multiply(H[k], at_edge, False, product, False)
                at_edge[:] = product
        maps[r] = M


def loop_jacobians(
    pose: Floats, held: Floats, reference: Floats, gains: ControllerParameters, ts: float
) -> tuple[Floats, Floats]:
    """Derivatives of X_c(k+1) with respect to X_c(k) and to X_c(k-n), about any motion; each of shape (N, 3, 3).

    `pose` = X_c(k) and `held` = X_c(k-n) of shape (N, 3), `reference` = x, y, theta, v_r, w_r at step k, shape (N, 5),
    frame `map`. For Euler's step (the paper's eq. 100) under `kanayama` and `limit_speed`; a command at the limit
    does not answer to the error along the track. A(k) of eq. 55 is their sum at zero error.
    """
    theta, v_r = pose[:, 2], reference[:, 3]
    x_e, y_e, theta_e, v = np.array([_answer(r, h, gains) for r, h in zip(reference, held, strict=True)]).T
    free = (np.abs(v) < gains.v_max).astype(np.float64)
    zero = np.zeros(len(pose))
    now = np.broadcast_to(np.eye(3), (len(pose), 3, 3)).copy()
    now[:, 0, 2], now[:, 1, 2] = -ts * v * np.sin(theta), ts * v * np.cos(theta)
    command_of_error = np.array([
        [free * gains.kx, zero, -free * v_r * np.sin(theta_e)],
        [zero, v_r * gains.ky, v_r * gains.ktheta * np.cos(theta_e)],
    ])  # fmt: skip
    cos, sin = np.cos(held[:, 2]), np.sin(held[:, 2])
    error_of_pose = np.array([[-cos, -sin, y_e], [sin, -cos, -x_e], [zero, zero, zero - 1.0]])
    pose_of_command = ts * np.array([[np.cos(theta), zero], [np.sin(theta), zero], [zero, zero + 1.0]])
    return now, np.asarray(np.einsum("ijk,jlk,lmk->kim", pose_of_command, command_of_error, error_of_pose))


def _answer(reference: Floats, held: Floats, gains: ControllerParameters) -> tuple[float, float, float, float]:
    """The error that the edge sees at one step, and the speed that it commands."""
    x_r, y_r, theta_r, v_r, w_r = reference.tolist()
    x_e, y_e, theta_e = tracking_error(x_r, y_r, theta_r, *held.tolist())
    v, _ = kanayama(x_e, y_e, theta_e, v_r, w_r, gains.kx, gains.ky, gains.ktheta)
    return x_e, y_e, theta_e, limit_speed(v, gains.v_max)
