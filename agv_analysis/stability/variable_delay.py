"""Floquet multiplier of a run whose poses came late, out of order, or not at all.

Whatever the channel did, step k was answered from the pose of step k - n(k), and the first step from a fresh one. So
the error follows

    e(k+1) = F(k) e(k) + G(k) e(k - n(k)),   n(k) <= k,

and all of it depends on e(0) alone: the run is one linear map of the error before it to the error after it, whose
largest eigenvalue says how the error grows if the same speeds and the same ages come again and again. With n constant
it tends to the lifted system's, with n a sawtooth it is the one of `floquet.drop_sequence`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled import compiled
from agv_analysis.run import Floats
from agv_analysis.stability.linearisation import HELD, Edge, reachable, seen, step_matrices
from agv_cloud.parameters import ControllerParameters


def age_sequence(
    n: NDArray[np.int64], v_r: Floats, w_r: Floats, gains: ControllerParameters, ts: float, edge: Edge = HELD
) -> float:
    """Largest growth (logarithm) of the error over the recorded steps, for a pose that is held as it is.

    Ages n [steps] and speeds v_r [m/s], w_r [rad/s] of shape (N,); where an age reaches back to before the first step,
    the first pose stands for the older one.
    """
    size = reachable(v_r, w_r)
    F, G = (M[:, :size, :size] for M in step_matrices(v_r, w_r, gains, ts))
    G, _ = seen(F, G, edge)
    errors = np.zeros((len(n) + 1, size, size))
    errors[0] = np.eye(size)
    ages = np.minimum(n, np.arange(len(n)))
    log_scale = compiled(_follow)(np.ascontiguousarray(F), np.ascontiguousarray(G), ages, errors)
    radius = float(np.abs(np.linalg.eigvals(errors[-1])).max())
    return log_scale + math.log(radius) if radius > 0.0 else -math.inf


def _follow(F: Floats, G: Floats, ages: NDArray[np.int64], errors: Floats) -> float:
    """Errors of all steps from those of the first, shape (N + 1, m, m), to be multiplied by exp(return value)."""
    log_scale, size = 0.0, errors.shape[1]
    for k in range(len(ages)):
        largest, held = 0.0, errors[k - ages[k]]
        for i in range(size):
            for j in range(size):
                value = 0.0
                for m in range(size):
                    value += F[k, i, m] * errors[k, m, j] + G[k, i, m] * held[m, j]
                errors[k + 1, i, j] = value
                largest = max(largest, abs(value))
        if largest > 1e100 or 0.0 < largest < 1e-100:
            errors[: k + 2] /= largest
            log_scale += math.log(largest)
    return log_scale
