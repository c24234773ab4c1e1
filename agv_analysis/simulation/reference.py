"""The reference of a whole run, compiled: that of `agv_cloud.reference.reference`, bit for bit."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np

from agv_analysis.compiled.functions import compiled
from agv_analysis.run import Floats
from agv_cloud.parameters import ErrorDetectorParameters
from agv_cloud.reference.reference import Reference, lap_steps
from agv_cloud.reference.tracks import TRACKS
from agv_plant.vehicle.unicycle import euler_step


def reference_of(detector: ErrorDetectorParameters, steps: int) -> Floats:
    """A reference track's first steps, shape (steps, 5); kept, since many runs ask for the same. Not to be written to.

    Raises TrackFileError for a bad track file.
    """
    return _reference(detector, steps, _edition(detector.track_file))


@functools.lru_cache(maxsize=8)
def _reference(detector: ErrorDetectorParameters, steps: int, edition: object) -> Floats:
    if detector.track not in TRACKS:
        return Reference(detector).first(steps)
    points = np.empty((steps, 5))
    drive = compiled(drive_all, {track: TRACKS[detector.track]})
    drive(points, detector.track_start, lap_steps(detector), detector.ts, detector.speed)
    return points


def repeated(rows: Floats, steps: int, ts: float) -> Floats:
    """A reference, shape (n, 5), that goes on after its last row with the speeds from its first on, shape (steps, 5).

    By Euler's steps of `ts` [s], as if it were driven again and again, whether it closes or not.
    """
    known = min(len(rows), steps)
    speeds = np.resize(rows[:, 3:], (steps, 2))
    x, y, theta = rows[known - 1, :3]
    v, w = speeds[known - 1 : steps - 1].T
    headings = theta + ts * np.concatenate(([0.0], np.cumsum(w)))
    further = np.column_stack((
        x + ts * np.cumsum(v * np.cos(headings[:-1])),
        y + ts * np.cumsum(v * np.sin(headings[:-1])),
        headings[1:],
    ))  # fmt: skip
    poses = np.concatenate((rows[:known, :3], further))
    return np.ascontiguousarray(np.column_stack((poses, speeds)))


def _edition(path: str) -> object:
    """What changes when a file does; None if there is no such file."""
    try:
        found = Path(path).stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


track: Any = TRACKS["line"]
"""The track that `drive_all` is compiled for; by default a straight line."""


def drive_all(points: Floats, start: tuple[float, float, float], lap: int, ts: float, speed: float) -> None:
    """Fill in the reference at the steps 0 .. N - 1, shape (N, 5), columns x, y, theta, v, w."""
    x, y, theta = start
    for k in range(len(points)):
        v, w = track(k, lap, ts, speed)
        points[k, 0], points[k, 1], points[k, 2], points[k, 3], points[k, 4] = x, y, theta, v, w
        x, y, theta = euler_step(x, y, theta, v, w, ts)
