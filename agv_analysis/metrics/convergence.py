"""How a run's error converges: settling, overshoot, integrals, and how the command is damped.

A run judges itself only as far as it goes: an error that has settled when the run ends may leave its band afterwards.
What a run cannot say is None: the share of an initial error of zero, the settling that did not happen, the damping of a
command that did not move or that ended too early.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats, Run
from agv_cloud.tracking_error import tracking_error
from agv_ros.errors import UserError

TOLERANCE = 0.01
"""Absolute band of settling: 1 cm; 0.01 rad for an angle."""

SHARE = 0.02
"""Relative band of settling: 2 % of the initial error, or of the largest deviation of a command."""

NEGLIGIBLE = 1e-9
"""An initial error up to this size [m, rad] is rounding, of which no share is taken."""

CRITICAL_TIME = 0.25
"""Longest settling [s] of a critically damped command after its last saturated sample."""


@dataclass(frozen=True)
class ErrorMetrics:
    """Metrics of one component of the error over a run; in m, for an angle in rad.

    Steps count from the first step of the run. A step whose error is not finite lies outside every band.
    """

    initial: float
    final: float
    peak: float
    """Largest absolute value."""
    settle_1cm_steps: int | None
    """First step from which on |e| is below 1 cm (0.01 rad); None if that did not happen."""
    settle_2pct_steps: int | None
    """First step from which on |e| is below 2 % of its initial value; None if that did not happen or e began at 0."""
    overshoot: float | None
    """Largest error on the other side of zero as a share of the initial one; None if that is 0."""
    sign_changes: int
    """How often e went from beyond 1 cm (0.01 rad) on one side to beyond it on the other."""
    iae: float
    """Integral of |e| over time, [m s]: T_s sum |e(k)|."""
    ise: float
    """Integral of e^2 over time, [m^2 s]; inf where it overflows."""


@dataclass(frozen=True)
class Convergence:
    """Convergence of one run.

    The paper plots the global y error and writes of the one in the AGV's frame: here are both, apart. All errors are
    the true ones at each step, X_r(k) - X_c(k), not those that the edge computed from an outdated pose.
    """

    y: ErrorMetrics
    """y_r - y_c in frame `map` [m], the error of the paper's figures."""
    x_e: ErrorMetrics
    """Error along the AGV [m], in its frame."""
    y_e: ErrorMetrics
    """Error across the AGV [m], in its frame."""
    theta_e: ErrorMetrics
    """Error of heading [rad], in (-pi, pi]."""
    position: ErrorMetrics
    """Distance between AGV and reference [m]; it has no sign, hence neither overshoot nor changes of sign."""
    damping: str | None
    """Damping class of the command: `over`, `critical`, `under`; None if the run cannot tell."""

    @property
    def settle_1cm_steps(self) -> int | None:
        """First step from which on |y_r - y_c| is below 1 cm."""
        return self.y.settle_1cm_steps

    @property
    def settle_2pct_steps(self) -> int | None:
        """First step from which on |y_r - y_c| is below 2 % of its initial value."""
        return self.y.settle_2pct_steps

    @property
    def overshoot(self) -> float | None:
        """Overshoot of y_r - y_c as a share of its initial value."""
        return self.y.overshoot


def convergence(run: Run, critical_time: float = CRITICAL_TIME) -> Convergence:
    """Convergence of a run. Raises UserError if the run has no step.

    `critical_time` [s] is the border between a critically and an over-damped command, see `damping`.
    """
    if not len(run):
        raise UserError(f"{run.source}: no step of the loop in it, so nothing converges: record at least one")
    true = run.reference[:, :3] - run.pose
    body = body_errors(run.reference, run.pose)
    return Convergence(
        y=error_metrics(run.k, true[:, 1], run.ts),
        x_e=error_metrics(run.k, body[:, 0], run.ts),
        y_e=error_metrics(run.k, body[:, 1], run.ts),
        theta_e=error_metrics(run.k, wrapped(body[:, 2]), run.ts),
        position=error_metrics(run.k, np.hypot(true[:, 0], true[:, 1]), run.ts),
        damping=damping(
            run.time, run.command[:, 0], run.reference[:, 3], run.scenario.controller.v_max, critical_time
        ),
    )  # fmt: skip


def body_errors(reference: Floats, pose: Floats) -> Floats:
    """eps(k) = T_e(theta_c(k)) [X_r(k) - X_c(k)] (the paper's eq. 10) at every step, shape (N, 3).

    `reference` has shape (N, 3) or more columns, of which the first three count; `pose` has shape (N, 3).
    """
    rows = zip(reference[:, :3].tolist(), pose.tolist(), strict=True)
    return np.array([tracking_error(*x_r, *x_c) for x_r, x_c in rows], dtype=np.float64).reshape(-1, 3)


def wrapped(angle: Floats) -> Floats:
    """Angles [rad] brought into (-pi, pi]."""
    return np.asarray(np.pi - np.mod(np.pi - angle, 2.0 * np.pi))


def error_metrics(k: NDArray[np.int64], e: Floats, ts: float) -> ErrorMetrics:
    """Metrics of an error e(k) at the steps k, shapes (N,), N >= 1, with sampling period `ts` [s]."""
    initial, size = float(e[0]), np.abs(e)
    started = abs(initial) > NEGLIGIBLE
    with np.errstate(over="ignore"):
        iae, ise = float(np.sum(size) * ts), float(np.sum(e * e) * ts)
    return ErrorMetrics(
        initial=initial,
        final=float(e[-1]),
        peak=float(np.max(size)),
        settle_1cm_steps=_settling_step(k, size, TOLERANCE),
        settle_2pct_steps=_settling_step(k, size, SHARE * abs(initial)) if started else None,
        overshoot=_overshoot(e) if started else None,
        sign_changes=sign_changes(e, TOLERANCE),
        iae=iae,
        ise=ise,
    )


def settling(size: Floats, band: float) -> int | None:
    """First index from which on `size`, shape (N,), stays below `band`; None if its last value is not below."""
    outside = np.flatnonzero(~(size < band))  # so written, NaN is outside
    first = int(outside[-1]) + 1 if len(outside) else 0
    return first if first < len(size) else None


def _settling_step(k: NDArray[np.int64], size: Floats, band: float) -> int | None:
    index = settling(size, band)
    return None if index is None else int(k[index] - k[0])


def _overshoot(e: Floats) -> float:
    return max(0.0, float(np.max(-e * np.sign(e[0])))) / abs(float(e[0]))


def sign_changes(e: Floats, band: float) -> int:
    """How often e, shape (N,), goes from above `band` to below `-band` or back, whatever it does in between."""
    sides = np.sign(e[np.abs(e) > band])
    return int(np.count_nonzero(np.diff(sides)))


def damping(time: Floats, v: Floats, v_r: Floats, v_max: float, critical_time: float = CRITICAL_TIME) -> str | None:
    """Damping class of a command v(k) [m/s] around the reference's speed v_r(k), at the times t_k [s]; shapes (N,).

    With d = v - v_r and b = 2 % of max |d|: `under` if d goes from beyond b on one side of zero to beyond b on the
    other; else `critical` if d settles to within b at most `critical_time` [s] after the last saturated sample
    (|v| = v_max) or, where nothing was saturated, after the first; else `over`. The loop along the track is of first
    order (pole 1 - T_s K_x), where the textbook's damping ratio has no meaning; hence this operational definition.

    Samples without a command (NaN) are left out. None if d is zero throughout, or if the run ends, unsettled, before
    `critical_time` is over.
    """
    sent = np.isfinite(v)
    time, v, d = time[sent], v[sent], v[sent] - v_r[sent]
    band = SHARE * float(np.max(np.abs(d), initial=0.0))
    if band == 0.0:
        return None
    if sign_changes(d, band):
        return "under"
    settled = settling(np.abs(d), band)
    saturated = np.flatnonzero(np.abs(v[:settled]) >= v_max)
    free = float(time[saturated[-1]] if len(saturated) else time[0])
    lasts = float(time[-1] if settled is None else time[settled]) - free
    if lasts > critical_time:
        return "over"
    return None if settled is None else "critical"
