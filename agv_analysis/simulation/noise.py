"""Random numbers of the AGV on a whole run, compiled: those of its node, bit for bit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import compiled, numbers
from agv_analysis.run import Floats
from agv_analysis.simulation.loop import Rows
from agv_plant.random_stream import DRAWS, normal_pair, uniforms
from agv_plant.vehicle.motion import measured


def normals(seed: int, stream: str, steps: int) -> Floats:
    """Standard normal numbers of the steps 0 .. steps - 1, shape (steps, DRAWS), as `random_stream.normals_of`."""
    found = np.empty((steps, DRAWS))
    compiled(_fill)(numbers(uniforms(seed, stream, 0, steps)), found)
    return found


def _fill(random: Rows, found: NDArray[np.float64]) -> None:
    for k in range(len(random)):
        found[k, 0], found[k, 1] = normal_pair(random[k][0], random[k][1])
        found[k, 2], found[k, 3] = normal_pair(random[k][2], random[k][3])


def measurements(pose: Floats, noise: Rows, noise_xy: float, noise_theta: float) -> Floats:
    """Poses as the AGV measures them, from the true ones, shape (N, 3), and normal numbers of N steps or more."""
    found = np.empty_like(pose)
    compiled(_measure)(numbers(pose), noise, noise_xy, noise_theta, found)
    return found


def _measure(pose: Rows, noise: Rows, noise_xy: float, noise_theta: float, found: NDArray[np.float64]) -> None:
    for k in range(len(pose)):
        x, y, theta = pose[k]
        n_x, n_y, n_theta, _ = noise[k]
        found[k, 0], found[k, 1], found[k, 2] = measured(x, y, theta, n_x, n_y, n_theta, noise_xy, noise_theta)
