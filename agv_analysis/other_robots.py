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
from numpy.typing import NDArray

from agv_analysis.bags import Bag, read_bag
from agv_analysis.bags.layout import LOG_TIME
from agv_analysis.outages import ages
from agv_analysis.run import Floats, Run
from agv_analysis.scenario import Scenario, load_scenario, parse_scenario
from agv_cloud.reference import Reference
from agv_ros.errors import UserError
from agv_ros.ros_yaml import RosYamlError, load
from agv_ros.stamps import MAX_LEAP, NS_PER_S
from agv_ros.wire import yaw_of_quaternion

Steps = NDArray[np.int64]

POSES = {
    "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    "nav_msgs/msg/Odometry": "pose.pose",
}
"""Types of a pose, each with the path of the geometry_msgs/Pose in it."""

COMMANDS = {"geometry_msgs/msg/Twist": "", "geometry_msgs/msg/TwistStamped": "twist."}
"""Types of a command, each with what stands before the path of a speed in it."""

REFERENCES = ("nav_msgs/msg/Path", "nav_msgs/msg/Odometry")

_SAME_PERIOD = 0.01
"""Largest relative difference between the params file's period and the stamps' that goes without saying."""

_REACH = 1.0
"""How far [m] along a path, beyond what the AGV moves, the point nearest to it may move from one pose to the next."""


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
    poses = _poses(bag, topics.pose, POSES)
    target = None if topics.reference is None else _target(bag, topics.reference, poses)
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


# -- poses over time --------------------------------------------------------------------------------------------------


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


def _messages(bag: Bag, topic: str, kinds: tuple[str, ...], what: str) -> NDArray[np.void]:
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


def _stamps(messages: NDArray[np.void], header: str = "header") -> Steps:
    seconds = messages[f"{header}.stamp.sec"].astype(np.int64)
    return np.asarray(seconds * NS_PER_S + messages[f"{header}.stamp.nanosec"])


def _poses(bag: Bag, topic: str, kinds: dict[str, str], what: str = "pose") -> Track:
    messages = _messages(bag, topic, tuple(kinds), what)
    path = kinds[bag.topics[topic].type]
    is_odometry = "twist.twist.linear.x" in (messages.dtype.names or ())
    nothing = np.zeros(len(messages))
    everything = Track(
        stamps=_stamps(messages),
        log_times=messages[LOG_TIME],
        x=messages[f"{path}.position.x"],
        y=messages[f"{path}.position.y"],
        theta=_yaws(messages, path),
        v=messages["twist.twist.linear.x"] if is_odometry else nothing,
        w=messages["twist.twist.angular.z"] if is_odometry else nothing,
        frame=_frame(messages),
    )
    return _in_order(everything, f"{bag.path}: {topic}", topic)


def _yaws(messages: NDArray[np.void], path: str) -> Floats:
    """Yaw [rad] in (-pi, pi]; NaN where the quaternion is zero and says nothing. Shape as that of the components."""
    components = [messages[f"{path}.orientation.{axis}"] for axis in "xyzw"]
    yaws = [yaw_of_quaternion(*q) for q in zip(*(part.ravel().tolist() for part in components), strict=True)]
    said = np.any(components, axis=0)
    return np.where(said, np.reshape(yaws, said.shape), np.nan)


def _in_order(track: Track, where: str, topic: str) -> Track:
    """Only finite postures, each with a stamp later than all before it: an edge ignores what is older than it holds."""
    finite = np.isfinite(track.x + track.y + track.theta + track.v + track.w)
    usable = track.chosen(finite)
    if not len(usable.stamps):
        raise UserError(f"{where}: none of its {len(finite)} poses has finite numbers and an orientation")
    newest = np.maximum.accumulate(usable.stamps)
    later = np.concatenate(([True], usable.stamps[1:] > newest[:-1]))
    repeated = np.count_nonzero(usable.stamps[1:] == newest[:-1])
    backwards = len(later) - np.count_nonzero(later) - repeated
    counts = (
        (len(finite) - np.count_nonzero(finite), "poses are not finite or have no orientation"),
        (repeated, "stamps repeat the one before"),
        (backwards, "stamps go backwards"),
    )
    notes = tuple(f"{topic}: {count} {what}, their messages are left out" for count, what in counts if count)
    kept = usable.chosen(later)
    return kept._replace(theta=np.unwrap(kept.theta), notes=notes)


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


def _target(bag: Bag, topic: str, poses: Track) -> Track:
    """The reference over time."""
    messages = _messages(bag, topic, REFERENCES, "reference")
    if bag.topics[topic].type == "nav_msgs/msg/Odometry":
        return _poses(bag, topic, POSES, "reference")
    own = np.arange(messages["poses.pose.position.x"].shape[1]) < messages["len(poses)"][:, np.newaxis]
    stamps, where = _stamps(messages, "poses.header"), f"{bag.path}: {topic}"
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
    theta = _yaws(paths, "poses.pose")[followed]
    log_times = np.repeat(paths[LOG_TIME], np.count_nonzero(followed, axis=1))
    still, frame = np.zeros(len(x)), _frame(paths)
    track = _in_order(Track(stamps[followed], log_times, x, y, theta, still, still, frame), where, topic)
    return _with_speeds(track)


def _of_paths_without_times(
    paths: NDArray[np.void], own: NDArray[np.bool_], poses: Track, where: str, topic: str
) -> Track:
    """Of the newest plan at each pose the point nearest to it: such a plan says where to drive, not when."""
    lines = [
        _line(*(plan[there] for plan in columns))
        for *columns, there in zip(*(paths[f"poses.pose.position.{axis}"] for axis in "xy"), own, strict=True)
    ]
    begins = _stamps(paths)
    if not begins.any():
        begins = _by_the_clock_of(poses, paths[LOG_TIME])
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
    return seen._replace(**joined, frame=_frame(paths), notes=(note,))


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
    return _with_speeds(poses._replace(x=x_r, y=y_r, theta=theta))


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


def _frame(messages: NDArray[np.void]) -> str:
    return str(messages["header.frame_id"][0].decode(errors="replace"))


def _with_speeds(track: Track) -> Track:
    """Speed along the heading and rate of turn [m/s, rad/s] from each pose to the next, of the last as before it."""
    if len(track.x) < 2:
        return track._replace(v=np.zeros(len(track.x)), w=np.zeros(len(track.x)))
    dt = np.diff(track.stamps) / NS_PER_S
    cos, sin = np.cos(track.theta[:-1]), np.sin(track.theta[:-1])
    v, w = (np.diff(track.x) * cos + np.diff(track.y) * sin) / dt, np.diff(track.theta) / dt
    return track._replace(v=np.append(v, v[-1]), w=np.append(w, w[-1]))


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
    messages = _messages(bag, topic, tuple(COMMANDS), "command")
    prefix = COMMANDS[bag.topics[topic].type]
    instants = _stamps(messages) if prefix else np.zeros(len(messages), dtype=np.int64)
    if not instants.any():
        instants = _by_the_clock_of(came, messages[LOG_TIME])
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


def _by_the_clock_of(came: Track, log_times: Steps) -> Steps:
    """Instants on the clock of the poses' stamps for messages of which only the log time is known."""
    logged = np.maximum.accumulate(came.log_times)
    first = logged[0]
    since = np.interp(log_times - first, logged - first, came.stamps - came.stamps[0])
    instants = np.rint(since).astype(np.int64) + came.stamps[0]
    return np.asarray(np.where(log_times < first, came.stamps[0] - (first - log_times), instants))
