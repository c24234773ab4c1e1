"""The reference X_r(k): a track's speeds integrated by the plant's own recursion.

The same Euler step with the same order of operations as the plant: an AGV that starts on the reference and hears every
command stays on it to the last bit. A reference sampled from continuous time would leave 0.6 mm after a lap.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from agv_cloud.parameters import CSV, PATH, ErrorDetectorParameters
from agv_cloud.reference.point import ReferencePoint
from agv_cloud.reference.track_file import load_track
from agv_cloud.reference.tracks import TRACKS, Speeds
from agv_plant.vehicle.unicycle import euler_step
from agv_ros.errors import UserError


def speeds_of(parameters: ErrorDetectorParameters) -> Callable[[int], Speeds]:
    """Speeds (v_r, w_r) by step of the track that the parameters name.

    Raises TrackFileError for a bad file, UserError for a track that is not known in advance.
    """
    ts = parameters.ts
    if parameters.track == PATH:
        raise UserError(
            "error_detector.track is path: the reference comes on edge/path while the loop runs, so it is not known "
            f"here: name another track ({', '.join((*TRACKS, CSV))})"
        )
    if parameters.track == CSV:
        profile = load_track(parameters.track_file)
        return lambda k: profile(k * ts)
    track, steps, speed = TRACKS[parameters.track], lap_steps(parameters), parameters.speed
    return lambda k: track(k, steps, ts, speed)


def lap_steps(parameters: ErrorDetectorParameters) -> int:
    """Number of steps N of one lap."""
    return round(parameters.lap_time / parameters.ts)


_BLOCK = 256
_KEPT_BLOCKS = 64


class Reference:
    """X_r by step, in whatever order it is asked for, in little memory however long the run.

    Where each block of steps begins is kept, and the points of the last 64 blocks that were computed.
    """

    def __init__(self, parameters: ErrorDetectorParameters) -> None:
        self._speeds = speeds_of(parameters)
        self._ts = parameters.ts
        self._begins = [parameters.track_start]
        self._blocks: dict[int, list[ReferencePoint]] = {}

    def __getitem__(self, k: int) -> ReferencePoint:
        """The reference at step k >= 0."""
        return self._block(k // _BLOCK)[k % _BLOCK]

    def first(self, steps: int) -> NDArray[np.float64]:
        """The steps 0 .. steps - 1 as an array, shape (steps, 5), columns x, y, theta, v, w."""
        return np.array([self[k] for k in range(steps)], dtype=np.float64).reshape(-1, 5)

    def _block(self, number: int) -> list[ReferencePoint]:
        while number not in self._blocks:
            self._integrate(min(number, len(self._begins) - 1))
        return self._blocks[number]

    def _integrate(self, number: int) -> None:
        """Compute a block, and with it where the next one begins."""
        points, posture = [], self._begins[number]
        for k in range(number * _BLOCK, (number + 1) * _BLOCK):
            speeds = self._speeds(k)
            points.append(ReferencePoint(*posture, *speeds))
            posture = euler_step(*posture, *speeds, self._ts)
        if len(self._blocks) == _KEPT_BLOCKS:
            del self._blocks[next(iter(self._blocks))]
        self._blocks[number] = points
        if number + 1 == len(self._begins):
            self._begins.append(posture)
