"""Signals to nodes that were started one by one, as `ros2 run` and `agv-ncs node` do: no runner watches over them."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from agv_plant.plant_node import progress_line
from torture.kills import (
    HALT,
    IN_TIME,
    NODES,
    SHARE,
    STEPS,
    TS,
    Case,
    lost_steps,
    outage_settings,
    recorded_bytes,
    until,
)

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
    early: tuple[str, ...]
    """Nodes, neither plant nor the one that got the signal, that had ended before they were asked to."""
    orphans: tuple[str, ...]


def run_by_hand(case: Case, folder: Path, params: str) -> EndedByHand:
    """Start the nodes one by one, recorded to `folder`/bag, send the signal, wait for the plant and end the others."""
    begun: dict[str, subprocess.Popen[str]] = {}
    try:
        for node in NODES[1:]:
            with (folder / f"{node}.log").open("w") as log:
                words = [sys.executable, "-m", "agv_analysis.cli", "node", node]
                words += _arguments(node, case, folder, params)
                begun[node] = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=log, stderr=log, text=True)
        return _hurt(case, folder, begun)
    finally:
        for process in begun.values():
            process.kill()
            process.wait()


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


def _hurt(case: Case, folder: Path, begun: dict[str, subprocess.Popen[str]]) -> EndedByHand:
    plant, victim = begun["plant"], begun[case.node]
    share, log = SHARE[case.moment], folder / f"{case.node}.log"
    if share is None:
        until(victim, lambda: "[INFO]" in log.read_text())
    else:
        until(plant, lambda: recorded_bytes(folder / "bag") > share * STEPS[case.clock])
    sent = time.monotonic()
    with contextlib.suppress(ProcessLookupError):
        victim.send_signal(case.number)
        if case.number == signal.SIGSTOP:
            time.sleep(HALT)
            victim.send_signal(signal.SIGCONT)
    victim_seconds = 0.0
    if case.number != signal.SIGSTOP:
        until(None, lambda: victim.poll() is not None)
        victim_seconds = time.monotonic() - sent
    if share is not None or case.number == signal.SIGSTOP:
        until(plant, lambda: False)
    # From the start on a loop that lacks a node waits for it for minutes, as it should.
    time.sleep(_OUTLIVES)
    early = tuple(n for n, p in begun.items() if n not in ("plant", case.node) and p.poll() is not None)
    seconds, recorder = 0.0, begun["recorder"]
    for group in ([process for process in begun.values() if process is not recorder], [recorder]):
        asked = time.monotonic()
        for process in group:
            process.send_signal(signal.SIGINT)  # does nothing to one that has ended
        until(None, lambda group=group: all(process.poll() is not None for process in group))  # type: ignore[misc]
        seconds = max(seconds, time.monotonic() - asked)
    orphans = tuple(node for node, process in begun.items() if process.poll() is None)
    return EndedByHand(
        {node: process.returncode for node, process in begun.items() if process.returncode is not None},
        {node: (folder / f"{node}.log").read_text(errors="replace") for node in begun},
        victim_seconds, seconds, early, orphans,
    )  # fmt: skip


def faults_by_hand(case: Case, ended: EndedByHand, bag: Path) -> list[str]:
    """What is not as it should be, in words; empty if all is."""
    found = [f"{node} does not end" for node in ended.orphans]
    found += [f"{node} ended by itself" for node in ended.early]
    if ended.victim_seconds > IN_TIME:
        found.append(f"{case.node} ended after {ended.victim_seconds:.1f} s")
    if ended.seconds > IN_TIME:
        found.append(f"the others ended after {ended.seconds:.1f} s")
    found += [f"{node} said a traceback" for node, said in ended.said.items() if "Traceback" in said]
    found += [wrong for node, status in ended.statuses.items() if (wrong := _wrong_status(case, node, status, ended))]
    return found + lost_steps(case, "\n".join(ended.said.values()), bag)


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
