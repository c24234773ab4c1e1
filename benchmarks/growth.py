"""How cost grows: `python -m benchmarks.growth [SUBJECT ...]` prints the table of docs/performance.md.

Each size is measured in a process of its own: the processor time of the work alone on one core, without start-up,
without compilation and without making what is worked on, and the memory that the work took beside. Processor time, not
the wall's: what else runs on the machine adds less to it. The exponent is the slope of the logarithms by least squares.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np

from agv_analysis.scenario import Scenario, load_scenario

CONFIG = Path(__file__).parents[1] / "config"

TIMES = 3
"""The least of so many tries counts: another process can only add."""

Work = Callable[[], object]


class Subject(NamedTuple):
    """Something whose cost is measured at several sizes."""

    what: str
    sizes: tuple[int, ...]
    prepare: Callable[[int, Path], Work]
    """The work of a size, made ready; a folder is there for files."""


class Cost(NamedTuple):
    """What the work of a size takes: processor time [s] and memory [B]."""

    seconds: float
    memory: int


def _loop(steps: int, *settings: str) -> Scenario:
    return load_scenario(str(CONFIG / "outages.yaml"), [f"plant.duration={steps * 0.005}", *settings])


def _steps(steps: int, _: Path) -> Work:
    from agv_analysis.simulation.single import simulate

    scenario = _loop(steps)
    return lambda: simulate(scenario)


def _seeds(seeds: int, _: Path) -> Work:
    from agv_analysis.simulation import simulate_batch

    scenario = _loop(2000)
    return lambda: simulate_batch([scenario], range(seeds), workers=1)


def _vehicles(vehicles: int, _: Path) -> Work:
    from agv_analysis.simulation.single import simulate

    scenario = _loop(20_000, "relay.uplink.model=shared", f"relay.uplink.vehicles={vehicles}")
    return lambda: simulate(scenario)


def _states(states: int, _: Path) -> Work:
    """Mean-square test of a loop in which a state is held while outcomes are lost; states grow as its delay does."""
    from agv_analysis.link.markov_channel import gilbert_elliott
    from agv_analysis.stability.mean_square import spectral_radius

    generator = np.random.default_rng(1)
    received, missed = (generator.normal(size=(states, states)) / math.sqrt(2.0 * states) for _ in range(2))
    return lambda: spectral_radius(received, missed, gilbert_elliott(0.02, 0.2))


def _messages(messages: int, folder: Path) -> Work:
    from agv_analysis.bags import read_bag
    from benchmarks.bags import LOOP, make_bag

    make_bag(folder / "bag.mcap", messages)
    return lambda: read_bag(folder / "bag.mcap", LOOP)


SUBJECTS = {
    "steps": Subject("one simulated run, by its steps", (10**3, 10**4, 10**5, 10**6), _steps),
    "seeds": Subject("a sweep of runs of 2000 steps, by its seeds", (10, 100, 1000, 10_000), _seeds),
    "vehicles": Subject("20 000 steps of a loop on a shared uplink, by its vehicles", (1, 10, 100, 1000), _vehicles),
    "states": Subject("mean-square test under losses in bursts, by the loop's states", (2, 4, 8, 16), _states),
    "messages": Subject("reading a bag of the loop, by its messages", (10**4, 10**5, 10**6, 10**7), _messages),
}


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Slope of log cost over log size, by least squares."""
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def measure(subject: Subject, size: int) -> Cost:
    """Cost of one size, in this process."""
    with tempfile.TemporaryDirectory(prefix="agv_ncs_growth_") as folder:
        subject.prepare(subject.sizes[0], Path(folder))()  # compiles
    with tempfile.TemporaryDirectory(prefix="agv_ncs_growth_") as folder:
        work, seconds, before = subject.prepare(size, Path(folder)), math.inf, _memory("VmRSS")
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the peak begins anew
        for _ in range(TIMES):
            begun = time.process_time()
            work()
            seconds = min(seconds, time.process_time() - begun)
    return Cost(seconds, max(0, _memory("VmHWM") - before))


def _memory(name: str) -> int:
    """A figure of this process' memory [B]: VmRSS what it has, VmHWM the most that it had."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith(name))) * 1024


def row(name: str) -> str:
    """A line of the table, in Markdown: cost of each size, exponents, memory."""
    subject, costs = SUBJECTS[name], []
    for size in subject.sizes:
        command = [sys.executable, "-m", "benchmarks.growth", "--one", name, str(size)]
        environment = {**os.environ, "NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        said = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout
        costs.append(Cost(*json.loads(said)))
    pairs = zip(subject.sizes, costs, strict=True)
    cells = [f"{size:,}: {_time(cost.seconds)}, {cost.memory / 1e6:.3g} MB" for size, cost in pairs]
    whole = exponent(subject.sizes, [cost.seconds for cost in costs])
    last = exponent(subject.sizes[-2:], [cost.seconds for cost in costs[-2:]])
    return f"| {subject.what} | {' | '.join(cells)} | {whole:.2f} | {last:.2f} |"


def _time(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds >= 1.0 else f"{seconds * 1e3:.3g} ms"


@click.command()
@click.argument("subjects", nargs=-1, type=click.Choice(list(SUBJECTS)))
@click.option("--one", type=(click.Choice(list(SUBJECTS)), int), hidden=True)
def main(subjects: tuple[str, ...], one: tuple[str, int] | None) -> None:
    """Measure how the cost of the SUBJECTS grows with their size, all of them by default."""
    if one is not None:
        click.echo(json.dumps(measure(SUBJECTS[one[0]], one[1])))
        return
    click.echo("| what | cost and memory of each size | | | | exponent | between the last two sizes |")
    click.echo("|---|---|---|---|---|---|---|")
    for name in subjects or SUBJECTS:
        click.echo(row(name))


if __name__ == "__main__":
    main()
