"""The loop to first order about its loss-free motion over a lap: the one thing that all criteria but the paper's take.

    z(k+1) = A(k) z(k) + B(k) u(k) + D(k) h(k),    u(k) = L_h(k) h(k) + L_z(k) z(k)

z = (x_e, y_e, theta_e, further states: driven speeds, steering angle, memory of the control law) is the deviation of
all states, u that of the command (v, w), and h the error that the edge takes for the current one. A fresh pose makes
it h(k) = C z(k), C = [I 0]: the first components of z. From then on it stays as it is (`hold`, `align`), or a predictor
moves it on by its model of the plant under the commands that it sent,

    h(k+1) = P_h(k) h(k) + P_u(k) u(k)

With u put in, which is all that most criteria ask for:

    z(k+1) = F z + G h,   F = A + B L_z,       G = B L_h + D
    h(k+1) = H h + K z,   H = P_h + P_u L_h,   K = P_u L_z      (without a fresh pose; held: H = I, K = 0)

The lap is driven again and again. Where the loop is the same at every step (constant speeds) the matrices have one row
for all of its steps.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats
from agv_analysis.stability.linearisation import command_matrices, plant_matrices
from agv_cloud.parameters import ControllerParameters
from agv_ros.counted import counted

MARGINAL = -1e-13
"""Growth per step (logarithm) that counts as none: round-off is 1e-16, and an error that stays is not stable."""

_ROUNDING = 1e-13
"""Difference of two matrices' entries of size 1 that is rounding alone."""


@dataclass(frozen=True, eq=False)
class LinearLoop:
    """The matrices of a lap of N steps; R is N, or 1 where the loop is the same at every step."""

    ts: float
    """Sampling period T_s [s]."""
    v_r: Floats
    """Speeds of the reference [m/s], shape (N,)."""
    w_r: Floats
    """Turning rates of the reference [rad/s], shape (N,)."""
    A: Floats
    """Shape (R, m, m). What the commands cannot reach is left out of z: of a parked AGV all but x_e."""
    B: Floats
    """Shape (R, m, 2)."""
    D: Floats
    """Shape (R, m, q), q <= m."""
    L_h: Floats
    """Shape (R, 2, q)."""
    L_z: Floats
    """Shape (R, 2, m)."""
    P_h: Floats | None = None
    """Shape (R, q, q); None for a policy that keeps the error of the pose that it holds."""
    P_u: Floats | None = None
    """Shape (R, q, 2), None with P_h."""
    nominal: Floats | None = None
    """States of the nominal motion, shape (R, all states), where they were computed; None: zero error."""
    active_limits: tuple[str, ...] = ()
    """A sentence for each limit that the nominal motion runs into."""
    not_differentiable: tuple[str, ...] = ()
    """Where a step has no derivative: the place in the code, and the first step of the lap concerned."""
    closed_form: ControllerParameters | None = None
    """Gains, K_x times true over commanded speed, if this is Kanayama's law and Euler's unicycle at zero error.

    Then the closed forms hold, those of a pose that is held.
    """

    def __post_init__(self) -> None:
        """Check the shapes. Raises ValueError."""
        rows, m, q = len(self.A), self.A.shape[-1], self.D.shape[-1]
        if rows not in (1, len(self.v_r)) or len(self.w_r) != len(self.v_r):
            raise ValueError(
                f"matrices must have 1 row or one for each of {counted(len(self.v_r), 'step')}, got {rows}"
            )
        if (self.P_h is None) != (self.P_u is None):
            raise ValueError("P_h and P_u belong together: the policy's model of the plant has both or neither")
        wanted = {
            "A": (m, m), "B": (m, 2), "D": (m, q), "L_h": (2, q), "L_z": (2, m), "P_h": (q, q), "P_u": (q, 2),
        }  # fmt: skip
        for name, shape in wanted.items():
            matrix = getattr(self, name)
            if matrix is not None and matrix.shape != (rows, *shape):
                raise ValueError(f"{name} must have the shape {(rows, *shape)}, got {matrix.shape}")

    @property
    def steps(self) -> int:
        """N, steps of the lap."""
        return len(self.v_r)

    @property
    def is_constant(self) -> bool:
        """Is the loop the same at all steps?"""
        return len(self.A) == 1

    @property
    def size(self) -> int:
        """m, number of states."""
        return int(self.A.shape[-1])

    @property
    def outputs(self) -> int:
        """q, how many of the states the edge's error consists of."""
        return int(self.D.shape[-1])

    @property
    def predicts(self) -> bool:
        """Is an outdated pose moved on by a model of the plant (`predict`), or kept (`hold`, `align`)?"""
        return self.P_h is not None

    @property
    def top_speed(self) -> float:
        """Largest |v_r| of the lap [m/s]."""
        return float(np.abs(self.v_r).max())

    @cached_property
    def F(self) -> Floats:
        """A + B L_z, shape (R, m, m)."""
        return np.ascontiguousarray(self.A + self.B @ self.L_z if self._feeds_back_states else self.A)

    @cached_property
    def G(self) -> Floats:
        """B L_h + D, shape (R, m, q)."""
        G = self.B @ self.L_h
        return np.ascontiguousarray(G + self.D if self.D.any() else G)

    @cached_property
    def H(self) -> Floats | None:
        """P_h + P_u L_h, shape (R, q, q); None where h is kept."""
        if self.P_h is None or self.P_u is None:
            return None
        return np.ascontiguousarray(self.P_h + self.P_u @ self.L_h)

    @cached_property
    def K(self) -> Floats | None:
        """P_u L_z, shape (R, q, m); None where it is zero: h is kept, or the law looks at h alone."""
        if self.P_u is None or not self._feeds_back_states:
            return None
        return np.ascontiguousarray(self.P_u @ self.L_z)

    @cached_property
    def _feeds_back_states(self) -> bool:
        return bool(self.L_z.any())

    @cached_property
    def innovation(self) -> tuple[Floats, Floats] | None:
        """(E_z, E_h), shapes (R, q, m) and (R, q, q): what a step of the plant does and the edge's model does not know.

        C z(k+1) - P_h C z(k) - P_u u(k) = E_z z(k) + E_h h(k). None where h is kept.
        """
        if self.P_h is None or self.P_u is None:
            return None
        q = self.outputs
        unknown = self.A[:, :q].copy()
        unknown[:, :, :q] -= self.P_h
        of_command = self.B[:, :q] - self.P_u
        of_h = self.D[:, :q] + of_command @ self.L_h
        return np.ascontiguousarray(unknown + of_command @ self.L_z), np.ascontiguousarray(of_h)

    @cached_property
    def is_exact(self) -> bool:
        """Does the edge know the error as well as if no pose were lost, once it has received one?"""
        return self.innovation is not None and all(
            np.abs(E).max() <= _ROUNDING * max(1.0, np.abs(self.A).max()) for E in self.innovation
        )

    @cached_property
    def along_gain(self) -> float | None:
        """a of x_e(k+1) = x_e(k) - a h_x(k): T_s K_x on a straight track; None where nothing of the kind holds."""
        if self.closed_form is not None:
            return self.ts * self.closed_form.kx
        if not self._along_is_apart or np.ptp(self.G[:, 0, 0]) > _ROUNDING:
            return None
        return float(-self.G[0, 0, 0])

    @property
    def _along_is_apart(self) -> bool:
        """Does x_e go its own way, as along a straight track with an immediate drive? Behind a predictor nothing is."""
        ahead, fed = self.F[:, 0] - np.eye(self.size)[0], self.G[:, 0, 1:]
        return not self.predicts and float(max(np.abs(ahead).max(), np.abs(fed).max(initial=0.0))) <= _ROUNDING

    def at(self, steps: NDArray[np.int64]) -> LinearLoop:
        """The loop at some steps of its lap, shape (n,), as a lap of its own."""
        rows = {
            name: matrix if matrix is None or self.is_constant else matrix[steps]
            for name in ("A", "B", "D", "L_h", "L_z", "P_h", "P_u")
            for matrix in [getattr(self, name)]
        }
        return dataclasses.replace(self, v_r=self.v_r[steps], w_r=self.w_r[steps], **rows)

    def thinned(self, places: int) -> LinearLoop:
        """The loop at every so many steps of its lap, at `places` of them at least.

        Speeds change little from one step to the next, so growth per step is nearly the same, in a share of the time.
        """
        stride = max(1, self.steps // places)
        return self if self.is_constant or stride == 1 else self.at(np.arange(0, self.steps, stride))

    def frozen(self, step: int) -> LinearLoop:
        """The loop that stays as it is at one step of the lap."""
        return self.at(np.array([step]))

    def without_along(self) -> LinearLoop:
        """The loop of all states but x_e, where that one goes its own way."""
        return dataclasses.replace(
            self, A=self.A[:, 1:, 1:], B=self.B[:, 1:], D=self.D[:, 1:, 1:], L_h=self.L_h[:, :, 1:],
            L_z=self.L_z[:, :, 1:], closed_form=None,
        )  # fmt: skip


def kanayama_loop(
    v_r: Floats, w_r: Floats, gains: ControllerParameters, ts: float, predicts: bool = False, speed_scale: float = 1.0
) -> LinearLoop:
    """Kanayama's law on Euler's unicycle about zero error, in closed form (see `linearisation`).

    Speeds v_r [m/s], w_r [rad/s] of shape (N,). The true speed is `speed_scale` times the commanded one; a predictor's
    model does not know of it. What the commands cannot reach on the whole lap is left out.
    """
    constant = np.ptp(v_r) == 0.0 and np.ptp(w_r) == 0.0
    v, w = (v_r[:1], w_r[:1]) if constant else (v_r, w_r)
    size = _reachable(v, w)
    A, B = (M[:, :size] for M in plant_matrices(v, w, ts))
    A, L_h = A[:, :, :size], command_matrices(v, gains)[:, :, :size]
    return LinearLoop(
        ts=ts, v_r=v_r, w_r=w_r, A=A, B=B if speed_scale == 1.0 else B * [speed_scale, 1.0],
        D=_zeros(len(v), size, size), L_h=L_h, L_z=_zeros(len(v), 2, size),
        P_h=A if predicts else None, P_u=B if predicts else None,
        closed_form=dataclasses.replace(gains, kx=gains.kx * speed_scale),
    )  # fmt: skip


def _reachable(v_r: Floats, w_r: Floats) -> int:
    """How many of (x_e, y_e, theta_e) the commands can move on a track with these speeds: all 3 if it moves at all.

    A parked AGV reaches only x_e; one that turns in place mixes y_e into it and reaches 2. The rest stays as it is.
    """
    if np.any(v_r != 0.0):
        return 3
    return 2 if np.any(w_r != 0.0) else 1


def _zeros(*shape: int) -> Floats:
    """Zeros of a shape that take no room; not to be written to."""
    return np.broadcast_to(np.zeros(()), shape)
