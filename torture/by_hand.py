"""Signals to nodes that were started one by one, as `ros2 run` and `agv-ncs node` do: no runner watches over them."""

from __future__ import annotations

import functools
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from agv_analysis.runtime.executables import run_node_of
from agv_plant.progress_line import progress_line
from torture.forked import Forked
from torture.kills import (
    HALT,
    LAG,
    NODES,
    STEPS,
    TS,
    Case,
    has_come,
    lost_steps,
    outage_settings,
    too_late,
    until,
)
from torture.starvation import Starvation

_OUTLIVES = 0.5
"""How long [s] a node that ended is waited for beyond what it needs, so that all others are asked at once."""


class EndedByHand(NamedTuple):
    """How nodes that were started by hand ended."""

    statuses: dict[str, int]
    """Exit status of each node."""
    said: dict[str, str]
    victim_seconds: float
    """From the signal to the end of the process that got it; 0 for one that is only halted."""
    seconds: float
    """From the request to the end of those that were left after the plant, and then of the recorder; the longer one."""
    starved: float
    """For how long [s], of these times, nodes waited for a processor."""
    lag: float
    """The same shortly before the signal."""
    early: tuple[str, ...]
    """Nodes, neither plant nor the one that got the signal, that had ended before they were asked to."""
    orphans: tuple[str, ...]


def run_by_hand(case: Case, folder: Path, params: str) -> EndedByHand:
    """Start the nodes one by one, recorded to `folder`/bag, send the signal, wait for the plant and end the others."""
    begun: dict[str, Forked] = {}
    try:
        for node in NODES[1:]:
            words = list(_arguments(node, case, folder, params))
            begun[node] = Forked(functools.partial(run_node_of, node, words), folder / f"{node}.log")
        return _hurt(case, folder, begun)
    finally:
        for process in begun.values():
            process.kill()


def _arguments(node: str, case: Case, folder: Path, params: str) -> Iterator[str]:
    yield from ("--ros-args", "--params-file", params)
    given = {"wait_for_subscribers": "2"}
    if node == "recorder":
        given = {"bag": str(folder / "bag"), "params_file": params}
    elif node == "plant":
        given |= {"clock": case.clock, "duration": str(STEPS[case.clock] * TS)}
    elif node == "relay":
        given |= {name: f"'{value}'" for name, value in outage_settings(case).items()}  # quoted, as YAML wants it
    for name, value in given.items():
        yield from ("-p", f"{name}:={value}")


def _hurt(case: Case, folder: Path, begun: dict[str, Forked]) -> EndedByHand:
    plant, victim = begun["plant"], begun[case.node]
    is_start, pids = case.moment == "start", [process.pid for process in begun.values()]
    before = Starvation(pids)
    if is_start:
        until(victim, lambda: "[INFO]" in victim.said())
    else:
        until(plant, lambda: has_come(case, folder / "bag"), watched=before)
    lag = before.in_the_last(LAG)
    sent, starvation = time.monotonic(), Starvation(pids)
    victim.send_signal(case.number)
    if case.number == signal.SIGSTOP:
        time.sleep(HALT)
        victim.send_signal(signal.SIGCONT)
    victim_seconds = 0.0
    if case.number != signal.SIGSTOP:
        until(None, lambda: victim.poll() is not None, watched=starvation)
        victim_seconds = time.monotonic() - sent
    if not is_start or case.number == signal.SIGSTOP:
        until(plant, lambda: False)
    # From the start on a loop that lacks a node waits for it for minutes, as it should.
    time.sleep(_OUTLIVES)
    early = tuple(n for n, p in begun.items() if n not in ("plant", case.node) and p.poll() is not None)
    seconds, recorder = 0.0, begun["recorder"]
    for group in ([process for process in begun.values() if process is not recorder], [recorder]):
        asked = time.monotonic()
        starvation.look()
        for process in group:
            process.send_signal(signal.SIGINT)
        until(None, lambda group=group: all(p.poll() is not None for p in group), watched=starvation)  # type: ignore[misc]
        seconds = max(seconds, time.monotonic() - asked)
    orphans = tuple(node for node, process in begun.items() if process.poll() is None)
    return EndedByHand(
        {node: process.returncode for node, process in begun.items() if process.returncode is not None},
        {node: process.said() for node, process in begun.items()},
        victim_seconds, seconds, starvation.seconds, lag, early, orphans,
    )  # fmt: skip


def faults_by_hand(case: Case, ended: EndedByHand, bag: Path) -> list[str]:
    """What is not as it should be, in words; empty if all is."""
    found = [f"{node} does not end" for node in ended.orphans]
    found += [f"{node} ended by itself" for node in ended.early]
    for whose, seconds in ((f"the {case.node}", ended.victim_seconds), ("the others", ended.seconds)):
        found += too_late(f"{whose} ended", seconds, ended.starved, ended.lag)
    found += [f"{node} said a traceback" for node, said in ended.said.items() if "Traceback" in said]
    found += [wrong for node, status in ended.statuses.items() if (wrong := _wrong_status(case, node, status, ended))]
    return found + lost_steps(case, "\n".join(ended.said.values()), bag, ended.lag)


def _wrong_status(case: Case, node: str, status: int, ended: EndedByHand) -> str:
    """Is the status of a node such as its part in the case asks for? Empty if it is."""
    is_halted, is_start = case.number == signal.SIGSTOP, case.moment == "start"
    is_complete = progress_line(STEPS[case.clock], STEPS[case.clock]) in ended.said["plant"]
    if node == case.node and case.number == signal.SIGKILL:
        allowed = {-int(signal.SIGKILL), *({0} if node == "plant" and is_complete else ())}
    elif node == "plant":
        if status == 0:
            return "" if is_complete else "the plant ends with 0 and has not done its steps"
        if is_halted or (case.node == "recorder" and not is_start):
            return f"the plant ends with {status}"
        # Who was killed cannot take leave: until its lease ends, the others cannot tell it from one that is slow.
        names = case.node in ended.said["plant"] or is_start or case.number == signal.SIGKILL or case.node == "plant"
        return "" if status == 1 and names else f"the plant ends with {status}, does not name the {case.node}"
    elif node == "recorder" and is_start:
        allowed = {0, 1}  # of a loop that did not begin there is nothing to record
    else:
        allowed = {0}
    return "" if status in allowed else f"the {node} ends with {status}"
