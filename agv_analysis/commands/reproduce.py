"""`agv-ncs reproduce`: the paper in one command."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from agv_analysis.commands import needs_ros, with_force

if TYPE_CHECKING:
    from agv_analysis.reproduce.runs import Runs


@click.command("reproduce", short_help="Reproduce the paper's figures and claims.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("paper"), show_default=True,
    help="Directory for figures, their data and the tables.",
)  # fmt: skip
@click.option("--ros", is_flag=True, help="Measure on recorded runs of the nodes instead of simulated ones.")
@with_force
def command(out: Path, ros: bool) -> None:
    """Reproduce the paper: its figures, every claim of its text with what was measured, and its future work.

    \b
    Examples:
      agv-ncs reproduce
      agv-ncs reproduce --out paper_on_dds --ros
    """
    from rich.console import Console

    from agv_analysis.output_file import is_forced, is_ours
    from agv_analysis.reproduce import claims_page, dot_plot, report
    from agv_analysis.reproduce.citation import CITATION
    from agv_analysis.reproduce.claim import check
    from agv_analysis.reproduce.claims import CLAIMS
    from agv_analysis.reproduce.figures import figures, write
    from agv_analysis.reproduce.future import tables
    from agv_ros.errors import UserError

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{out}: cannot be made: {error.strerror}") from None
    if any(out.iterdir()) and not is_forced() and not is_ours(out / report.CLAIMS_FILE):
        raise UserError(f"{out}: is not empty and contains no earlier result: name another directory, or give --force")
    runs = _runs(out, ros)
    click.echo(CITATION)
    with Console(stderr=True).status("driving the paper's runs ..."):
        drawn = list(figures(runs))
        for figure in drawn:
            write(figure, out)
        findings = [check(claim, runs) for claim in CLAIMS]
    report.print_claims(findings)
    with Console(stderr=True).status("simulating its future work ..."):
        found = list(tables())
        for table in found:
            dot_plot.write(table, out)
    for table in found:
        report.print_table(table)
    report.write(findings, found, "recorded runs" if ros else "simulation", out)
    claims_page.write(findings, drawn, found, out)
    for figure in drawn:
        click.echo(f"{out / figure.file_name}.svg: {figure.where}")
    click.echo(f"figures and tables: {out}")
    click.echo(f"page: {out / claims_page.PAGE}")


def _runs(out: Path, ros: bool) -> Runs:
    from agv_analysis.reproduce.runs import recorded, simulated

    if not ros:
        return simulated()
    with needs_ros():
        return recorded(out / "bags")
