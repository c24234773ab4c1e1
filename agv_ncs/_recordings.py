"""Recordings by the names of their files: those of the loop, and those of other robots."""

from __future__ import annotations

from pathlib import Path

from agv_analysis.recordings.other_robots import RobotTopics, read_robot_run
from agv_analysis.recordings.recording import read_run
from agv_analysis.run import Run
from agv_ros.errors import UserError


def read_recording(path: str | Path, config: str | Path | None = None, namespace: str | None = None) -> Run:
    """Run of the loop that is recorded in a rosbag2 directory or an MCAP file.

    The parameters are those that the bag carries, or those of `config`, a params file. `namespace` chooses one of
    several loops. Raises UserError if the bag cannot be read, holds no loop, or does not say which one is meant.
    """
    return read_run(Path(path), None if config is None else Path(config), namespace)


def read_robot_recording(
    path: str | Path,
    pose: str,
    command: str | None = None,
    reference: str | None = None,
    track_file: str | Path | None = None,
    config: str | Path | None = None,
) -> Run:
    """Run of another robot that is recorded in a rosbag2 directory, an MCAP or a sqlite3 file.

    pose: topic of its pose (Odometry, PoseWithCovarianceStamped, PoseStamped); command: of its command (Twist,
    TwistStamped). The reference is the topic `reference` (Odometry, Path), else the speeds in `track_file` (CSV with
    the columns t [s], v [m/s], w [rad/s]), else the track of `config`, a params file. Without `config` the gains are
    unknown, so that `observe` takes the run and `analyse` refuses it. Raises UserError if the bag cannot be read or
    does not hold what was named.
    """
    if reference is not None and track_file is not None:
        raise UserError(f"two references, the topic {reference} and the file {track_file}: give one of them")
    if reference is None and track_file is None and config is None:
        raise UserError("no reference: give the name of its topic as `reference`, or a `track_file`, or a `config`")
    track, params = (None if file is None else Path(file) for file in (track_file, config))
    return read_robot_run(Path(path), RobotTopics(pose, command, reference), track, params)
