"""Noise of the increments between poses: a pose is off by white noise and by a random walk.

A localisation errs anew at each pose, an odometry adds up its errors. With the time dt(i) between poses, its mean m,
and the share `white` in [0, 1), the increments r have the covariance

    s^2 [(1 - white) diag(dt / m) + white T],    T = tridiag(-1, 2, -1),

which is bidiagonal times its transpose; so increments are made white by a recursion.
"""

from __future__ import annotations

import math

import numpy as np

from agv_analysis.identify.linear_recursion import Recursion
from agv_analysis.run import Floats

_SHARES = 1.0 - np.geomspace(1.0, 1e-5, 16)


class IncrementNoise:
    """The covariance for a share of white noise, as a filter that makes increments white."""

    def __init__(self, dt: Floats, white: float) -> None:
        self.white = white
        variances = ((1.0 - white) * dt / dt.mean() + 2.0 * white).tolist()
        pivots = [variances[0]]
        for variance in variances[1:]:
            pivots.append(variance - white * white / pivots[-1])
        pivot = np.array(pivots)
        self.log_determinant = float(np.log(pivot).sum())
        self._scale = 1.0 / np.sqrt(pivot)
        self._recursion = Recursion(np.concatenate(([0.0], white / np.sqrt(pivot[1:] * pivot[:-1]))))

    def whitened(self, increments: Floats) -> Floats:
        """Increments of shape (..., N) with the covariance s^2 times the unit matrix."""
        return self._recursion(increments * self._scale)


def fitted_noise(residuals: Floats, dt: Floats) -> IncrementNoise:
    """The noise under which residuals, shape (N,), are most likely."""
    noises = [IncrementNoise(dt, float(share)) for share in _SHARES]
    return min(noises, key=lambda noise: _deviance(noise, residuals))


def _deviance(noise: IncrementNoise, residuals: Floats) -> float:
    white = noise.whitened(residuals)
    return len(residuals) * math.log(max(float(white @ white), 1e-300)) + noise.log_determinant
