"""The reference X_r(k): a track's speeds integrated by the plant's own recursion.

The same Euler step with the same order of operations as the plant: an AGV that starts on the reference and hears every
command stays on it to the last bit. A reference sampled from continuous time would leave 0.6 mm after a lap.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_cloud.parameters import ErrorDetectorParameters
from agv_cloud.track_file import load_track
from agv_cloud.tracks import TRACKS, Speeds
from agv_plant.unicycle import euler_step


class ReferencePoint(NamedTuple):
    """The reference at one step: posture in frame `map` [m, m, rad] and speeds [m/s, rad/s]."""

    x: float
    y: float
    theta: float
    v: float
    w: float


def speeds_of(parameters: ErrorDetectorParameters) -> Callable[[int], Speeds]:
    """Speeds (v_r, w_r) by step of the track that the parameters name. Raises TrackFileError for a bad file."""
    ts = parameters.ts
    if parameters.track == "csv":
        profile = load_track(parameters.track_file)
        return lambda k: profile(k * ts)
    track, steps, speed = TRACKS[parameters.track], lap_steps(parameters), parameters.speed
    return lambda k: track(k, steps, ts, speed)


def lap_steps(parameters: ErrorDetectorParameters) -> int:
    """Number of steps N of one lap."""
    return round(parameters.lap_time / parameters.ts)


class Reference:
    """X_r by step; computed as far as it was asked for, and kept."""

    def __init__(self, parameters: ErrorDetectorParameters) -> None:
        self._speeds = speeds_of(parameters)
        self._ts = parameters.ts
        self._points = [ReferencePoint(*parameters.track_start, *self._speeds(0))]

    def __getitem__(self, k: int) -> ReferencePoint:
        """The reference at step k >= 0."""
        points = self._points
        while len(points) <= k:
            last = points[-1]
            posture = euler_step(last.x, last.y, last.theta, last.v, last.w, self._ts)
            points.append(ReferencePoint(*posture, *self._speeds(len(points))))
        return points[k]

    def first(self, steps: int) -> NDArray[np.float64]:
        """The steps 0 .. steps - 1 as an array, shape (steps, 5), columns x, y, theta, v, w."""
        if steps:
            self[steps - 1]
        return np.array(self._points[:steps], dtype=np.float64).reshape(-1, 5)
