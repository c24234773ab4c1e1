"""Signals to the processes of a run: does it end as it should, with a reason, without orphans, with a readable bag?"""

from __future__ import annotations

import contextlib
import itertools
import os
import random
import re
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from agv_analysis.cli import main as command_line
from agv_analysis.recordings.recording import read_run
from agv_analysis.runtime.shared_memory import held_by, leftovers
from agv_ros.errors import UserError
from torture.forked import Forked
from torture.starvation import Starvation

NODES = ("runner", "recorder", "controller", "error_detector", "relay", "plant")
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL, signal.SIGSTOP)
CLOCKS = ("lockstep", "realtime")
MOMENTS = ("start", "running", "outage", "end")
STARTS = ("runner", "hand")
"""Who starts the nodes: `agv-ncs run --processes`, or a person one by one."""

IN_TIME = 5.0
"""How long [s] a run may take to end after the signal, beside what its processes wait for a processor."""

MOST_LOST = {"lockstep": 1000, "realtime": 40 + 20}
"""Steps that may be lost with a recorder that is killed: in real time 0.2 s, and what was on its way to it."""

BUSY = 1.0
"""Where processes have waited for a processor for longer than this [s], shortly before the signal and after it, ..."""

REPAIRS = 2 * 3.0
"""... DDS may have lost messages on their way to a reader that was late; it says only every 3 s that there are some."""

LAG = 2.0
"""How long [s] before the signal a lack of processors may be why the recorder is behind."""

HALT = 2.0
"""How long [s] SIGSTOP halts a process."""

STEPS = {"lockstep": 2000, "realtime": 500}
TS = 0.005
_BYTES_A_STEP = {"lockstep": 290, "realtime": 170}
"""What a step adds to the recording, about; in lockstep some 500 are written at a time."""

_SHARE = {"running": 0.3, "outage": 0.25, "end": 0.75}
"""Share of the run after which a moment has come; at the start as soon as the node is there. An outage adds less."""

_SETTLED = 0.5
"""A file in shared memory that is younger than this [s] may be about to be used."""

PATIENCE = 90.0
"""How long [s] anything may take before it counts as hanging."""


class Case(NamedTuple):
    """A signal to a process at a moment."""

    node: str
    number: signal.Signals
    clock: str
    moment: str
    start: str = "runner"

    def __str__(self) -> str:
        by_hand = ", by hand" if self.start == "hand" else ""
        return f"{self.number.name} to the {self.node}, {self.clock}, {self.moment}{by_hand}"


class Ended(NamedTuple):
    """How a run ended."""

    status: int
    said: str
    seconds: float
    """From the signal to the end."""
    starved: float
    """How much of it [s] processes of the run waited for a processor."""
    lag: float
    """How much they did [s] shortly before the signal: so much of a loop in real time can be on its way to a disk."""
    orphans: tuple[str, ...]
    """Processes of the run that outlived it."""
    left: tuple[Path, ...]
    """Files in shared memory that the process had which got the signal, and that no process uses any more."""


def cases() -> Iterator[Case]:
    """All combinations."""
    for start, clock, moment, node, number in itertools.product(STARTS, CLOCKS, MOMENTS, NODES, SIGNALS):
        if (start, node) != ("hand", "runner"):
            yield Case(node, number, clock, moment, start)


def in_fair_order(seed: int) -> list[Case]:
    """All cases, shuffled so that the first ones are a fair sample, however many there are.

    The next case is always one whose pairs of properties (this node with this signal, this clock at this moment, ...)
    have come least often so far.
    """
    left = list(cases())
    random.Random(seed).shuffle(left)
    seen: Counter[tuple[object, ...]] = Counter()
    order = []
    while left:
        case = min(left, key=lambda case: sum(seen[pair] for pair in itertools.combinations(case, 2)))
        left.remove(case)
        seen.update(itertools.combinations(case, 2))
        order.append(case)
    return order


def outage_settings(case: Case) -> dict[str, str]:
    """Parameters of the relay: for the moment in an outage one that begins after 0.2 s and does not end."""
    return {"uplink.schedule": "0.2: outage=1000"} if case.moment == "outage" else {}


def run(case: Case, folder: Path, params: str) -> Ended:
    """Start a run of the params file in processes, recorded to `folder`/bag, send the signal, and wait for its end."""
    steps = STEPS[case.clock]
    arguments = ["run", params, "--processes", "--clock", case.clock]
    arguments += ["--duration", str(steps * TS), "--bag", str(folder / "bag")]
    for name, value in outage_settings(case).items():
        arguments += ["--set", f"relay.{name}={value}"]
    runner = Forked(lambda: command_line(arguments), folder / "runner.log")
    family: dict[str, int] = {}
    try:
        until(runner, lambda: len(_children(runner.pid)) == len(NODES) - 1)
        family = _children(runner.pid)
        before = Starvation(family.values())
        if case.moment != "start":
            until(runner, lambda: has_come(case, folder / "bag"), watched=before)
        lag = before.in_the_last(LAG)
        victim = runner.pid if case.node == "runner" else family.get(case.node)
        held = [] if victim is None else held_by(victim)
        if runner.poll() is None:  # else the run has ended before: what it said is judged
            _send(victim, case.number)
        return _ended(runner, family, held, lag)
    finally:
        runner.kill()
        for pid in family.values():
            _send(pid, signal.SIGKILL)


def _send(pid: int | None, number: signal.Signals) -> None:
    """Send a signal; one that halts is followed, after a while, by the one that lets go on."""
    with contextlib.suppress(ProcessLookupError):
        if pid is not None:
            os.kill(pid, number)
            if number == signal.SIGSTOP:
                time.sleep(HALT)
                os.kill(pid, signal.SIGCONT)


def _ended(runner: Forked, family: dict[str, int], held: list[Path], lag: float) -> Ended:
    """Wait for the end of a run and of all of its processes."""
    begun, starvation = time.monotonic(), Starvation((runner.pid, *family.values()))
    until(runner, lambda: False, watched=starvation)
    until(None, lambda: not any(map(_runs, family.values())), watched=starvation)
    seconds = time.monotonic() - begun
    left = _unused(held)
    if left:  # a port has a number, which a program that begins on this machine may have taken meanwhile
        time.sleep(2 * _SETTLED)
        left &= _unused(held, _SETTLED)
    orphans = tuple(n for n, pid in family.items() if _runs(pid))
    status = runner.poll()
    said = runner.said() + ("" if status is not None else "it does not end")
    starved = starvation.seconds
    return Ended(99 if status is None else status, said, seconds, starved, lag, orphans, tuple(sorted(left)))


def _unused(held: list[Path], settled: float = 0.0) -> set[Path]:
    """Which of the files in shared memory no process uses."""
    return {one.path for one in leftovers(settled=settled)}.intersection(held) if held else set()


def too_late(who: str, seconds: float, starved: float, lag: float) -> list[str]:
    """Has it taken too long, more than a machine that was busy explains? In words; empty if not."""
    allowed = IN_TIME + starved + (REPAIRS if starved + lag > BUSY else 0.0)
    return [f"{who} after {seconds:.1f} s, {starved:.1f} s of it without a processor"] if seconds > allowed else []


def faults(case: Case, ended: Ended, bag: Path) -> list[str]:
    """What is not as it should be, in words; empty if all is."""
    found = [f"{node} outlived the run" for node in ended.orphans]
    if case.number == signal.SIGKILL and case.node != "runner" and case.moment != "start":
        found += [f"left {path}" for path in ended.left]
    if case.number != signal.SIGSTOP:
        found += too_late("ended", ended.seconds, ended.starved, ended.lag)
    if "Traceback" in ended.said:
        found.append("said a traceback")
    return found + _wrong_status(case, ended) + lost_steps(case, ended.said, bag, ended.lag)


def lost_steps(case: Case, said: str, bag: Path, lag: float) -> list[str]:
    """What is missing from the recording and should not be, by what the nodes said; empty if nothing is."""
    recorded, missing, wrong = _in_bag(bag, case.moment == "start")
    found = [wrong] if wrong else []
    reached = re.search(r"after step (\d+)", said)
    most = MOST_LOST[case.clock] + (lag / TS if case.clock == "realtime" else 0.0)
    if reached and recorded is not None and recorded < int(reached[1]) - most:
        found.append(f"left {recorded} of {reached[1]} steps in the bag")
    if case.clock == "lockstep" and case.number != signal.SIGKILL and missing:
        found.append(f"lost {missing}")
    return found


def _wrong_status(case: Case, ended: Ended) -> list[str]:
    """Is the exit status such as the signal asks for, and is the process named that it went to?"""
    is_complete = f"{STEPS[case.clock]} steps" in ended.said and "Error" not in ended.said
    if case.node == "runner" and case.number == signal.SIGKILL:
        return [] if ended.status == -signal.SIGKILL or is_complete else [f"exit status {ended.status}"]
    if ended.status == 0:
        return [] if is_complete else ["exit status 0 of a run that is not complete"]
    if case.number == signal.SIGSTOP:
        return [f"exit status {ended.status} after {HALT:g} s of halt"]
    return [] if case.node == "runner" or case.node in ended.said else [f"does not name the {case.node}"]


def _in_bag(bag: Path, start: bool) -> tuple[int | None, dict[str, int], str]:
    """Steps in a recording, messages that are missing from it, and what is wrong with it."""
    try:
        found = read_run(bag)
    except UserError as error:
        return None, {}, "" if start else f"left a bag that cannot be read: {error}"
    except Exception as error:
        return None, {}, f"reading the bag raises {type(error).__name__}: {error}"
    return int(found.k[-1]) + 1, dict(found.unexplained), ""


def until(
    process: Forked | None, condition: Callable[[], bool], seconds: float = PATIENCE, watched: Starvation | None = None
) -> None:
    """Wait for a condition, for so long at most, or until the process has ended."""
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline and (process is None or process.poll() is None):
        time.sleep(0.01)
        if watched is not None:
            watched.look()


def _children(pid: int) -> dict[str, int]:
    """Processes of a run by the name of their node, as Linux' /proc tells."""
    found: dict[str, int] = {}
    for begun in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            for child in begun.read_text().split():
                words = Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")
                module = next((word.decode() for word in words if word.endswith(b"_node")), "")
                if module:
                    found[module.rpartition(".")[2].removesuffix("_node")] = int(child)
    return found


def _runs(pid: int) -> bool:
    """Does a process still run? One that only waits to be collected does not."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def has_come(case: Case, bag: Path) -> bool:
    """Has the moment of a case come, by what has been recorded?"""
    return _recorded_bytes(bag) > _SHARE[case.moment] * STEPS[case.clock] * _BYTES_A_STEP[case.clock]


def _recorded_bytes(bag: Path) -> int:
    """Size of what has been recorded so far."""
    with contextlib.suppress(OSError):
        return sum(file.stat().st_size for file in bag.glob("*.mcap"))
    return 0
