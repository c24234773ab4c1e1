"""How far a robot moved from pose to pose: forwards, and in heading."""

from __future__ import annotations

import numpy as np

from agv_analysis.identify.fit import Increments
from agv_analysis.run import Floats


def turned(t: Floats, theta: Floats) -> Increments:
    """Increments of the heading [rad]; shapes (N + 1,), theta counts turns."""
    return Increments(t, np.diff(theta))


def moved_forwards(t: Floats, x: Floats, y: Floats, theta: Floats, heading_noise: float) -> Increments:
    """Lengths of the arcs [m] from pose to pose, positive forwards; shapes (N + 1,).

    The chord of an arc points along its mean heading and is sin(a) / a times as long as the arc, a being half of the
    turn. `heading_noise`: standard deviation [rad] of white noise in theta, by which chords look shorter.
    """
    half = 0.5 * np.diff(theta)
    mean = theta[:-1] + half
    along = np.diff(x) * np.cos(mean) + np.diff(y) * np.sin(mean)
    # The mean of two headings has half of the variance s^2 of one, and E[cos] = exp(-s^2 / 4).
    return Increments(t, along / np.sinc(half / np.pi) * np.exp(0.25 * heading_noise**2))
