"""Deviations of whole paths, and how much of a corridor they use: as `widths`, for arrays."""

from __future__ import annotations

import numpy as np

from agv_analysis.corridor.widths import Widths
from agv_analysis.metrics.error_metrics import body_errors
from agv_analysis.run import Floats


def path_deviation(pose: Floats, reference: Floats) -> tuple[Floats, Floats]:
    """Deviation along and across the track [m], ahead and left positive, each of shape (N,).

    Poses of shape (N, 3) and the reference, shape (N, 3) or with more columns, in frame `map`.
    """
    along, across, _ = body_errors(pose, reference[:, :3]).T  # where the AGV is, seen from the reference
    return along, across


def along_and_across(errors: Floats) -> tuple[Floats, Floats]:
    """The same from errors x_e, y_e, theta_e of shape (..., 3): where the reference is, seen from the AGV."""
    x_e, y_e, theta_e = np.moveaxis(errors, -1, 0)
    cos, sin = np.cos(theta_e), np.sin(theta_e)
    return -cos * x_e - sin * y_e, sin * x_e - cos * y_e


def shares_of(along: Floats, across: Floats, widths: Widths) -> Floats:
    """How much of the corridor deviations use, any shape; NaN where they are not numbers."""
    return np.asarray(
        np.maximum(
            np.hypot(along, across) / widths.distance,
            np.maximum(np.abs(along) / widths.along, np.abs(across) / widths.across),
        )
    )


def path_shares(pose: Floats, reference: Floats, widths: Widths) -> Floats:
    """How much of the corridor a path uses at each step, shape (N,); inf where the AGV's pose is not a number."""
    with np.errstate(invalid="ignore", over="ignore"):
        found = shares_of(*path_deviation(pose, reference), widths)
    return np.where(np.isfinite(found), found, np.inf)
