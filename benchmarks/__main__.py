"""Measure and print: `python -m benchmarks [SUBJECT ...] [--json FILE] [--against FILE]`.

Each subject is a module with a function `measure() -> list[Comparison]`. An aim that is missed is shown, and does not
fail the command: how fast a machine is at a given moment is not a property of the code.
"""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

import benchmarks
from benchmarks.comparison import Comparison
from benchmarks.record import changes, read_record, write_record

NOT_SUBJECTS = ("__main__", "comparison", "echo", "growth", "record")
SUBJECTS = sorted(
    module.name for module in pkgutil.iter_modules(benchmarks.__path__) if module.name not in NOT_SUBJECTS
)

ROUNDS = 3
"""How often each subject is measured where its noise has to be known."""


@click.command()
@click.argument("subjects", nargs=-1, type=click.Choice(SUBJECTS))
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write the figures to this file, too.")
@click.option(
    "--against", type=click.Path(path_type=Path, exists=True, dir_okay=False), help="Compare with a file of --json."
)
@click.option(
    "--rounds", type=click.IntRange(1), help=f"Measure so often: {ROUNDS} for --json and --against, otherwise once."
)
def main(subjects: tuple[str, ...], json_file: Path | None, against: Path | None, rounds: int | None) -> None:
    """Measure the SUBJECTS, all of them by default, each against its peers."""
    console = Console(highlight=False)
    before = None if against is None else read_record(against)
    times = rounds or (ROUNDS if json_file or against else 1)
    found: dict[str, list[list[Comparison]]] = {}
    chosen = subjects or (SUBJECTS if before is None else [one for one in SUBJECTS if one in before["subjects"]])
    for subject in chosen:
        for number in range(times):
            with console.status(f"measuring {subject}, round {number + 1} of {times} ..."):
                rows = importlib.import_module(f"benchmarks.{subject}").measure()
            found.setdefault(subject, []).append(rows)
            console.print(_table(subject, rows))
    if json_file is not None:
        write_record(json_file, found)
    if before is not None:
        for line in changes(before, found):
            console.print(line, markup=False, soft_wrap=True)


def _table(subject: str, rows: list[Comparison]) -> Table:
    table = Table(title=subject, title_justify="left", box=None)
    for heading, justify in (("what", "left"), ("ours", "right"), ("peer", "right"), ("", "left"), ("against", "left")):
        table.add_column(heading, justify=justify)  # type: ignore[arg-type]
    table.add_column("ratio", justify="right")
    table.add_column("aim", justify="right")
    for row in rows:
        colour = {True: "green", False: "red", None: "default"}[row.met]
        aim = "" if row.aim is None else f"{row.aim:g}"
        table.add_row(
            row.what, f"{row.ours:,.4g}" if row.ours < 1000 else f"{row.ours:,.0f}",
            f"{row.peer:,.4g}" if row.peer < 1000 else f"{row.peer:,.0f}",
            row.unit, row.peer_name, f"[{colour}]{row.ratio:.2f}[/]", aim,
        )  # fmt: skip
    return table


if __name__ == "__main__":
    main()
