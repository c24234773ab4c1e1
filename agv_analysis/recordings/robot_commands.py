"""The commands of a robot on the steps of its run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags import Bag
from agv_analysis.bags.layout import LOG_TIME
from agv_analysis.recordings.clock_steps import other_clock
from agv_analysis.recordings.messages_on_steps import Steps, stamps_of
from agv_analysis.recordings.posture_track import Track, by_the_clock_of, messages_of
from agv_analysis.run import Floats
from agv_ros.counted import counted
from agv_ros.errors import UserError
from agv_ros.stamps import NS_PER_S

COMMANDS = {
    "geometry_msgs/msg/Twist": "", "geometry_msgs/msg/TwistStamped": "twist.",
    "ackermann_msgs/msg/AckermannDrive": "", "ackermann_msgs/msg/AckermannDriveStamped": "drive.",
}  # fmt: skip
"""Types of a command, each with what stands before the path of a speed in it."""


def read_commands(
    bag: Bag, topic: str | None, came: Track, stamps: Steps, period: float, wheelbase: float | None
) -> tuple[Floats, tuple[str, ...]]:
    """The newest command (v, w) when each period ends, shape (N, 2), NaN before the first; and notes on it.

    A command without a stamp belongs to the instant whose pose had just been logged: its log time is carried over to
    the clock of the poses' stamps. Of a car's commands `wheelbase` [m] makes a rate of turn; without it UserError is
    raised.
    """
    command = np.full((len(stamps), 2), np.nan)
    if topic is None:
        return command, ("no command: the damping of the speed is not computed",)
    instants, speeds, notes = sent_commands(bag, topic, came, wheelbase)
    ends = np.append(stamps[1:], stamps[-1] + round(period))
    newest = np.searchsorted(instants, ends, side="left") - 1
    known = newest >= 0
    command[known] = speeds[newest[known]]
    if held := int(np.count_nonzero(np.diff(newest[known]) == 0)):
        notes = (*notes, f"{topic}: no command came in {held} of {counted(len(stamps), 'step')}, the last one is held")
    return command, notes


def sent_commands(bag: Bag, topic: str, came: Track, wheelbase: float | None) -> tuple[Steps, Floats, tuple[str, ...]]:
    """Instants [ns] of all commands by the clock of the poses' stamps, in order, shape (M,); and notes on them.

    Beside them the commands (v, w) [m/s, rad/s], shape (M, 2). `wheelbase` and errors as of `read_commands`.
    """
    messages = messages_of(bag, topic, tuple(COMMANDS), "command")
    prefix = COMMANDS[bag.topics[topic].type]
    instants, notes = stamps_of(messages) if prefix else np.zeros(len(messages), dtype=np.int64), []
    if not instants.any():
        instants = by_the_clock_of(came, messages[LOG_TIME])
    elif not instants.all():
        notes.append(
            f"{topic}: {counted(int(np.count_nonzero(instants == 0)), 'stamp is', 'stamps are')} 0, which means "
            "no time, their messages are left out"
        )
        messages, instants = messages[instants != 0], instants[instants != 0]
    if prefix and (ahead := clock_ahead(bag, topic, came)):
        notes.append(
            f"{topic}: its stamps are by another clock, {ahead / NS_PER_S:+.2f} s from that of the poses by the log "
            "times, which count"
        )
        instants = by_the_clock_of(came, messages[LOG_TIME])
    order = np.argsort(instants, kind="stable")
    speeds = np.column_stack(_speeds(messages, prefix, f"{bag.path}: {topic}", wheelbase))
    return instants[order], speeds[order].astype(np.float64), tuple(notes)


def _speeds(messages: NDArray[np.void], prefix: str, where: str, wheelbase: float | None) -> tuple[Floats, Floats]:
    """Speed and rate of turn [m/s, rad/s] that each message commands, shapes (M,).

    A car of wheelbase L at speed v, whose front wheel is steered by d, turns at v tan(d) / L.
    """
    if f"{prefix}steering_angle" not in (messages.dtype.names or ()):
        return messages[f"{prefix}linear.x"], messages[f"{prefix}angular.z"]
    if wheelbase is None:
        raise UserError(
            f"{where} has steering angles, which say how fast a car turns only with its wheelbase: name a params file "
            "with plant.bicycle.wheelbase with --config"
        )
    v, steering = (messages[prefix + name].astype(np.float64) for name in ("speed", "steering_angle"))
    return v, v * np.tan(steering) / wheelbase


def clock_ahead(bag: Bag, topic: str, came: Track) -> int:
    """How far [ns] the clock of a topic's stamps is ahead of the poses'; 0 if it may be the same, or there are none."""
    messages = bag[topic]
    stamps = stamps_of(messages)
    there = stamps != 0
    if not there.any():
        return 0
    return other_clock(stamps[there], messages[LOG_TIME][there].astype(np.int64), came.stamps, came.log_times)
