"""Kill matrix, attacks on the wire, damaged bags: `python -m torture [--minutes M] [--seed S] [--json FILE]`."""

from __future__ import annotations

import contextlib
import itertools
import json
import multiprocessing
import os
import signal
import socket
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from fuzz.__main__ import add
from fuzz.campaign import Result
from fuzz.campaign import run as fuzz
from torture.by_hand import faults_by_hand, run_by_hand
from torture.forked import end_with_parent, import_all
from torture.kills import IN_TIME, Case, faults, in_fair_order, run
from torture.wire import Attacked, attack

PARAMS = str(Path(__file__).parents[1] / "config/outages.yaml")

_SHARES = {"kills": 0.95, "wire": 0.05}
"""Of the time; what the first leaves, the second may use. Bags are read all the time, by what the others leave idle."""

_LOOK = 0.5
"""How often [s] it is looked how many they have read."""

_IDLE = 19
"""Niceness of those who read bags."""

_ATTACKS, _ATTACKED_RUNS = 250, 4
"""Messages that attack a run, and the fewest runs: two in each clock."""

_BAGS, _BAGS_AT_A_TIME = 50_000, 100

_DOMAINS, _FIRST_PORT = range(101, 0, -1), 41000

T = TypeVar("T")
R = TypeVar("R")


@click.command()
@click.option("--minutes", type=click.FloatRange(min=0.1), default=20.0, show_default=True, help="How long, at most.")
@click.option("--seed", type=int, default=1, show_default=True, help="Of the order of the kills, and of the attacks.")
@click.option(
    "--jobs", type=click.IntRange(1, 8), default=min(8, 2 * len(os.sched_getaffinity(0))), show_default="two a core",
    help="Runs side by side, each in a DDS domain of its own.",
)  # fmt: skip
@click.option("--only", type=click.Choice([*_SHARES, "bags"]), help="One part alone.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write the figures to this file, too.")
def main(minutes: float, seed: int, jobs: int, only: str | None, json_file: Path | None) -> None:
    """Try to break runs and recordings; exit status 1 if anything did not hold."""
    import_all()
    found: dict[str, dict[str, Any]] = {}

    def keep(name: str, part: dict[str, Any]) -> None:
        found[name] = part
        if json_file is not None:
            json_file.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
        click.echo(_line(name, part))

    with tempfile.TemporaryDirectory(prefix="agv_ncs_torture_") as folder, _progress() as progress:
        begun = time.monotonic()
        beside = _Beside(_bags, seed, begun + 60.0 * minutes, Path(folder), jobs) if only in (None, "bags") else None
        bar_beside = None if beside is None else progress.add_task("bags", total=_BAGS)
        end = begun
        for name, part in (("kills", _kills), ("wire", _wire)):
            if only not in (None, name):
                continue
            end += 60.0 * minutes * (_SHARES[name] if only is None else 1.0)
            bar = progress.add_task(name, total=None)

            def advance(done: int, of: int, bar: TaskID = bar) -> None:
                progress.update(bar, completed=done, total=of, refresh=True)
                if beside is not None and bar_beside is not None:
                    progress.update(bar_beside, completed=beside.done)

            keep(name, _timed(part, seed, end, Path(folder), jobs, advance))
        if beside is not None and bar_beside is not None:
            while not beside.has_ended(_LOOK):
                progress.update(bar_beside, completed=beside.done, refresh=True)
            keep("bags", beside.result())
    raise SystemExit(any(part["bad"] for part in found.values()))


def _progress() -> Progress:
    """Without a thread that draws: workers are forked meanwhile."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    return Progress(*columns, console=Console(stderr=True), auto_refresh=False)


Advance = Callable[[int, int], None]
"""Receives how many cases are done, of how many."""

Part = Callable[[int, float, Path, int, Advance], dict[str, Any]]
"""Figures of a part by its seed, its end, a folder of its own and how many may run side by side."""


def _timed(part: Part, seed: int, end: float, folder: Path, jobs: int, advance: Advance) -> dict[str, Any]:
    begun = time.monotonic()
    return part(seed, end, folder, jobs, advance) | {"minutes": round((time.monotonic() - begun) / 60.0, 1)}


class _Beside:
    """A part in a process of its own, which takes what the other parts leave of the processors.

    It is begun before they are: a process that has threads could not be forked safely.
    """

    def __init__(self, part: Part, seed: int, end: float, folder: Path, jobs: int) -> None:
        context = multiprocessing.get_context("fork")
        self._done = context.Value("q", 0)
        self._figures, there = context.Pipe(duplex=False)
        arguments = part, seed, end, folder, jobs, there
        self._process = context.Process(target=self._run, args=arguments)
        self._process.start()
        there.close()  # so that the end of the process is the end of the pipe

    def _run(self, part: Part, seed: int, end: float, folder: Path, jobs: int, there: Connection) -> None:
        """Body of the process."""

        def advance(done: int, _: int) -> None:
            self._done.value = done

        end_with_parent()
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        os.nice(_IDLE)
        there.send(_timed(part, seed, end, folder, jobs, advance))

    @property
    def done(self) -> int:
        """How many of its cases are done."""
        return int(self._done.value)

    def has_ended(self, seconds: float) -> bool:
        """Are its figures there, or does it not run any more? It is waited for so long at most."""
        return self._figures.poll(seconds)

    def result(self) -> dict[str, Any]:
        """Its figures, once they are there."""
        try:
            found: dict[str, Any] = self._figures.recv()
        except EOFError:
            raise SystemExit("the process that read damaged bags has died") from None
        self._process.join()
        return found


def _line(name: str, part: dict[str, Any]) -> str:
    late = f", {part['late']} in more than {IN_TIME:g} s for want of a processor" if part.get("late") else ""
    return (
        f"{name}: {part['cases']} of {part['of']} cases in {part['minutes']} min, "
        f"{part['bad']} not as they should be{late}"
    )


# -- workers -----------------------------------------------------------------------------------------------------------


_claims: list[socket.socket] = []
"""In a worker bound to a port that stands for its DDS domain, as in the tests: two loops in one domain would be one."""


def _start_worker() -> None:
    """First thing in a worker: a DDS domain of its own; Ctrl-C is the first process' to handle."""
    end_with_parent()
    _claims.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    for domain in _DOMAINS:
        with contextlib.suppress(OSError):
            _claims[-1].bind(("127.0.0.1", _FIRST_PORT + domain))
            os.environ["ROS_DOMAIN_ID"] = str(domain)
            break
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _side_by_side(jobs: int, end: float, work: Callable[[T], R], tasks: Iterable[T]) -> Iterator[tuple[T, R]]:
    """Do tasks in worker processes, in order, beginning none after `end`; each result as soon as it is there."""
    context = multiprocessing.get_context("fork")  # what is imported here is imported there
    waiting = iter(tasks)
    running: dict[Future[R], T] = {}
    with ProcessPoolExecutor(jobs, context, _start_worker) as pool:
        while True:
            free = jobs - len(running) if time.monotonic() < end else 0
            for task in itertools.islice(waiting, free):
                running[pool.submit(work, task)] = task
            if not running:
                return
            done: set[Future[R]] = wait(running, return_when=FIRST_COMPLETED).done
            for future in done:
                yield running.pop(future), future.result()


# -- signals -----------------------------------------------------------------------------------------------------------


class _Seen(NamedTuple):
    """What came of a signal."""

    wrong: list[str]
    seconds: float
    starved: float
    said: str


def _kills(seed: int, end: float, folder: Path, jobs: int, advance: Advance) -> dict[str, Any]:
    order = in_fair_order(seed)
    bad: dict[str, list[str]] = {}
    late: dict[str, str] = {}
    longest, done = 0.0, 0
    for (case, _), seen in _side_by_side(jobs, end, _kill, [(case, folder) for case in order]):
        done += 1
        advance(done, len(order))
        if case.number != signal.SIGSTOP:
            longest = max(longest, seen.seconds - seen.starved)
            if seen.seconds > IN_TIME and not seen.wrong:
                late[str(case)] = f"{seen.seconds:.1f} s, {seen.starved:.1f} s of it without a processor"
        if seen.wrong:
            bad[str(case)] = [*seen.wrong, seen.said.strip().rpartition("\n")[2]]
            click.echo(f"{case}: {'; '.join(bad[str(case)])}")
    return {
        "cases": done, "of": len(order), "bad": len(bad), "late": len(late), "longest_s": round(longest, 2),
        "faults": bad, "late_cases": late,
    }  # fmt: skip


def _kill(task: tuple[Case, Path]) -> _Seen:
    case, folder = task
    with tempfile.TemporaryDirectory(dir=folder) as name:
        own = Path(name)
        if case.start == "hand":
            alone = run_by_hand(case, own, PARAMS)
            seconds = max(alone.victim_seconds, alone.seconds)
            return _Seen(faults_by_hand(case, alone, own / "bag"), seconds, alone.starved, alone.said["plant"])
        ended = run(case, own, PARAMS)
        return _Seen(faults(case, ended, own / "bag"), ended.seconds, ended.starved, ended.said)


# -- wild messages -----------------------------------------------------------------------------------------------------


def _wire(seed: int, end: float, folder: Path, jobs: int, advance: Advance) -> dict[str, Any]:
    bad: dict[str, list[str]] = {}
    kinds: Counter[str] = Counter()
    tasks = [(seed + number, ("realtime", "lockstep")[number % 2], folder) for number in range(_ATTACKED_RUNS)]
    for (number, clock, _), found in _side_by_side(min(jobs, 2), end, _attack, tasks):
        kinds.update(found.by_kind)
        advance(sum(kinds.values()), _ATTACKS * _ATTACKED_RUNS)
        if found.faults:
            bad[f"{clock}, seed {number}"] = [*found.faults, found.said.strip().rpartition("\n")[2]]
            click.echo(f"wire, {clock}, seed {number}: {'; '.join(found.faults)}")
    sent, of = sum(kinds.values()), _ATTACKS * _ATTACKED_RUNS
    return {"cases": sent, "of": of, "bad": len(bad), "kinds": dict(kinds), "faults": bad}


def _attack(task: tuple[int, str, Path]) -> Attacked:
    seed, clock, folder = task
    with tempfile.TemporaryDirectory(dir=folder) as own:
        return attack(seed, clock, _ATTACKS, Path(own), PARAMS)


# -- damaged bags ------------------------------------------------------------------------------------------------------


def _bags(seed: int, end: float, folder: Path, jobs: int, advance: Advance) -> dict[str, Any]:
    total = Result()
    cores = min(jobs, len(os.sched_getaffinity(0)))  # nothing is waited for here
    tasks = [(seed, first, folder) for first in range(0, _BAGS, _BAGS_AT_A_TIME)]
    for _, found in _side_by_side(cores, end, _read, tasks):
        add(total, found)
        advance(sum(total.cases.values()), _BAGS)
    done = total.to_json()
    return {"cases": done.pop("cases"), "of": _BAGS, "bad": sum(total.faults.values())} | done


def _read(task: tuple[int, int, Path]) -> Result:
    seed, first, folder = task
    with tempfile.TemporaryDirectory(dir=folder) as own:
        return fuzz(seed, range(first, first + _BAGS_AT_A_TIME), Path(own), None)


if __name__ == "__main__":
    main()
