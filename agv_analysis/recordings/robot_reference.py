"""The reference of a robot over time, from the plans or the odometry in its recording."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags import Bag
from agv_analysis.bags.layout import LOG_TIME
from agv_analysis.recordings.messages_on_steps import Steps, stamps_of
from agv_analysis.recordings.posture_track import (
    Track,
    by_the_clock_of,
    frame_of,
    in_order,
    messages_of,
    read_poses,
    with_speeds,
    yaws_of,
)
from agv_analysis.run import Floats
from agv_ros.errors import UserError

REFERENCES = ("nav_msgs/msg/Path", "nav_msgs/msg/Odometry")

_REACH = 1.0
"""How far [m] along a path, beyond what the AGV moves, the point nearest to it may move from one pose to the next."""


def read_reference(bag: Bag, topic: str, poses: Track) -> Track:
    """The reference over time, from Odometry or Path; `poses` are those of the AGV. Raises UserError."""
    messages = messages_of(bag, topic, REFERENCES, "reference")
    if bag.topics[topic].type == "nav_msgs/msg/Odometry":
        return read_poses(bag, topic, "reference")
    own = np.arange(messages["poses.pose.position.x"].shape[1]) < messages["len(poses)"][:, np.newaxis]
    stamps, where = stamps_of(messages, "poses.header.stamp"), f"{bag.path}: {topic}"
    if any(len(np.unique(plan[there])) > 1 for plan, there in zip(stamps, own, strict=True)):
        return _of_timed_paths(messages, stamps, own, where, topic)
    return _of_paths_without_times(messages, own, poses, where, topic)


def _of_timed_paths(paths: NDArray[np.void], stamps: Steps, own: NDArray[np.bool_], where: str, topic: str) -> Track:
    """A plan is followed until the next one begins. Its speeds are differences, of each pose to the next one."""
    never = np.iinfo(np.int64).max
    begins = np.where(own, stamps, never).min(axis=1, initial=never)
    ends = np.append(np.minimum.accumulate(begins[::-1])[::-1][1:], never)
    followed = own & (stamps < ends[:, np.newaxis])
    x, y = (paths[f"poses.pose.position.{axis}"][followed] for axis in "xy")
    theta = yaws_of(paths, "poses.pose")[followed]
    log_times = np.repeat(paths[LOG_TIME], np.count_nonzero(followed, axis=1))
    still, frame = np.zeros(len(x)), frame_of(paths)
    track = in_order(Track(stamps[followed], log_times, x, y, theta, still, still, frame), where, topic)
    return with_speeds(track)


def _of_paths_without_times(
    paths: NDArray[np.void], own: NDArray[np.bool_], poses: Track, where: str, topic: str
) -> Track:
    """Of the newest plan at each pose the point nearest to it: such a plan says where to drive, not when."""
    lines = [
        _line(*(plan[there] for plan in columns))
        for *columns, there in zip(*(paths[f"poses.pose.position.{axis}"] for axis in "xy"), own, strict=True)
    ]
    begins = stamps_of(paths)
    if not begins.any():
        begins = by_the_clock_of(poses, paths[LOG_TIME])
    usable = [i for i in np.argsort(begins, kind="stable").tolist() if len(lines[i].s) > 1]
    newest = np.searchsorted(begins[usable], poses.stamps, side="right") - 1
    chunks = [
        _along(lines[i], poses.chosen(newest == number)) for number, i in enumerate(usable) if (newest == number).any()
    ]
    if not chunks:
        raise UserError(f"{where}: no path of at least two finite points before the last pose")
    joined = {
        name: np.concatenate([getattr(chunk, name) for chunk in chunks]) for name in ("x", "y", "theta", "v", "w")
    }
    seen = poses.chosen(newest >= 0)
    note = (
        f"{topic}: its poses have no times, so the reference is the point of the path nearest to the AGV, and errors "
        "are those across the path"
    )
    return seen._replace(**joined, frame=frame_of(paths), notes=(note,))


class Line(NamedTuple):
    """A polyline by arc length s [m]; theta is its heading [rad] at the vertices, counting turns; shapes (M,)."""

    s: Floats
    x: Floats
    y: Floats
    theta: Floats


def _line(x: Floats, y: Floats) -> Line:
    """Line through the finite points of a plan, those left out that repeat the one before."""
    finite = np.isfinite(x + y)
    x, y = x[finite], y[finite]
    moves = np.hypot(np.diff(x, prepend=np.nan), np.diff(y, prepend=np.nan)) != 0.0
    x, y = x[moves], y[moves]
    if len(x) < 2:
        return Line(np.zeros(len(x)), x, y, np.zeros(len(x)))
    heading = np.unwrap(np.arctan2(np.diff(y), np.diff(x)))
    theta = np.concatenate((heading[:1], (heading[1:] + heading[:-1]) / 2.0, heading[-1:]))
    return Line(np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y))))), x, y, theta)


def _along(line: Line, poses: Track) -> Track:
    """The points of the line that go with the poses, and the speeds at which they move.

    From one pose to the next the point stays near, so that where a track crosses itself it keeps to its branch.
    """
    s, low, high, before = np.empty(len(poses.x)), 0.0, float(line.s[-1]), (0.0, 0.0)
    for i, (x, y) in enumerate(zip(poses.x.tolist(), poses.y.tolist(), strict=True)):
        if i:
            reach = _REACH + 3.0 * float(np.hypot(x - before[0], y - before[1]))
            low, high = s[i - 1] - reach, s[i - 1] + reach
        s[i], before = _nearest(line, x, y, low, high), (x, y)
    x_r, y_r, theta = (np.interp(s, line.s, column) for column in (line.x, line.y, line.theta))
    return with_speeds(poses._replace(x=x_r, y=y_r, theta=theta))


def _nearest(line: Line, x: float, y: float, low: float, high: float) -> float:
    """Arc length [m] of the point of a line nearest to (x, y), on the segments between arc lengths `low` and `high`."""
    first = max(0, int(np.searchsorted(line.s, low, side="right")) - 1)
    last = min(len(line.s) - 1, max(first + 1, int(np.searchsorted(line.s, high))))
    first = min(first, last - 1)
    px, py, s = line.x[first : last + 1], line.y[first : last + 1], line.s[first : last + 1]
    dx, dy, length = np.diff(px), np.diff(py), np.diff(s)
    share = np.clip(((x - px[:-1]) * dx + (y - py[:-1]) * dy) / length**2, 0.0, 1.0)
    i = int(np.argmin(np.hypot(px[:-1] + share * dx - x, py[:-1] + share * dy - y)))
    return float(s[i] + share[i] * length[i])
