"""From somebody else's recording to a run: a pose, a command and a reference in the types that robots use.

Such a bag has no slots that say what the radio lost. What is known comes from the stamps of the poses: their median
distance, where none is missing, is a period, a gap of m periods stands for m - 1 lost poses, and the whole time divided
by all periods is T_s. So the bag should be recorded where the controller runs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agv_analysis.bags import Bag, read_bag
from agv_analysis.bags.layout import LOG_TIME
from agv_analysis.metrics.outages import ages
from agv_analysis.recordings.posture_track import Steps, Track, by_the_clock_of, messages_of, read_poses, stamps_of
from agv_analysis.recordings.robot_reference import read_reference
from agv_analysis.run import Floats, Run
from agv_analysis.scenario import Scenario, load_scenario, parse_scenario
from agv_cloud.reference.reference import Reference
from agv_ros.errors import UserError
from agv_ros.ros_yaml import RosYamlError, load
from agv_ros.stamps import MAX_LEAP, NS_PER_S

COMMANDS = {"geometry_msgs/msg/Twist": "", "geometry_msgs/msg/TwistStamped": "twist."}
"""Types of a command, each with what stands before the path of a speed in it."""

_SAME_PERIOD = 0.01
"""Largest relative difference between the params file's period and the stamps' that goes without saying."""


class RobotTopics(NamedTuple):
    """Topics of a robot by what they mean; None: not in the recording."""

    pose: str
    command: str | None = None
    reference: str | None = None


def read_topics(path: Path | None, pose: str | None, command: str | None, reference: str | None) -> RobotTopics:
    """Topics from a YAML mapping with the keys pose, command, reference; names that are given here go before it.

    Raises UserError if the file cannot be used, or nobody names the pose.
    """
    names = {} if path is None else _mapping(path)
    given = {"pose": pose, "command": command, "reference": reference}
    names.update({role: name for role, name in given.items() if name is not None})
    if "pose" not in names:
        raise UserError("no topic of the pose: name it with --pose-topic, or as `pose:` in the file of --topics")
    return RobotTopics(**names)


def _mapping(path: Path) -> dict[str, str]:
    try:
        content = load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from None
    except (RosYamlError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: {error}") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: no mapping in it; expected lines like 'pose: /odom'")
    for role, name in content.items():
        if role not in RobotTopics._fields or not isinstance(name, str):
            allowed = ", ".join(RobotTopics._fields)
            raise UserError(f"{path}: found {role!r}: {name!r}; allowed are {allowed}, each with the name of a topic")
    return content


def read_robot_run(path: Path, topics: RobotTopics, track_file: Path | None = None, config: Path | None = None) -> Run:
    """Run of a robot that is recorded in a rosbag2 directory, an MCAP or a sqlite3 file.

    The reference is that of `topics`, else the speeds of `track_file` (columns t, v, w; t = 0 at the first pose), else
    the track of `config`, a params file. Without `config` the gains are unknown. At lost poses the run has what lies
    between those that came. Raises UserError if the bag cannot be read or does not hold what was named.
    """
    if topics.reference is not None and track_file is not None:
        raise UserError(f"two references, the topic {topics.reference} and the file {track_file}: name one of them")
    if topics.reference is None and track_file is None and config is None:
        raise UserError("no reference: name its topic with --reference-topic, or a track with --track-file or --config")
    bag = read_bag(path, topics=[name for name in topics if name is not None])
    poses = read_poses(bag, topics.pose)
    target = None if topics.reference is None else read_reference(bag, topics.reference, poses)
    return _run(bag, topics, poses, target, _scenario(track_file, config), config)


def _scenario(track_file: Path | None, config: Path | None) -> Scenario:
    """The params file's scenario, on the track of the file if there is one."""
    settings = [] if track_file is None else ["error_detector.track=csv", f"error_detector.track_file={track_file}"]
    if config is None:
        return parse_scenario("controller: {ros__parameters: {}}", "defaults", settings)
    return load_scenario(str(config), settings)


def _run(
    bag: Bag, topics: RobotTopics, poses: Track, target: Track | None, scenario: Scenario, config: Path | None
) -> Run:
    came = poses if target is None else _covered(poses, target, bag, topics)
    sampling = _sampling(came.stamps, f"{bag.path}: {topics.pose}")
    k = np.arange(sampling.k[-1] + 1)
    stamps = np.rint(np.interp(k, sampling.k, came.stamps - came.stamps[0])).astype(np.int64) + came.stamps[0]
    pose = came.at(stamps)[:, :3]
    lost = ~np.isin(k, sampling.k)
    fitted = _fitted(scenario, sampling.period, came, has_track_start=config is not None)
    reference = Reference(fitted.error_detector).first(len(k)) if target is None else target.at(stamps)
    command, command_notes = _commands(bag, topics.command, came, stamps, sampling.period)
    return Run(
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
            *_sampling_notes(sampling, topics.pose, scenario.plant.ts if config is not None else None),
            *_reference_notes(poses, came, target, topics, config is not None),
            *command_notes,
        ),
        gains_known=config is not None,
        seed_known=False,
    )


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


# -- the sampling period ----------------------------------------------------------------------------------------------


class Sampling(NamedTuple):
    """How the poses were sampled, from their stamps."""

    period: float
    """T_s [ns], such that all steps together last as long as the poses do: a median would drift away from the clock."""
    k: Steps
    """Step of each pose, shape (M,); 0 for the first."""
    deviations: Floats
    """How far each distance is from whole periods [ns], shape (M - 1,)."""


def _sampling(stamps: Steps, where: str) -> Sampling:
    """Sampling of poses with increasing `stamps` [ns]; a gap of m periods is m steps, so m - 1 poses are lost.

    Raises UserError if there are too few poses or a gap that no outage explains.
    """
    if len(stamps) < 3:
        raise UserError(f"{where}: {len(stamps)} poses with a stamp of their own; at least 3 are needed for a period")
    gaps = np.diff(stamps)
    period = _period(gaps)
    steps = np.maximum(1, np.rint(gaps / period)).astype(np.int64)
    if steps.max() > MAX_LEAP or steps.sum() > MAX_LEAP + 100 * len(stamps):
        i = int(np.argmax(steps))
        raise UserError(
            f"{where}: a gap of {gaps[i] / NS_PER_S:g} s after the stamp {stamps[i] / NS_PER_S:.9f} s is {steps[i]} "
            f"periods of {period / NS_PER_S:g} s, and only {len(stamps)} poses are there: is it "
            "one recording, by one clock?"
        )
    k = np.concatenate(([0], np.cumsum(steps)))
    mean = float(stamps[-1] - stamps[0]) / float(k[-1])
    return Sampling(mean, k, gaps - steps * mean)


def _period(gaps: Steps) -> float:
    """Median of the gaps [ns] that are one period long; of all gaps it would be too long if some poses are lost.

    Quantiles are values that occurred, so at least one gap is one period long. If more than half of the poses are
    lost, the first guess may be two periods.
    """
    period = _median(gaps)
    for _ in range(2):
        period = _median(gaps[np.rint(gaps / period) == 1.0])
    return period


def _median(gaps: Steps) -> float:
    return float(np.percentile(gaps, 50.0, method="inverted_cdf"))


def _sampling_notes(sampling: Sampling, topic: str, ts: float | None) -> Iterator[str]:
    ms = 1e-6
    missing = int(sampling.k[-1]) + 1 - len(sampling.k)
    yield (
        f"{topic}: sampling period {sampling.period * ms:g} ms by the stamps; jitter "
        f"{np.std(sampling.deviations) * ms:.3g} ms, at most {np.abs(sampling.deviations).max() * ms:.3g} ms"
    )
    if missing:
        yield (
            f"{topic}: {missing} poses are missing between the stamps and count as lost; the pose there is interpolated"
        )
    if ts is not None and abs(sampling.period / NS_PER_S / ts - 1.0) > _SAME_PERIOD:
        yield f"the params file says ts = {ts:g} s, the stamps say {sampling.period / NS_PER_S:g} s; the stamps count"


# -- reference and command --------------------------------------------------------------------------------------------


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
        return
    yield from target.notes
    if len(came.stamps) < len(poses.stamps):
        left_out = len(poses.stamps) - len(came.stamps)
        yield f"{topics.pose}: {left_out} poses lie before or after the reference, they are left out"
    if poses.frame != target.frame:
        yield (
            f"{topics.pose} is in frame {poses.frame!r}, {topics.reference} in frame {target.frame!r}: no transform "
            "is applied, so errors hold only if the frames coincide"
        )


def _commands(bag: Bag, topic: str | None, came: Track, stamps: Steps, period: float) -> tuple[Floats, tuple[str, ...]]:
    """The newest command (v, w) when each period ends, shape (N, 2), NaN before the first; and what to say of it.

    A command without a stamp belongs to the instant whose pose had just been logged: its log time is carried over to
    the clock of the poses' stamps.
    """
    command = np.full((len(stamps), 2), np.nan)
    if topic is None:
        return command, ("no command: nothing is said of its damping",)
    messages = messages_of(bag, topic, tuple(COMMANDS), "command")
    prefix = COMMANDS[bag.topics[topic].type]
    instants = stamps_of(messages) if prefix else np.zeros(len(messages), dtype=np.int64)
    if not instants.any():
        instants = by_the_clock_of(came, messages[LOG_TIME])
    order = np.argsort(instants, kind="stable")
    ends = np.append(stamps[1:], stamps[-1] + round(period))
    newest = np.searchsorted(instants[order], ends, side="left") - 1
    known = newest >= 0
    for column, speed in enumerate(("linear.x", "angular.z")):
        command[known, column] = messages[prefix + speed][order][newest[known]]
    held = int(np.count_nonzero(np.diff(newest[known]) == 0))
    return command, (
        f"{topic}: no command came in {held} of {len(stamps)} steps, the last one is held",
    ) if held else ()
