"""Postures over time as robots publish them, from the messages of a bag."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags import Bag
from agv_analysis.bags.layout import LOG_TIME
from agv_analysis.recordings.clock_steps import clock_steps
from agv_analysis.recordings.messages_on_steps import Steps, stamps_of
from agv_analysis.run import Floats
from agv_ros.counted import counted
from agv_ros.errors import UserError
from agv_ros.messages import SQUARED_LENGTH, yaw_of_quaternion
from agv_ros.stamps import NS_PER_S

POSES = {
    "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    "nav_msgs/msg/Odometry": "pose.pose",
}
"""Types of a pose, each with the path of the geometry_msgs/Pose in it."""


class Track(NamedTuple):
    """Postures and speeds over time, arrays of shape (M,); stamps [ns] increase, theta counts turns."""

    stamps: Steps
    log_times: Steps
    x: Floats
    y: Floats
    theta: Floats
    v: Floats
    w: Floats
    frame: str
    notes: tuple[str, ...] = ()

    def at(self, stamps: Steps) -> Floats:
        """x, y, theta, v, w at the instants `stamps` [ns], linear in between; shape (N, 5)."""
        own, wanted = self.stamps - self.stamps[0], stamps - self.stamps[0]
        columns = (self.x, self.y, self.theta, self.v, self.w)
        return np.column_stack([np.interp(wanted, own, column) for column in columns])

    def chosen(self, rows: NDArray[np.bool_]) -> Track:
        """Those rows only."""
        columns: dict[str, Any] = {
            name: part[rows] for name, part in self._asdict().items() if isinstance(part, np.ndarray)
        }
        return self._replace(**columns)


def messages_of(bag: Bag, topic: str, kinds: tuple[str, ...], what: str) -> NDArray[np.void]:
    """Messages of a topic. Raises UserError if it is not there, empty, or of no type that `what` may have."""
    if topic not in bag.topics:
        there = ", ".join(sorted(bag.topics)) or "none at all"
        raise UserError(f"{bag.path}: no topic {topic} for the {what}; it has {there}")
    kind = bag.topics[topic].type
    if kind not in kinds:
        raise UserError(f"{bag.path}: {topic} is of type {kind}; a {what} must be one of {', '.join(kinds)}")
    messages = bag[topic]
    if not len(messages):
        raise UserError(f"{bag.path}: {topic} has no message, so there is no {what}")
    return messages


def read_poses(bag: Bag, topic: str, what: str = "pose") -> Track:
    """Postures of a topic of a type in POSES, in order. Raises UserError, which calls them `what`, if it has none."""
    messages = messages_of(bag, topic, tuple(POSES), what)
    path = POSES[bag.topics[topic].type]
    is_odometry = "twist.twist.linear.x" in (messages.dtype.names or ())
    nothing = np.zeros(len(messages))
    everything = Track(
        stamps=stamps_of(messages),
        log_times=messages[LOG_TIME],
        x=messages[f"{path}.position.x"],
        y=messages[f"{path}.position.y"],
        theta=yaws_of(messages, path),
        v=messages["twist.twist.linear.x"] if is_odometry else nothing,
        w=messages["twist.twist.angular.z"] if is_odometry else nothing,
        frame=frame_of(messages),
    )
    return in_order(everything, f"{bag.path}: {topic}", topic)


def yaws_of(messages: NDArray[np.void], path: str, member: str = "orientation") -> Floats:
    """Yaw [rad] in (-pi, pi]; NaN where the quaternion is not a rotation, as one whose w was never set.

    It is the `member` of what is at `path`. Shape as that of the components.
    """
    components = [messages[f"{path}.{member}.{axis}"] for axis in "xyzw"]
    yaws = [yaw_of_quaternion(*q) for q in zip(*(part.ravel().tolist() for part in components), strict=True)]
    with np.errstate(over="ignore", invalid="ignore"):
        squared = sum(part**2 for part in components)
    is_rotation = np.abs(squared - 1.0) < SQUARED_LENGTH
    return np.where(is_rotation, np.reshape(yaws, is_rotation.shape), np.nan)


def in_order(track: Track, where: str, topic: str) -> Track:
    """Only finite postures, each with a stamp later than all before it: an edge ignores what is older than it holds.

    The stamp 0 means no time. Raises UserError if nothing is left, or if the clock was set meanwhile.
    """
    stamped = track.stamps != 0
    if not stamped.any():
        raise UserError(
            f"{where}: all its {counted(len(stamped), 'stamp is', 'stamps are')} 0, no time: their sender must "
            "set header.stamp"
        )
    finite = np.isfinite(track.x + track.y + track.theta + track.v + track.w)
    usable = track.chosen(finite & stamped)
    if not len(usable.stamps):
        raise UserError(f"{where}: none of its {counted(len(finite), 'pose')} has finite numbers and an orientation")
    for row, step in clock_steps(usable.stamps, usable.log_times):
        raise UserError(
            f"{where}: the clock of its stamps was set by {step / NS_PER_S:+.3f} s against the log times, after the "
            f"stamp {usable.stamps[row - 1] / NS_PER_S:.3f} s: cut the recording there, and analyse the parts"
        )
    newest = np.maximum.accumulate(usable.stamps)
    later = np.concatenate(([True], usable.stamps[1:] > newest[:-1]))
    repeated = np.count_nonzero(usable.stamps[1:] == newest[:-1])
    backwards = len(later) - np.count_nonzero(later) - repeated
    counts = (
        (len(stamped) - np.count_nonzero(stamped), "stamps are 0, which means no time"),
        (np.count_nonzero(stamped & ~finite), "poses are not finite or have no orientation"),
        (repeated, "stamps repeat the one before"),
        (backwards, "stamps go backwards"),
    )
    notes = tuple(f"{topic}: {count} {what}, their messages are left out" for count, what in counts if count)
    kept = usable.chosen(later)
    return kept._replace(theta=np.unwrap(kept.theta), notes=notes)


def frame_of(messages: NDArray[np.void]) -> str:
    """The frame that the first message names."""
    return str(messages["header.frame_id"][0].decode(errors="replace"))


def with_speeds(track: Track) -> Track:
    """Speed along the heading and rate of turn [m/s, rad/s] from each pose to the next, of the last as before it."""
    if len(track.x) < 2:
        return track._replace(v=np.zeros(len(track.x)), w=np.zeros(len(track.x)))
    dt = np.diff(track.stamps) / NS_PER_S
    cos, sin = np.cos(track.theta[:-1]), np.sin(track.theta[:-1])
    v, w = (np.diff(track.x) * cos + np.diff(track.y) * sin) / dt, np.diff(track.theta) / dt
    return track._replace(v=np.append(v, v[-1]), w=np.append(w, w[-1]))


def by_the_clock_of(came: Track, log_times: Steps) -> Steps:
    """Instants on the clock of the poses' stamps for messages of which only the log time is known."""
    logged = np.maximum.accumulate(came.log_times)
    first = logged[0]
    since = np.interp(log_times - first, logged - first, came.stamps - came.stamps[0])
    instants = np.rint(since).astype(np.int64) + came.stamps[0]
    return np.asarray(np.where(log_times < first, came.stamps[0] - (first - log_times), instants))
