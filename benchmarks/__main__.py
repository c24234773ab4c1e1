"""Measure and print: `python -m benchmarks [SUBJECT ...] [--json FILE]`.

Each subject is a module with a function `measure() -> list[Comparison]`. An aim that is missed is shown, and does not
fail the command: how fast a machine is at a given moment is no property of the code.
"""

from __future__ import annotations

import importlib
import json
import pkgutil
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

import benchmarks
from benchmarks.comparison import Comparison

NOT_SUBJECTS = ("__main__", "comparison", "echo")
SUBJECTS = sorted(
    module.name for module in pkgutil.iter_modules(benchmarks.__path__) if module.name not in NOT_SUBJECTS
)


@click.command()
@click.argument("subjects", nargs=-1, type=click.Choice(SUBJECTS))
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write the figures to this file, too.")
def main(subjects: tuple[str, ...], json_file: Path | None) -> None:
    """Measure the SUBJECTS, all of them by default, each against its peers."""
    console = Console(highlight=False)
    found: dict[str, list[Comparison]] = {}
    for subject in subjects or SUBJECTS:
        with console.status(f"measuring {subject} ..."):
            found[subject] = importlib.import_module(f"benchmarks.{subject}").measure()
        console.print(_table(subject, found[subject]))
    if json_file is not None:
        content = {subject: [{**row._asdict(), "ratio": row.ratio} for row in rows] for subject, rows in found.items()}
        json_file.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


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
