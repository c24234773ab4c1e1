"""Whether a recorded run in real time kept the time that its stamps say: late poses, late commands, missed deadlines.

A run in lockstep has no timing: its steps take what they take, and nothing is said of it. In real time the plant takes
step k when it publishes the pose of step k + 1; which poses and commands had come by then, the log times say. That is
exact if the recorder hears `edge/*` at the edge and `agv/*` at the AGV without delay, as beside a relay it does. Where
the AGV took a command later than the recorder heard it, its motion says so.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags import Bag
from agv_analysis.bags.layout import LOG_TIME
from agv_analysis.bags.writer import METADATA_NAME, REPLAY_OF
from agv_analysis.metrics.outages import ages
from agv_analysis.recordings.acting_commands import command_ages, obeys_at_once
from agv_analysis.recordings.messages_on_steps import NOTHING, OnSteps, Steps, on_steps, stamps_of
from agv_analysis.recordings.node_reports import reports_of, total
from agv_analysis.recordings.receive_times import (
    clock_line,
    newest_at,
    newest_held,
    says_nothing,
    usable_from,
)
from agv_analysis.run import Run, Timing
from agv_analysis.scenario import Scenario
from agv_ros.counted import counted
from agv_ros.stamps import NS_PER_S

START_UP = 0.1
"""A run in real time may take this time [s] from its first step until its nodes keep pace."""

RARE = 0.01
"""A message that is late by less than two periods, in no more than this share of the steps, is jitter."""


@dataclasses.dataclass(frozen=True)
class Deadlines:
    """What plant and edge say of a run in real time."""

    steps: int
    missed: int
    longest_overdue: float
    stops: int
    ignored: int
    missed_edge_steps: int | None


def is_timed(bag: Bag, run: Run) -> bool:
    """Had the run a timing: was it driven in real time, and is it no replay of another one?"""
    is_replay = REPLAY_OF in bag.metadata.get(METADATA_NAME, {})
    return run.scenario.plant.clock == "realtime" and not is_replay


def with_timing(
    run: Run, bag: Bag, names: Mapping[str, str], diagnostics: NDArray[np.void] | None, namespace: str
) -> Run:
    """The run with its timing, if it had one, and with what a reader must know of it in its notes.

    `names`: the bag's name of each topic of the loop; `diagnostics`: None if they are not recorded.
    """
    if not is_timed(bag, run):
        return run
    said = None if diagnostics is None else deadlines_of(diagnostics, namespace, len(run))
    topics = {topic: _as_received(bag[name], run.scenario) for topic, name in names.items()}
    poses = topics["agv/pose"]
    stamps, logs = stamps_of(poses.messages), _logs(poses)
    unknown = says_nothing(stamps, logs)
    if not unknown and 20 * np.ptp(logs) < np.ptp(stamps):
        unknown = "log times last less than a twentieth of what the stamps do"
    if unknown:
        timing = Timing(False, run.n_ul, unknown=unknown)
    else:
        run = _as_received_at_edge_and_agv(run, topics, said)
        assert run.timing is not None
        timing = run.timing
    if said is not None:
        timing = dataclasses.replace(
            timing, deadlines=said.steps, missed_deadlines=said.missed, longest_overdue=said.longest_overdue,
            missed_edge_steps=said.missed_edge_steps,
        )  # fmt: skip
    timing = dataclasses.replace(timing, sentences=tuple(_sentences(run, timing, said)))
    return dataclasses.replace(run, timing=timing, notes=(*run.notes, *timing.sentences))


def deadlines_of(diagnostics: NDArray[np.void], namespace: str, steps: int) -> Deadlines | None:
    """What the nodes of a namespace say; None if the plant says nothing of deadlines. `steps`: of the recording."""
    plant = reports_of(diagnostics, f"{namespace}plant")
    if "missed deadlines" not in plant:
        return None
    edge = reports_of(diagnostics, f"{namespace}error_detector")
    steps = round(max(plant.get("step", [steps])))
    return Deadlines(
        steps=steps,
        missed=min(total(plant["missed deadlines"]), steps),  # plants counted on after the last step, once
        longest_overdue=max(plant.get("jitter max [s]", plant.get("jitter max", [0.0]))),  # bags of 0.1.0 have no unit
        stops=total(plant.get("stops without command", [0.0])),
        ignored=total(plant.get("outdated commands", [0.0])),
        missed_edge_steps=total(edge["missed steps"]) if "missed steps" in edge else None,
    )


def _as_received(messages: NDArray[np.void], scenario: Scenario) -> OnSteps:
    """The messages of a topic, of each step the one that came first."""
    in_order = messages[np.argsort(messages[LOG_TIME], kind="stable")]
    return on_steps(in_order, scenario.grid, scenario.plant.window_steps)


def _logs(messages: OnSteps) -> Steps:
    """Log times [ns] of messages, shape (M,)."""
    return np.asarray(messages.messages[LOG_TIME], dtype=np.int64) if len(messages.k) else messages.k


def _as_received_at_edge_and_agv(run: Run, topics: Mapping[str, OnSteps], said: Deadlines | None) -> Run:
    """The run with its timing and the ages by receive time, from log times."""
    first, count = int(run.k[0]), int(run.k[-1] - run.k[0]) + 1
    rows, steps = run.k - first, np.arange(count)
    ends = _ends(run, topics["agv/pose"], first, count, said)
    n_ul, n_dl = _dense(run.n_ul, rows), _dense(_stamped_downlink_age(run), rows)

    poses = _arrivals(topics["edge/pose"], first) if len(topics.get("edge/pose", NOTHING).k) else None
    n_ul_received = None if poses is None else _age(poses, ends)
    sent = _sent(topics["edge/cmd_vel"], first, ends)
    behind = steps - n_ul if poses is None else np.minimum(_pose_behind(poses, sent), steps - n_ul)

    commands = topics["agv/cmd_vel"] if len(topics.get("agv/cmd_vel", NOTHING).k) else topics["edge/cmd_vel"]
    if said is not None and said.ignored and not obeys_at_once(run):
        ahead = round(run.scenario.plant.cmd_vel_timeout / run.ts)
        commands = _not_ignored(commands, topics["agv/pose"], ahead)
    taken = _arrivals(commands, first)
    n_dl_received = np.maximum(_age(taken, ends), _dense(command_ages(run), rows))

    by_receive_time = n_dl_received + _age_when_sent(behind, n_dl_received)
    by_stamps = n_dl + _age_when_sent(steps - n_ul, n_dl)
    acted = np.maximum(by_receive_time, by_stamps)[rows]
    begun = rows > min(START_UP / run.ts, count / 10.0)
    timing = Timing(
        is_late=is_more_than_jitter((acted - _explained_by_losses(run, n_ul, rows))[begun]),
        command_age=acted,
        late_poses=0 if poses is None else _late(poses, ends),
        late_commands=_late(taken, ends),
    )
    return dataclasses.replace(
        run,
        timing=timing,
        n_ul_received=None if n_ul_received is None else n_ul_received[rows],
        n_dl_received=n_dl_received[rows],
    )


class Arrivals(NamedTuple):
    """Messages of a topic by their steps, counted from the first of the run, and when they came; shape (M,)."""

    steps: Steps
    logs: Steps


def _arrivals(messages: OnSteps, first: int) -> Arrivals:
    return Arrivals(messages.k - first, _logs(messages))


def _age(arrivals: Arrivals, ends: Steps) -> Steps:
    """Steps since the freshest message that had come when each step ended, since the beginning if none had; (N,)."""
    held = newest_held(arrivals.steps, usable_from(*arrivals, ends), len(ends))
    return np.asarray(np.arange(len(ends)) - np.maximum(held, 0))


def _late(arrivals: Arrivals, ends: Steps) -> int:
    """How many messages came after their own step had ended."""
    return int(np.count_nonzero(usable_from(*arrivals, ends) > arrivals.steps))


def _sent(commands: OnSteps, first: int, ends: Steps) -> Steps:
    """Log time until which poses could be used for the command of each step: it was sent, or its step ended; (N,)."""
    index, there = commands.at(np.arange(len(ends)) + first)
    return np.where(there, np.maximum(ends, _logs(commands)[index]), ends) if there.any() else ends


def _pose_behind(poses: Arrivals, sent: Steps) -> Steps:
    """Step of the freshest pose that had come when the command of each step was sent, shape (N,); 0 if none had."""
    return np.clip(newest_at(*poses, sent), 0, np.arange(len(sent)))


def _age_when_sent(behind: Steps, command_age: Steps) -> Steps:
    """Age of the pose behind a command when that was sent, of the command that is `command_age` old at each step."""
    command = np.maximum(np.arange(len(behind)) - command_age, 0)  # one from before the recording has no pose in it
    return np.asarray(command - behind[command])


def is_more_than_jitter(excess: NDArray[np.int64]) -> bool:
    """Are ages older than they should be, by `excess` steps, by more than jitter of less than one period makes them?

    One step too old, now and then, a message is that comes just before the end of its period or just after it.
    """
    return bool((excess >= 2).any()) or bool(np.count_nonzero(excess >= 1) > RARE * len(excess))


def _ends(run: Run, poses: OnSteps, first: int, count: int, said: Deadlines | None) -> Steps:
    """Log time at which the plant took each step: when it published the next pose, shape (count,).

    No earlier than the clock says; and later only by as much as the plant itself was late at most, since beyond that it
    was the recording that was.
    """
    grid, ts_ns = run.scenario.grid, run.scenario.grid.ts_ns
    k = np.arange(first + 1, first + count + 1)
    due = clock_line(stamps_of(poses.messages), _logs(poses)).log_times(grid.start_ns + k * ts_ns)
    index, there = poses.at(k)
    published = np.where(there, _logs(poses)[index], due)
    leeway = ts_ns + (0 if said is None else round(said.longest_overdue * NS_PER_S))
    return np.maximum.accumulate(np.clip(published, due, due + leeway))


def _not_ignored(commands: OnSteps, poses: OnSteps, ahead: int) -> OnSteps:
    """The commands that a plant took which ignored some: not those that came long before their own instant."""
    if not len(commands.k):
        return commands
    index, there = poses.at(commands.k - ahead)
    taken = ~there | (_logs(commands) >= _logs(poses)[index])
    return commands._replace(k=commands.k[taken], messages=commands.messages[taken])


def _stamped_downlink_age(run: Run) -> Steps:
    return ages(run.k, run.downlink_lost) if run.n_dl is None else run.n_dl


def _dense(age: Steps, rows: Steps) -> Steps:
    """Ages of all steps from the first one on, from those of the rows: between them they grow."""
    steps = np.arange(int(rows[-1]) + 1)
    row = np.searchsorted(rows, steps, side="right") - 1
    return np.asarray(age[row] + steps - rows[row])


def _explained_by_losses(run: Run, n_ul: Steps, rows: Steps) -> Steps:
    """Ages of the poses behind the commands that acted, if nothing but losses made any of them older; shape (N,)."""
    lost = _dense(ages(run.k, run.lost), rows)
    received = np.flatnonzero(~run.lost)
    before = rows[received[0]] if len(received) else len(n_ul)
    explained = np.where(np.arange(len(n_ul)) < before, n_ul, lost)
    since = ages(run.k, run.downlink_lost)
    return np.asarray(since + explained[rows - since])


def _sentences(run: Run, timing: Timing, said: Deadlines | None) -> Iterator[str]:
    """What a reader must know of the timing of a run in real time."""
    if timing.unknown:
        yield f"{timing.unknown}: when poses and commands came is not recorded, ages are those of the stamps"
    elif run.n_ul_received is None:
        yield "edge/pose is not in the recording: when poses came to the edge is not known"
    if said is None:
        yield "the plant's diagnostics are not in the recording: missed deadlines are not known"
    elif said.missed:
        yield (
            f"{said.missed} of {counted(said.steps, 'deadline')} missed, the longest by "
            f"{_ms(said.longest_overdue)}; the AGV held "
            "its command"
        )
    if said is not None and said.stops:
        times = counted(said.stops, "time")
        yield f"the AGV stopped {times} because its newest command was older than plant.cmd_vel_timeout"
    if said is not None and said.missed_edge_steps:
        yield f"the edge missed {said.missed_edge_steps} of its steps"
    if timing.is_late:
        yield from late_sentences(run, timing)
        if said is not None and said.ignored > RARE * said.steps:
            yield (
                f"the AGV ignored {counted(said.ignored, 'command')}, which came after a newer one or long before "
                "their instant"
            )


def late_sentences(run: Run, timing: Timing) -> Iterator[str]:
    """How late poses and commands were; `run` has the ages by receive time of at least one of them."""
    if timing.late_poses and run.n_ul_received is not None:
        yield (
            f"{counted(timing.late_poses, 'pose')} came a sampling period or more too late: age by receive time "
            "at most "
            f"{_steps(run, run.n_ul_received)}, by stamps {int(run.n_ul.max())}"
        )
    oldest = 0 if run.n_dl_received is None else int(run.n_dl_received.max())
    if run.n_dl_received is not None and oldest > (0 if run.n_dl is None else int(run.n_dl.max())):
        yield (
            f"{counted(timing.late_commands, 'command')} came after the step that they were for had ended; the "
            "AGV acted on "
            f"commands at most {_steps(run, run.n_dl_received)} old"
        )
    yield (
        f"the timing was not what the stamps say: the pose behind a command that acted was at most "
        f"{_steps(run, timing.command_age)} old"
    )


def _steps(run: Run, age: NDArray[np.int64]) -> str:
    most = int(age.max())
    return f"{counted(most, 'step')} ({most * run.ts:g} s)"


def _ms(duration: float) -> str:
    return f"{duration * 1e3:.3g} ms"
