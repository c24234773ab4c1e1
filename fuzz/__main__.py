"""Run cases and write what came of them: `python -m fuzz --cases N [--seed S] [--json FILE] [--save DIR]`."""

from __future__ import annotations

import json
import os
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import click
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from fuzz.campaign import FAULTS, Result, run

_PART = 500
"""Cases that a process runs at a time."""


@click.command()
@click.option("--cases", type=click.IntRange(min=1), default=1_000_000, show_default=True, help="How many.")
@click.option("--seed", type=int, default=1, show_default=True, help="Of all cases.")
@click.option("--first", type=click.IntRange(min=0), default=0, show_default=True, help="Number of the first case.")
@click.option("--jobs", type=click.IntRange(min=1), default=os.cpu_count() or 1, show_default=True, help="Processes.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write the figures to this file, too.")
@click.option("--save", type=click.Path(path_type=Path), help="Keep the bags that show a fault in this directory.")
def main(cases: int, seed: int, first: int, jobs: int, json_file: Path | None, save: Path | None) -> None:
    """Read damaged bags and compare with independent readers; exit status 1 if there is any fault."""
    total = Result()
    parts = [range(begin, min(begin + _PART, first + cases)) for begin in range(first, first + cases, _PART)]
    with Progress(console=Console(stderr=True)) as progress, ProcessPoolExecutor(jobs) as pool:
        task = progress.add_task("reading", total=cases)
        for part, found in zip(parts, pool.map(_run, [(seed, part, save) for part in parts]), strict=True):
            add(total, found)
            progress.update(task, advance=len(part), description=f"{sum(total.faults.values())} faults")
    table = Table(box=None, show_header=False)
    for name, value in rows(total):
        table.add_row(name, value)
    Console(highlight=False).print(table)
    if json_file is not None:
        json_file.write_text(json.dumps({"seed": seed, **total.to_json()}, indent=2) + "\n", encoding="utf-8")
    raise SystemExit(1 if total.faults else 0)


def _run(work: tuple[int, range, Path | None]) -> Result:
    with tempfile.TemporaryDirectory(prefix="agv_ncs_fuzz_") as folder:
        return run(work[0], work[1], Path(folder), work[2])


def add(total: Result, part: Result) -> None:
    """Add what came of other cases."""
    total.cases += part.cases
    total.compared += part.compared
    total.refused += part.refused
    total.reported += part.reported
    total.faults += part.faults
    total.first = {**part.first, **total.first}
    total.longest_s = max(total.longest_s, part.longest_s)
    total.peak_bytes = max(total.peak_bytes, part.peak_bytes)
    total.seconds += part.seconds


def rows(total: Result) -> list[tuple[str, str]]:
    """Figures as text."""
    cases = sum(total.cases.values())
    return [
        ("Cases", str(cases)),
        ("Refused", str(total.refused)),
        ("Read, with something reported", str(total.reported)),
        ("Compared with another reader", str(sum(total.compared.values()))),
        *((kind.capitalize(), f"{total.faults[kind]}  {total.first.get(kind, '')}".strip()) for kind in FAULTS),
        ("Longest case", f"{total.longest_s:.2f} s"),
        ("Time of all processes", f"{total.seconds:.0f} s, {1e3 * total.seconds / cases:.1f} ms a case"),
        ("Peak memory of a process", f"{total.peak_bytes / 2**20:.0f} MiB"),
    ]


if __name__ == "__main__":
    main()
