"""Loops with more states than the error, and one step of any loop as its definition says, for the tests of criteria."""

from __future__ import annotations

import math

import numpy as np

from agv_analysis.run import Floats
from agv_analysis.stability.linear_loop import LinearLoop, kanayama_loop
from agv_cloud.parameters import ControllerParameters

TS = 0.005

KINDS = ("held", "held with memory", "predicted", "predicted with memory", "one state", "all states seen")
"""Of `random_loop`."""


def random_loop(kind: str, steps: int, rows: int, seed: int = 3, gain: float = 0.4) -> LinearLoop:
    """A contracting plant with random matrices everywhere, at `steps` steps (`rows` 1: all alike)."""
    random = np.random.default_rng(seed)
    m, q = {"one state": (1, 1), "all states seen": (3, 3)}.get(kind, (5, 3))

    def normal(scale: float, *shape: int) -> Floats:
        return np.asarray(scale * random.standard_normal((rows, *shape)))

    memory, predicts = kind.endswith("memory"), kind.startswith("predicted")
    A, B = 0.9 * np.eye(m) + normal(0.08, m, m), normal(0.3, m, 2)
    return LinearLoop(
        ts=TS, v_r=np.ones(steps), w_r=np.zeros(steps), A=A, B=B, D=normal(0.1 if memory else 0.0, m, q),
        L_h=normal(gain, 2, q), L_z=normal(0.3 if memory else 0.0, 2, m),
        P_h=A[:, :q, :q] + normal(0.03, q, q) if predicts else None,
        P_u=B[:, :q] + normal(0.1, q, 2) if predicts else None,
    )  # fmt: skip


def lagged_loop(
    v_r: Floats, w_r: Floats, gains: ControllerParameters, lag: float, predicts: bool = False, forgets: float = 1.0
) -> LinearLoop:
    """Kanayama's law on a unicycle whose speeds follow the command as a first-order lag: z = (e, v, w), m = 5.

    The law filters the error with the share `forgets` of the newest one; below 1 its memory makes m = 8. A predictor's
    model knows of neither. Lag in seconds.
    """
    plain = kanayama_loop(v_r, w_r, gains, TS)
    rows, follows = len(plain.A), -math.expm1(-TS / lag)
    stays, nothing = np.broadcast_to((1.0 - follows) * np.eye(2), (rows, 2, 2)), np.zeros((rows, 2, 3))
    A = np.block([[plain.A, plain.B * (1.0 - follows)], [nothing, stays]])
    B = follows * np.concatenate((plain.B, np.broadcast_to(np.eye(2), (rows, 2, 2))), axis=1)
    D, L_h, L_z = np.zeros((rows, 5, 3)), plain.L_h, np.zeros((rows, 2, 5))
    if forgets < 1.0:
        keeps = np.broadcast_to((1.0 - forgets) * np.eye(3), (rows, 3, 3))
        zero = np.zeros((rows, 5, 3))
        A = np.block([[A, zero], [np.swapaxes(zero, 1, 2), keeps]])
        B = np.concatenate((B, np.zeros((rows, 3, 2))), axis=1)
        D = np.concatenate((D, np.broadcast_to(forgets * np.eye(3), (rows, 3, 3))), axis=1)
        L_h, L_z = forgets * plain.L_h, np.concatenate((L_z, (1.0 - forgets) * plain.L_h), axis=2)
    model = (plain.A, plain.B) if predicts else (None, None)
    return LinearLoop(TS, v_r, w_r, A=A, B=B, D=D, L_h=L_h, L_z=L_z, P_h=model[0], P_u=model[1])


def step(loop: LinearLoop, k: int, z: Floats, h: Floats, received: bool) -> tuple[Floats, Floats]:
    """(z, h) of step k + 1 from those of step k, columns side by side."""
    row = k % len(loop.A)
    if received:
        h = z[: loop.outputs]
    u = loop.L_h[row] @ h + loop.L_z[row] @ z
    moved_on = h if loop.P_h is None or loop.P_u is None else loop.P_h[row] @ h + loop.P_u[row] @ u
    return loop.A[row] @ z + loop.B[row] @ u + loop.D[row] @ h, moved_on


def delayed_step(
    loop: LinearLoop, k: int, n: int, states: list[Floats], commands: list[Floats]
) -> tuple[Floats, Floats]:
    """(z(k+1), u(k)) from z(k-n) .. z(k) and u(k-n) .. u(k-1), a prediction made anew from the oldest state."""
    h, rows = states[0][: loop.outputs], len(loop.A)
    if loop.P_h is not None and loop.P_u is not None:
        for j, u in enumerate(commands):
            h = loop.P_h[(k - n + j) % rows] @ h + loop.P_u[(k - n + j) % rows] @ u
    row, z = k % rows, states[-1]
    u = loop.L_h[row] @ h + loop.L_z[row] @ z
    return loop.A[row] @ z + loop.B[row] @ u + loop.D[row] @ h, u


def delayed_multipliers(loop: LinearLoop, n: int, steps: int) -> Floats:
    """Moduli of the multipliers of so many steps with a pose that is always n steps old, largest first.

    By the dense matrix of (z(k-n) .. z(k), u(k-n) .. u(k-1)), unit vector by unit vector.
    """
    size, m = (n + 1) * loop.size + 2 * n, loop.size
    now = np.eye(size)
    for k in range(steps):
        states = [now[i * m : (i + 1) * m] for i in range(n + 1)]
        commands = [now[(n + 1) * m + 2 * i : (n + 1) * m + 2 * i + 2] for i in range(n)]
        z, u = delayed_step(loop, k, n, states, commands)
        now = np.concatenate([*states[1:], z, *[*commands, u][1:]])
    return np.sort(np.abs(np.linalg.eigvals(now)))[::-1]


def recursion(maps: list[tuple[float, Floats]]) -> Floats:
    """Matrix of X -> sum of p A X A' over (p, A), column by column."""
    size = len(maps[0][1])
    columns = []
    for unit in np.eye(size * size):
        X = unit.reshape(size, size)
        columns.append(np.sum([p * A @ X @ A.T for p, A in maps], axis=0).ravel())
    return np.asarray(np.array(columns).T)
