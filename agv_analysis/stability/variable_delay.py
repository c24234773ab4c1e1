"""Floquet multiplier of a run whose poses came late, out of order, or not at all.

Whatever the channel did, step k was answered from the pose of step k - n(k), and the first step from a fresh one. So
the error follows

    z(k+1) = F(k) z(k) + G(k) C z(k - n(k)),   n(k) <= k,

and all of it depends on z(0) alone: the run is one linear map of the state before it to the state after it, whose
largest eigenvalue says how the error grows if the same speeds and the same ages come again and again. With n constant
it tends to the lifted system's, with n a sawtooth it is the one of `floquet.drop_sequence`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import compiled
from agv_analysis.run import Floats
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.products import divide, largest_entry, multiply


def age_sequence(loop: LinearLoop, n: NDArray[np.int64]) -> float:
    """Largest growth (logarithm) of the error over the recorded steps, for a pose that is held as it is.

    Ages n [steps] of shape (N,); where an age reaches back to before the first step, the first pose stands for the
    older one. Raises ValueError for a loop that predicts.
    """
    if loop.predicts:
        raise ValueError("late poses are judged where they are held, not where they are predicted")
    states = np.zeros((len(n) + 1, loop.size, loop.size))
    states[0] = np.eye(loop.size)
    ages = np.minimum(n, np.arange(len(n)))
    log_scale = compiled(_follow)(loop.F, loop.G, ages, states)
    radius = float(np.abs(np.linalg.eigvals(states[-1])).max())
    return log_scale + math.log(radius) if radius > 0.0 else -math.inf


def _follow(F: Floats, G: Floats, ages: NDArray[np.int64], states: Floats) -> float:
    """States of all steps from those of the first, shape (N + 1, m, m), to be multiplied by exp(return value)."""
    log_scale, outputs = 0.0, G.shape[2]
    for k in range(len(ages)):
        row = k % F.shape[0]
        multiply(F[row], states[k], False, states[k + 1], False)
        multiply(G[row], states[k - ages[k], :outputs], False, states[k + 1], True)
        largest = largest_entry(states[k + 1])
        if largest > 1e100 or 0.0 < largest < 1e-100:
            for j in range(k + 2):
                divide(states[j], largest)
            log_scale += math.log(largest)
    return log_scale
