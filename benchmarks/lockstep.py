"""Steps per second of the loop in lockstep, against bare echoes around the same hops in the same run.

The tries of ours and of the peers take turns, and the median of each counts: what else the machine does then hits all
of them alike.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from agv_analysis.scenario import load_scenario
from benchmarks.comparison import Comparison
from benchmarks.echo import ROLES, echo

CONFIG = str(Path(__file__).parent.parent / "config" / "paper.yaml")
TRIES = 3
STEPS = 10_000
STEPS_IN_PROCESSES = 3_000


def measure() -> list[Comparison]:
    """The loop with and without a recording, in one process and in four, with either executor."""
    one = _medians(
        ours=lambda: _loop(STEPS, recorded=False),
        recorded=lambda: _loop(STEPS, recorded=True),
        loop=lambda: echo("loop", STEPS, "events", ROLES),
        raw=lambda: echo("raw", STEPS, "events", ROLES),
        four_hop=lambda: echo("four_hop", STEPS, "events", ROLES),
        single=lambda: _loop(STEPS_IN_PROCESSES, recorded=False, executor="single"),
        single_loop=lambda: echo("loop", STEPS_IN_PROCESSES, "single", ROLES),
    )
    four = _medians(
        ours=lambda: _loop(STEPS_IN_PROCESSES, recorded=False, processes=True),
        recorded=lambda: _loop(STEPS_IN_PROCESSES, recorded=True, processes=True),
        loop=lambda: _echo_in_processes("loop"),
        raw=lambda: _echo_in_processes("raw"),
        four_hop=lambda: _echo_in_processes("four_hop"),
    )
    return [
        *_against_echoes("one process", one, recorder_shares_it=True),
        Comparison(
            "one process, single-threaded executor", one["single"], "the same messages", one["single_loop"],
            "steps/s", 0.75,
        ),
        *_against_echoes("four processes", four, recorder_shares_it=False),
    ]  # fmt: skip


def _medians(**works: Callable[[], float]) -> dict[str, float]:
    rates: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(TRIES):
        for name, work in works.items():
            rates[name].append(work())
    return {name: statistics.median(found) for name, found in rates.items()}


def _against_echoes(where: str, rates: dict[str, float], recorder_shares_it: bool) -> list[Comparison]:
    ours, recorded, unit = rates["ours"], rates["recorded"], "steps/s"
    what = f"{where}, recorded" + ("" if recorder_shares_it else " by a fifth")
    return [
        Comparison(where, ours, "the same messages", rates["loop"], unit, 0.75),
        Comparison(where, ours, "the same as raw bytes", rates["raw"], unit),
        Comparison(where, ours, "four hops of a pose", rates["four_hop"], unit),
        Comparison(what, recorded, "the same messages", rates["loop"], unit, 0.5),
    ]


def _loop(steps: int, recorded: bool, processes: bool = False, executor: str = "events") -> float:
    """Steps per second of our loop."""
    from agv_analysis.runtime.processes import run_in_processes
    from agv_analysis.runtime.runner import run_in_process

    scenario = load_scenario(CONFIG, [f"plant.duration={steps * 0.005}"])
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag" if recorded else None
        if processes:
            outcome = run_in_processes(scenario, bag, lambda _: None)
        else:
            outcome = run_in_process(scenario, bag, lambda _: None, executor)
    if outcome.failure or outcome.recording_failure:
        raise RuntimeError(outcome.failure or outcome.recording_failure)
    return outcome.rate


def _echo_in_processes(shape: str) -> float:
    """Rounds per second of an echo whose roles are four processes."""
    command = [sys.executable, "-m", "benchmarks.echo", shape, str(STEPS_IN_PROCESSES), "events"]
    others = [subprocess.Popen([*command, role], stdout=subprocess.DEVNULL) for role in ROLES[1:]]
    try:
        done = subprocess.run([*command, ROLES[0]], stdout=subprocess.PIPE, text=True, check=True)
        return float(done.stdout)
    finally:
        for other in others:
            other.terminate()
        for other in others:
            other.wait()
