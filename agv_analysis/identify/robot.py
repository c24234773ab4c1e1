"""How a recorded robot follows its commands: dead time, lag, gain and slip of its speed and of its rate of turn."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agv_analysis.identify.first_order import HeldCommand
from agv_analysis.identify.fit import (
    LONGEST_DEAD_TIME,
    LONGEST_LAG,
    FirstOrderFit,
    Increments,
    Interval,
    fit_first_order,
)
from agv_analysis.identify.pose_increments import moved_forwards, turned
from agv_analysis.recordings.other_robots import read_robot_poses
from agv_analysis.recordings.posture_track import Track
from agv_analysis.recordings.robot_commands import sent_commands
from agv_analysis.recordings.robot_topics import RobotTopics
from agv_analysis.run import Floats
from agv_ros.counted import counted
from agv_ros.errors import UserError
from agv_ros.stamps import NS_PER_S

MOST_POSES = 20_000
"""Poses of a longer recording that are used, its first ones."""

_LEAST_POSES = 100

_LEAST_EXPLAINED = 0.5
"""Share of the motion's mean square that the commands must explain."""

_MOST_INFLATION = 25.0
"""By which factor correlated residuals may make a variance larger, before the model is refused."""

_WIDEST_GAIN = 0.5
"""Width of the gain's interval against the gain, beyond which the speed was not excited enough."""

_WIDEST_DEAD_TIME = 0.2
"""Width [s] of the dead time's interval, likewise."""


class Named(NamedTuple):
    """One of the two speeds: its name, what it is, and the unit of its command."""

    key: str
    meaning: str
    unit: str


SPEEDS = (Named("v", "speed", "m/s"), Named("w", "rate of turn", "rad/s"))


@dataclass(frozen=True)
class IdentifiedSpeed:
    """What is known of one speed; `fit` is None where `reason` says why there is no number."""

    named: Named
    fit: FirstOrderFit | None
    reason: str = ""

    @property
    def slip(self) -> Interval | None:
        """Share of the commanded speed that the robot does not drive, 1 - gain."""
        if self.fit is None:
            return None
        gain = self.fit.gain
        return Interval(1.0 - gain.value, 1.0 - gain.high, 1.0 - gain.low)

    def to_json(self) -> dict[str, Any]:
        """`dead_time_s`, `lag_s`, `gain` and `slip` with their intervals, null with a `reason` where not known."""
        fit = self.fit
        parts = {
            "dead_time_s": None if fit is None else fit.dead_time,
            "lag_s": None if fit is None else fit.lag,
            "gain": None if fit is None else fit.gain,
            "slip": self.slip,
        }
        found = {
            key: None if part is None else {"value": part.value, "low": part.low, "high": part.high}
            for key, part in parts.items()
        }
        return {**found, "reason": self.reason or None, "variance_inflation": None if fit is None else fit.inflation}


@dataclass(frozen=True)
class IdentifiedRobot:
    """What a recording says of how a robot follows its commands."""

    source: str
    speeds: tuple[IdentifiedSpeed, ...]
    pose_period: float
    """Median time between poses [s]."""
    command_period: float
    """Median time between commands [s]."""
    largest_speed: float
    """Largest commanded speed [m/s]."""
    notes: tuple[str, ...] = ()

    def __getitem__(self, key: str) -> IdentifiedSpeed:
        """What is known of the speed `v` or `w`."""
        return next(speed for speed in self.speeds if speed.named.key == key)

    def to_json(self) -> dict[str, Any]:
        """`v` and `w`, the periods, and notes."""
        return {
            "source": self.source,
            **{speed.named.key: speed.to_json() for speed in self.speeds},
            "pose_period_s": self.pose_period,
            "command_period_s": self.command_period,
            "commanded_speed_max_m_per_s": self.largest_speed,
            "notes": list(self.notes),
        }


def identify_recording(
    path: Path, topics: RobotTopics, pose_frames: tuple[str, str] | None = None, wheelbase: float | None = None
) -> IdentifiedRobot:
    """How the robot of a recording follows its commands. Raises UserError for what cannot be read or is too short.

    `pose_frames`: fixed and robot's frame of transforms; `wheelbase` [m]: of a car whose commands are steering angles.
    """
    bag, poses = read_robot_poses(path, topics, pose_frames)
    instants, commands, notes = sent_commands(bag, command_topic(topics), poses, wheelbase)
    return identify(instants, commands, poses, str(path), (*bag.problems, *poses.notes, *notes))


def command_topic(topics: RobotTopics) -> str:
    """The topic of the commands. Raises UserError if none is named."""
    if topics.command is None:
        raise UserError("no topic of the commands: name it with --command-topic, or as `command:` in --topics")
    return topics.command


def identify(
    instants: np.ndarray[Any, np.dtype[np.int64]], commands: Floats, poses: Track, source: str,
    notes: tuple[str, ...] = (),
) -> IdentifiedRobot:  # fmt: skip
    """How a robot follows commands (v, w), shape (M, 2), sent at rising instants [ns]. Raises UserError."""
    usable = np.isfinite(commands).all(axis=1)
    instants, commands = instants[usable], commands[usable]
    if len(instants) < 2:
        raise UserError(f"{source}: {counted(len(instants), 'command')} with finite numbers; at least 2 are needed")
    zero = int(instants[0])
    sent, seen = (instants - zero) / NS_PER_S, (poses.stamps - zero) / NS_PER_S
    period = float(np.median(np.diff(sent)))
    # What was commanded a dead time before the first command is not known, nor what the robot does after the last one.
    covered = np.flatnonzero((seen >= LONGEST_DEAD_TIME) & (seen <= sent[-1] + period))
    if len(covered) < _LEAST_POSES:
        raise UserError(
            f"{source}: {counted(len(covered), 'pose lies', 'poses lie')} between {LONGEST_DEAD_TIME:g} s after "
            "the first command and the last "
            f"one; at least {_LEAST_POSES} are needed: do the commands' and the poses' clocks agree?"
        )
    rows = covered[:MOST_POSES]
    t, x, y, theta = seen[rows], poses.x[rows], poses.y[rows], poses.theta[rows]
    w = _identified(SPEEDS[1], sent, commands[:, 1], turned(t, theta), period)
    heading_noise = 0.0 if w.fit is None else w.fit.white_noise
    v = _identified(SPEEDS[0], sent, commands[:, 0], moved_forwards(t, x, y, theta, heading_noise), period)
    said = (*notes, *_notes(sent, period, len(covered), int(np.count_nonzero(~usable))))
    fastest = float(np.abs(commands[:, 0]).max())
    return IdentifiedRobot(source, (v, w), float(np.median(np.diff(t))), period, fastest, said)


def _notes(sent: Floats, period: float, covered: int, unusable: int) -> Iterator[str]:
    if unusable:
        yield f"{counted(unusable, 'command is', 'commands are')} not finite, they are left out"
    if covered > MOST_POSES:
        yield f"of {counted(covered, 'pose')} the first {MOST_POSES} are used"
    pause = float(np.diff(sent).max())
    if pause > max(0.5, 10.0 * period):
        yield f"no command came for {pause:.2f} s; the robot is taken to follow the last one meanwhile"


def _identified(named: Named, sent: Floats, values: Floats, seen: Increments, period: float) -> IdentifiedSpeed:
    if np.ptp(values) == 0.0:
        return IdentifiedSpeed(
            named, None, f"not excited: the commanded {named.meaning} is {values[0]:g} {named.unit} all the time"
        )
    fit = fit_first_order(HeldCommand(sent, values), seen, -2.0 * period, has_offset=named.key == "w")
    if fit is None:
        return IdentifiedSpeed(
            named, None, f"not excited: the commanded {named.meaning} does not change while poses came"
        )
    if reason := _refusal(named, fit, period):
        return IdentifiedSpeed(named, None, reason)
    return IdentifiedSpeed(named, _not_negative(fit, period))


def _refusal(named: Named, fit: FirstOrderFit, period: float) -> str:
    """Why the fit is no answer; empty if it is."""
    dead_time, gain = fit.dead_time, fit.gain
    if gain.low <= 0.0 <= gain.high or gain.width > _WIDEST_GAIN * abs(gain.value):
        return (
            f"not excited enough: the gain of the {named.meaning} may be {gain.low:.3g} to {gain.high:.3g}; "
            f"let the commanded {named.meaning} change more, and more often"
        )
    if gain.value < 0.0:
        return (
            f"the robot's {named.meaning} goes against its command (gain {gain.value:.3g}): are signs and frames right?"
        )
    if not fit.is_inside:
        return (
            f"no dead time up to {LONGEST_DEAD_TIME:g} s and no lag up to {LONGEST_LAG:g} s fits: are the commands "
            "those that the robot follows, and do the clocks agree?"
        )
    if dead_time.width > _WIDEST_DEAD_TIME:
        return (
            f"not excited enough: the dead time of the {named.meaning} may be {dead_time.low:.3f} to "
            f"{dead_time.high:.3f} s; let the commanded {named.meaning} change more, and more often"
        )
    if dead_time.high < -period:
        return f"the robot's {named.meaning} changes {-dead_time.value:.3f} s before its command: do the clocks agree?"
    if fit.explained < _LEAST_EXPLAINED or fit.inflation > _MOST_INFLATION:
        return (
            f"the {named.meaning} does not follow its command as a first-order lag behind a dead time does "
            f"({fit.explained:.0%} explained, variances {fit.inflation:.1f} times those of white residuals)"
        )
    return ""


def _not_negative(fit: FirstOrderFit, period: float) -> FirstOrderFit:
    """The fit with a dead time of at least 0.

    A motion that begins up to a period before the stamp of its command is that of a drive in discrete time: the dead
    time is then known to a period only.
    """
    found = fit.dead_time
    high = found.high if found.high > 0.0 else period
    return replace(fit, dead_time=Interval(max(0.0, found.value), max(0.0, found.low), high))
