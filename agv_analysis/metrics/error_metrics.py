"""Metrics of one component of the error over a run, whatever has caused it: settling, overshoot, integrals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import compiled, numbers
from agv_analysis.metrics.bands import NEGLIGIBLE, SHARE, TOLERANCE
from agv_analysis.run import Floats
from agv_cloud.tracking_error import tracking_error


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


def body_errors(reference: Floats, pose: Floats) -> Floats:
    """eps(k) = T_e(theta_c(k)) [X_r(k) - X_c(k)] (the paper's eq. 3) at every step, shape (N, 3).

    `reference` has shape (N, 3) or more columns, of which the first three count; `pose` has shape (N, 3).
    """
    rows = np.empty((len(pose), 3))
    if len(rows):  # copies, so that all arrays are of one kind and one compilation serves them
        compiled(fill_errors)(numbers(np.array(reference[:, :3])), numbers(np.array(pose)), rows)
    return rows


def fill_errors(reference: Any, pose: Any, rows: Floats) -> None:
    """Fill in the tracking error of each pose, shapes (N, 3)."""
    for k in range(len(rows)):
        x_r, y_r, theta_r = reference[k]
        x_c, y_c, theta_c = pose[k]
        rows[k, 0], rows[k, 1], rows[k, 2] = tracking_error(x_r, y_r, theta_r, x_c, y_c, theta_c)


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
        settle_1cm_steps=settling_step(k, size, TOLERANCE),
        settle_2pct_steps=settling_step(k, size, SHARE * abs(initial)) if started else None,
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


def settling_step(k: NDArray[np.int64], size: Floats, band: float) -> int | None:
    """Steps from the first one until `size` stays below `band`, as `settling`; both of shape (N,)."""
    index = settling(size, band)
    return None if index is None else int(k[index] - k[0])


def _overshoot(e: Floats) -> float:
    return max(0.0, float(np.max(-e * np.sign(e[0])))) / abs(float(e[0]))


def sign_changes(e: Floats, band: float) -> int:
    """How often e, shape (N,), goes from above `band` to below `-band` or back, whatever it does in between."""
    sides = np.sign(e[np.abs(e) > band])
    return int(np.count_nonzero(np.diff(sides)))
