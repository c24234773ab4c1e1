"""How many AGVs the machine carries at 200 Hz in real time before they miss deadlines, on DDS.

A fleet is carried if less than two deadlines in a hundred are missed over two seconds, which begin a second after all
of its loops run. Its vehicles share one process or are divided among four, which have one core or two.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

from agv_analysis.runtime.fleet import vehicle_names, vehicle_scenarios
from agv_analysis.scenario import load_scenario
from benchmarks.comparison import Comparison

CONFIG = str(Path(__file__).parent.parent / "config" / "paper.yaml")
CORES = (1, 2)
BEFORE, WINDOW = 200, 400
"""Steps of each vehicle that pass before it is looked at, and in which it is."""
MISSED = 0.02
FIRST, MOST = 8, 64
"""Vehicles that are tried first, and at most."""
PROCESSES = 4
PATIENCE = 20.0
"""A fleet that has not started and been looked at after so long [s] is not carried."""
READY = "ready\n"


def measure() -> list[Comparison]:
    """The largest fleet that is carried in four processes against the largest in one, by cores."""
    available = os.sched_getaffinity(0)
    return [
        Comparison(
            f"AGVs at 200 Hz on {cores} core{'s' * (cores > 1)}, in four processes", _most(cores, PROCESSES),
            "in one", _most(cores, 1), "AGVs",
        )
        for cores in CORES
        if cores <= len(available)
    ]  # fmt: skip


def _most(cores: int, processes: int) -> int:
    """The largest fleet that is carried, to a quarter: doubled until one is not, then halved between."""
    most, least = 0, FIRST
    while least <= MOST and _is_carried(cores, processes, least):
        most, least = least, 2 * least
    while least - most > max(processes, most // 4):
        middle = (most + least) // 2
        most, least = (middle, least) if _is_carried(cores, processes, middle) else (most, middle)
    return most


def _is_carried(cores: int, processes: int, count: int) -> bool:
    """Run a fleet on a number of cores, divided among a number of processes."""
    per_process = count // processes
    allowed = sorted(os.sched_getaffinity(0))[:cores]
    parts: list[subprocess.Popen[str]] = []
    for first in range(0, count, per_process):
        command = [sys.executable, "-m", "benchmarks.fleet", *map(str, (count, first, per_process, *allowed))]
        parts.append(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
    too_late = threading.Timer(PATIENCE, _kill, (parts,))
    too_late.start()
    are_ready = [part.stdout is not None and part.stdout.readline() == READY for part in parts]
    for part in parts:
        if all(are_ready) and part.stdin is not None:
            part.stdin.write("go\n")
            part.stdin.flush()
    answers = [part.communicate()[0] for part in parts]
    too_late.cancel()
    return all(answers) and sum(map(int, answers)) < MISSED * WINDOW * count


def _kill(parts: list[subprocess.Popen[str]]) -> None:
    for part in parts:
        part.kill()


def run(count: int, first: int, number: int) -> int:
    """Run `number` vehicles of a fleet from `first` on in this process; deadlines missed in the window.

    Says when all of them run; the window begins with a line on standard input.
    """
    from agv_analysis.runtime.one_process import OneProcess
    from agv_analysis.runtime.runner import loop_of, run_loops
    from agv_ros.executor import EXECUTORS
    from agv_ros.stopping import stop_on_signals

    scenario = load_scenario(CONFIG, ["plant.clock=realtime", "plant.duration=1000.0"])
    fleet = dict(zip(vehicle_names(count), vehicle_scenarios(scenario, count, 20.0), strict=True))
    names = list(fleet)[first : first + number]
    may_measure = threading.Event()
    window: list[tuple[int, int]] = []
    with stop_on_signals() as stop, OneProcess() as process:
        loops = [loop_of(process, fleet[name], None, name) for name in names]
        plants = [loop.plant for loop in loops]

        def missed() -> int:
            return sum(plant.deadline_monitor.missed for plant in plants)

        def look(steps: int) -> None:
            if not listener.is_alive() and not may_measure.is_set() and all(plant.k for plant in plants):
                print(READY, end="", flush=True)
                listener.start()
            if may_measure.is_set() and len(window) < 2 and (not window or steps - window[0][0] >= BEFORE * number):
                window.append((steps, missed()))
            stop.requested = len(window) == 2 and steps - window[1][0] >= WINDOW * number

        def listen() -> None:
            sys.stdin.readline()
            may_measure.set()

        listener = threading.Thread(target=listen, daemon=True)
        run_loops(EXECUTORS["events"](context=process.context), loops, stop, look)
        return missed() - window[1][1]


if __name__ == "__main__":
    total, begin, mine, *allowed_cores = map(int, sys.argv[1:])
    os.sched_setaffinity(0, allowed_cores)
    print(run(total, begin, mine))
