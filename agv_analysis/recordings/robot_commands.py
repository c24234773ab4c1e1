"""The commands of a robot on the steps of its run."""

from __future__ import annotations

import numpy as np

from agv_analysis.bags import Bag
from agv_analysis.bags.layout import LOG_TIME
from agv_analysis.recordings.clock_steps import other_clock
from agv_analysis.recordings.messages_on_steps import Steps, stamps_of
from agv_analysis.recordings.posture_track import Track, by_the_clock_of, messages_of
from agv_analysis.run import Floats
from agv_ros.stamps import NS_PER_S

COMMANDS = {"geometry_msgs/msg/Twist": "", "geometry_msgs/msg/TwistStamped": "twist."}
"""Types of a command, each with what stands before the path of a speed in it."""


def read_commands(
    bag: Bag, topic: str | None, came: Track, stamps: Steps, period: float
) -> tuple[Floats, tuple[str, ...]]:
    """The newest command (v, w) when each period ends, shape (N, 2), NaN before the first; and notes on it.

    A command without a stamp belongs to the instant whose pose had just been logged: its log time is carried over to
    the clock of the poses' stamps.
    """
    command = np.full((len(stamps), 2), np.nan)
    if topic is None:
        return command, ("no command: the damping of the speed is not computed",)
    messages = messages_of(bag, topic, tuple(COMMANDS), "command")
    prefix = COMMANDS[bag.topics[topic].type]
    instants, notes = stamps_of(messages) if prefix else np.zeros(len(messages), dtype=np.int64), []
    if not instants.any():
        instants = by_the_clock_of(came, messages[LOG_TIME])
    elif not instants.all():
        notes.append(
            f"{topic}: {np.count_nonzero(instants == 0)} stamps are 0, which is no time, their messages are left out"
        )
        messages, instants = messages[instants != 0], instants[instants != 0]
    if prefix and (ahead := clock_ahead(bag, topic, came)):
        notes.append(
            f"{topic}: its stamps are by another clock, {ahead / NS_PER_S:+.2f} s from that of the poses by the log "
            "times, which count"
        )
        instants = by_the_clock_of(came, messages[LOG_TIME])
    order = np.argsort(instants, kind="stable")
    ends = np.append(stamps[1:], stamps[-1] + round(period))
    newest = np.searchsorted(instants[order], ends, side="left") - 1
    known = newest >= 0
    for column, speed in enumerate(("linear.x", "angular.z")):
        command[known, column] = messages[prefix + speed][order][newest[known]]
    if held := int(np.count_nonzero(np.diff(newest[known]) == 0)):
        notes.append(f"{topic}: no command came in {held} of {len(stamps)} steps, the last one is held")
    return command, tuple(notes)


def clock_ahead(bag: Bag, topic: str, came: Track) -> int:
    """How far [ns] the clock of a topic's stamps is ahead of the poses'; 0 if it may be the same, or there are none."""
    messages = bag[topic]
    stamps = stamps_of(messages)
    there = stamps != 0
    if not there.any():
        return 0
    return other_clock(stamps[there], messages[LOG_TIME][there].astype(np.int64), came.stamps, came.log_times)
