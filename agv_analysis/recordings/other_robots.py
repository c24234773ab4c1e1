"""From the recording of another robot to a run: a pose, a command and a reference in the types that robots use.

Such a bag has no slots that say what the radio lost. What is known comes from the stamps of the poses: their median
distance, where none is missing, is a period, a gap of m periods stands for m - 1 lost poses, and the whole time divided
by all periods is T_s. When they came, their log times say. So the bag should be recorded where the controller runs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from agv_analysis.bags import Bag, read_bag
from agv_analysis.metrics.outages import ages
from agv_analysis.recordings.posture_track import Track, read_poses
from agv_analysis.recordings.robot_commands import read_commands
from agv_analysis.recordings.robot_reference import read_reference
from agv_analysis.recordings.robot_timing import with_timing
from agv_analysis.recordings.robot_topics import RobotTopics
from agv_analysis.recordings.sampling import sampling_notes, sampling_of
from agv_analysis.recordings.transform_poses import STATIC, TRANSFORMS, read_transforms
from agv_analysis.run import Run
from agv_analysis.scenario import Scenario, load_scenario, parse_scenario
from agv_cloud.parameters import CSV
from agv_cloud.reference.reference import Reference
from agv_cloud.reference.track_file import load_track
from agv_ros.counted import counted
from agv_ros.errors import UserError
from agv_ros.parameters import as_dict
from agv_ros.stamps import NS_PER_S, to_nanoseconds

__all__ = ["RobotTopics", "read_robot_poses", "read_robot_run"]


def read_robot_run(
    path: Path, topics: RobotTopics, track_file: Path | None = None, config: Path | None = None,
    pose_frames: tuple[str, str] | None = None,
) -> Run:  # fmt: skip
    """Run of a robot that is recorded in a rosbag2 directory, an MCAP or a sqlite3 file.

    The reference is that of `topics`, else the speeds of `track_file` (columns t, v, w; t = 0 at the first pose), else
    the track of `config`, a params file. Without `config` the gains are unknown. Of transforms `pose_frames` names the
    fixed frame and the robot's. At lost poses the run has what lies
    between those that came. Raises UserError if the bag cannot be read or does not hold what was named.
    """
    if topics.reference is not None and track_file is not None:
        raise UserError(f"two references, the topic {topics.reference} and the file {track_file}: name one of them")
    if topics.reference is None and track_file is None and config is None:
        raise UserError("no reference: name its topic with --reference-topic, or a track with --track-file or --config")
    bag, poses = read_robot_poses(path, topics, pose_frames)
    target = None if topics.reference is None else read_reference(bag, topics.reference, poses)
    return _run(bag, topics, poses, target, _scenario(track_file, config), config)


def read_robot_poses(path: Path, topics: RobotTopics, pose_frames: tuple[str, str] | None = None) -> tuple[Bag, Track]:
    """A robot's recording with the messages of `topics`, and its poses. Raises UserError, as `read_robot_run`."""
    named = [name for name in topics if name is not None]
    bag = read_bag(path, topics=named)
    if topics.pose in bag.topics and bag.topics[topics.pose].type == TRANSFORMS:
        if pose_frames is None:
            raise UserError(f"{path}: {topics.pose} has transforms: name frames, as with --pose-frames map base_link")
        bag = read_bag(path, topics=[*named, *([STATIC] if STATIC in bag.topics else [])])
        poses = read_transforms(bag, topics.pose, *pose_frames)
    else:
        poses = read_poses(bag, topics.pose)
    return bag, poses


def _scenario(track_file: Path | None, config: Path | None) -> Scenario:
    """The params file's scenario, on the track of the file if there is one."""
    settings = [] if track_file is None else ["error_detector.track=csv", f"error_detector.track_file={track_file}"]
    if config is None:
        return parse_scenario("controller: {ros__parameters: {}}", "defaults", settings)
    return load_scenario(str(config), settings)


def _run(
    bag: Bag, topics: RobotTopics, poses: Track, target: Track | None, scenario: Scenario, config: Path | None
) -> Run:
    came = _within_track(poses, scenario) if target is None else _covered(poses, target, bag, topics)
    sampling = sampling_of(came.stamps, f"{bag.path}: {topics.pose}")
    k = np.arange(sampling.k[-1] + 1)
    stamps = np.rint(np.interp(k, sampling.k, came.stamps - came.stamps[0])).astype(np.int64) + came.stamps[0]
    pose = came.at(stamps)[:, :3]
    lost = ~np.isin(k, sampling.k)
    fitted = _fitted(scenario, sampling.period, came, has_track_start=config is not None)
    reference = Reference(fitted.error_detector).first(len(k)) if target is None else target.at(stamps)
    wheelbase = as_dict(scenario.plant)["bicycle.wheelbase"] if config is not None else None
    command, command_notes = read_commands(bag, topics.command, came, stamps, sampling.period, wheelbase)
    run = Run(
        scenario=fitted,
        k=k,
        pose=pose,
        reference=reference,
        error=np.full((len(k), 3), np.nan),
        command=command,
        n_ul=ages(k, lost),
        lost=lost,
        downlink_lost=np.zeros_like(lost),
        source=str(bag.path),
        notes=(
            *bag.problems,
            *poses.notes,
            *sampling_notes(sampling, topics.pose, scenario.plant.ts if config is not None else None),
            *_reference_notes(poses, came, target, topics, config is not None),
            *command_notes,
        ),
        gains_known=config is not None,
        seed_known=False,
    )
    return with_timing(run, bag, topics.command, came, sampling.k)


def _fitted(scenario: Scenario, period: float, came: Track, has_track_start: bool) -> Scenario:
    """The scenario with what the recording says: period [s], start and first pose."""
    ts, first = period / NS_PER_S, (float(came.x[0]), float(came.y[0]), float(came.theta[0]))
    shared: dict[str, Any] = {"ts": ts, "start_time": float(came.stamps[0]) / NS_PER_S}
    detector = scenario.error_detector
    return Scenario(
        plant=dataclasses.replace(scenario.plant, **shared, initial_pose=first),
        relay=dataclasses.replace(scenario.relay, **shared),
        error_detector=dataclasses.replace(
            detector, **shared, track_start=detector.track_start if has_track_start else first
        ),
        controller=dataclasses.replace(scenario.controller, **shared),
    )


def _within_track(poses: Track, scenario: Scenario) -> Track:
    """The poses up to the end of a track file, behind which it says nothing."""
    detector = scenario.error_detector
    if detector.track != CSV:
        return poses
    end = poses.stamps[0] + to_nanoseconds(load_track(detector.track_file).duration)
    return poses.chosen(poses.stamps <= end)


def _covered(poses: Track, target: Track, bag: Bag, topics: RobotTopics) -> Track:
    """The poses from the beginning of the reference to its end: outside there is nothing to compare them with."""
    covered = poses.chosen((poses.stamps >= target.stamps[0]) & (poses.stamps <= target.stamps[-1]))
    if not len(covered.stamps):
        mine, other = ([track.stamps[i] / NS_PER_S for i in (0, -1)] for track in (poses, target))
        raise UserError(
            f"{bag.path}: {topics.pose} lasts from {mine[0]:.3f} to {mine[1]:.3f} s, {topics.reference} from "
            f"{other[0]:.3f} to {other[1]:.3f} s: they have no instant in common; are their stamps by one clock?"
        )
    return covered


def _reference_notes(
    poses: Track, came: Track, target: Track | None, topics: RobotTopics, has_track_start: bool
) -> Iterator[str]:
    if target is None:
        where = "where the params file says" if has_track_start else "at the AGV's first pose"
        yield f"the track begins {where}, at the time of the first pose"
        if len(came.stamps) < len(poses.stamps):
            yield (
                f"{topics.pose}: {counted(len(poses.stamps) - len(came.stamps), 'pose')} came after the end of "
                "the track file, "
                "they are left out"
            )
        return
    yield from target.notes
    if len(came.stamps) < len(poses.stamps):
        left_out = len(poses.stamps) - len(came.stamps)
        yield (
            f"{topics.pose}: {counted(left_out, 'pose lies', 'poses lie')} before or after the reference, they "
            "are left out"
        )
    if poses.frame != target.frame:
        yield (
            f"{topics.pose} is in frame {poses.frame!r}, {topics.reference} in frame {target.frame!r}: no transform "
            "is applied, so errors hold only if the frames coincide"
        )
