"""Whether a robot's poses and commands came when their stamps say, by the log times of a recording at the edge."""

from __future__ import annotations

import dataclasses

import numpy as np

from agv_analysis.bags import Bag
from agv_analysis.bags.layout import LOG_TIME
from agv_analysis.recordings.loop_timing import is_more_than_jitter, late_sentences
from agv_analysis.recordings.messages_on_steps import Steps, stamps_of
from agv_analysis.recordings.posture_track import Track
from agv_analysis.recordings.receive_times import MAX_RATE, ClockLine, clock_line, newest_held, says_nothing
from agv_analysis.recordings.robot_commands import clock_ahead
from agv_analysis.run import Run, Timing
from agv_ros.stamps import NS_PER_S

SIMULATED_CLOCK = "rosgraph_msgs/msg/Clock"

_DAY_NS = 86_400 * NS_PER_S
"""Clocks of hosts differ by less; stamps that are further from the log times are of another kind of time."""


def with_timing(run: Run, bag: Bag, command_topic: str | None, came: Track, k: Steps) -> Run:
    """The run with its timing and with what a reader must know of it in its notes.

    `came`: the poses that make the run, `k` their steps, from 0 on.
    """
    line = clock_line(came.stamps, came.log_times)
    unknown = says_nothing(came.stamps, came.log_times) or _other_time(bag, line)
    if unknown:
        sentence = f"{unknown}: when poses came is not recorded, ages are those of the stamps"
        timing = Timing(False, run.n_ul, unknown=unknown, sentences=(sentence,))
        return dataclasses.replace(run, timing=timing, notes=(*run.notes, sentence))
    steps = np.arange(len(run))
    late = periods_late(line, came.stamps, came.log_times, run.ts)
    n_ul = steps - np.maximum(newest_held(k, k + late, len(run)), 0)
    behind, late_commands = _commands_behind(bag, command_topic, came, run)
    age = n_ul if behind is None else behind + n_ul[steps - behind]
    age = np.maximum(age, run.n_ul)
    timing = Timing(
        is_late=is_more_than_jitter(age - run.n_ul),
        command_age=age,
        late_poses=int(np.count_nonzero(late)),
        late_commands=late_commands,
    )
    timed = dataclasses.replace(run, n_ul_received=n_ul, n_dl_received=behind, timing=timing)
    sentences = tuple(late_sentences(timed, timing)) if timing.is_late else ()
    return dataclasses.replace(
        timed, timing=dataclasses.replace(timing, sentences=sentences), notes=(*run.notes, *sentences)
    )


def periods_late(line: ClockLine, stamps: Steps, log_times: Steps, ts: float) -> Steps:
    """Whole sampling periods `ts` [s] by which each message came later than the clock's line, shape (M,)."""
    delays = log_times - line.log_times(stamps)
    return np.asarray(np.floor(delays / (ts * NS_PER_S)).astype(np.int64))


def _other_time(bag: Bag, line: ClockLine) -> str:
    """Why log times and stamps cannot be compared; empty if they can."""
    if any(topic.type == SIMULATED_CLOCK for topic in bag.topics.values()):
        return "the stamps are of a simulated clock"
    if abs(line.rate) > MAX_RATE and abs(line.offset_ns) > _DAY_NS:
        return "log times do not run as fast as the stamps, which are of another kind of time"
    return ""


def _commands_behind(bag: Bag, topic: str | None, came: Track, run: Run) -> tuple[Steps | None, int]:
    """Steps by which the newest command that had come at each step is behind the newest that was sent, shape (N,).

    And how many came too late. None for commands without stamps, which do not say when they were sent.
    """
    if topic is None or "header.stamp.sec" not in (bag[topic].dtype.names or ()):
        return None, 0
    messages = bag[topic]
    stamps, log_times = stamps_of(messages), np.asarray(messages[LOG_TIME], dtype=np.int64)
    if not stamps.all() or clock_ahead(bag, topic, came):
        return None, 0
    if len(np.unique(stamps)) < len(stamps) / 2 or says_nothing(stamps, log_times):
        return None, 0
    order = np.argsort(stamps, kind="stable")
    stamps, log_times = stamps[order], log_times[order]
    late = periods_late(clock_line(stamps, log_times), stamps, log_times, run.ts)
    k = np.floor((stamps - came.stamps[0]) / (run.ts * NS_PER_S)).astype(np.int64)
    sent, arrived = newest_held(k, k, len(run)), newest_held(k, k + late, len(run))
    return np.where(arrived >= 0, sent - arrived, 0), int(np.count_nonzero(late))
