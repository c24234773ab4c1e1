"""Poses of a bag as TUM trajectories, which evo and other tools for trajectories read.

Source: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats: a line `timestamp tx ty tz qx qy qz qw` for each
pose, in seconds, metres, and as a unit quaternion.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags.layout import LOG_TIME, length_path
from agv_ros.stamps import NS_PER_S

_FORMS = (("position", "orientation"), ("translation", "rotation"))
_AXES = ("x", "y", "z")


class Trajectory(NamedTuple):
    """Poses over time."""

    name: str
    """Child frame, where a topic holds the poses of several; else empty."""
    times: NDArray[np.int64]
    """Stamps [ns], or log times where messages have no stamp; shape (N,)."""
    poses: NDArray[np.float64]
    """x, y, z [m], then the quaternion's x, y, z, w; shape (N, 7)."""

    def lines(self) -> Iterator[str]:
        """As text, every number in full."""
        for ns, pose in zip(self.times.tolist(), self.poses.tolist(), strict=True):
            sign = "-" if ns < 0 else ""
            seconds, rest = divmod(abs(ns), NS_PER_S)
            yield f"{sign}{seconds}.{rest:09d} {' '.join(map(repr, pose))}"


def trajectories_of(rows: NDArray[np.void]) -> Iterator[Trajectory]:
    """The trajectories in the messages of a topic; none if they hold no poses. Poses must be finite to be in one."""
    names = rows.dtype.names or ()
    for place, turn in _FORMS:
        for name in names:
            prefix = name.removesuffix(f"{place}.x")
            columns = [f"{prefix}{place}.{axis}" for axis in _AXES] + [
                f"{prefix}{turn}.{axis}" for axis in (*_AXES, "w")
            ]
            forms = {rows.dtype[column] for column in columns if column in names}
            is_whole = prefix != name and all(column in names for column in columns)
            if is_whole and len(forms) == 1 and forms.pop().base.kind == "f":
                yield from _of_columns(rows, prefix, columns)
                return


def _of_columns(rows: NDArray[np.void], prefix: str, columns: list[str]) -> Iterator[Trajectory]:
    poses = np.stack([rows[column].astype(np.float64) for column in columns], axis=-1)
    if poses.ndim == 2:
        yield _finite("", _stamps(rows, ""), poses)
        return
    if poses.ndim != 3:
        return
    # An array of transforms, as on /tf: a trajectory for each child frame.
    names, array = rows.dtype.names or (), prefix.partition(".")[0]
    lengths = rows[length_path(array)] if length_path(array) in names else np.full(len(rows), poses.shape[1])
    child = f"{array}.child_frame_id"
    if child not in names or lengths.ndim > 1 or rows[child].shape != poses.shape[:2]:
        return
    is_there = np.arange(poses.shape[1]) < lengths[:, None]
    times, poses = _stamps(rows, f"{array}.", poses.shape[1])[is_there], poses[is_there]
    frames = rows[child][is_there]
    for frame in np.unique(frames):
        mine = frames == frame
        yield _finite(frame.decode("utf-8", "backslashreplace"), times[mine], poses[mine])


def _stamps(rows: NDArray[np.void], prefix: str, width: int = 0) -> NDArray[np.int64]:
    """Stamps [ns] of messages or, with `width`, of the elements of an array in them."""
    names = rows.dtype.names or ()
    log_times = rows[LOG_TIME] if not width else np.repeat(rows[LOG_TIME][:, None], width, axis=1)
    for stem in (f"{prefix}header.stamp", f"{prefix}stamp"):
        if f"{stem}.sec" in names and f"{stem}.nanosec" in names:
            stamps = rows[f"{stem}.sec"].astype(np.int64) * NS_PER_S + rows[f"{stem}.nanosec"]
            return stamps if stamps.shape == log_times.shape and stamps.any() else np.asarray(log_times)
    return np.asarray(log_times)


def _finite(name: str, times: NDArray[np.int64], poses: NDArray[Any]) -> Trajectory:
    is_finite = np.isfinite(poses).all(axis=1)
    return Trajectory(name, np.ascontiguousarray(times[is_finite]), poses[is_finite])
