"""`agv-ncs replay`: a recording against the edge of today, and its outages for another run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from agv_analysis.commands import write_json

if TYPE_CHECKING:
    from agv_analysis.replay import Difference


@click.command("replay")
@click.argument("bag", type=click.Path(path_type=Path))
@click.option("--compare", is_flag=True, help="Derive errors and commands anew; exit status 1 if they differ.")
@click.option("--outages", type=click.Path(path_type=Path), help="Write the verdicts to this CSV file.")
@click.option("--link", type=click.Choice(["uplink", "downlink"]), default="uplink", help="Whose verdicts.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write the comparison to this file, too.")
@click.option("--config", type=click.Path(path_type=Path), help="The params file to use instead of the bag's own.")
@click.option(
    "--set", "settings", multiple=True, metavar="NODE.PARAMETER=VALUE", help="Change a parameter for --compare."
)
@click.option("--namespace", help="Which loop, for a bag of several.")
def command(
    bag: Path, compare: bool, outages: Path | None, link: str, json_file: Path | None, config: Path | None,
    settings: tuple[str, ...], namespace: str | None,
) -> None:  # fmt: skip
    """Play the recording BAG to the edge's functions again, or take its outages into another run.

    \b
    Examples:
      agv-ncs replay bags/first --compare
      agv-ncs replay bags/first --compare --set controller.kx=5.0 --json changed.json
      agv-ncs replay bags/first --outages outages.csv
      agv-ncs run config/paper.yaml --set relay.uplink.model=trace --set relay.uplink.trace_file=outages.csv --bag again
    """
    from agv_analysis.recording import read_run
    from agv_analysis.replay import compare as compare_run
    from agv_analysis.replay import with_settings, write_outages

    if not compare and outages is None:
        raise click.UsageError("nothing to do: ask for --compare or --outages FILE")
    if not compare and (json_file is not None or settings):
        raise click.UsageError("--json and --set belong to --compare")
    run = read_run(bag, config, namespace)
    for note in run.notes:
        click.echo(note, err=True)
    if outages is not None:
        lost = write_outages(outages, run, link == "downlink")
        click.echo(
            f"outages: {outages}: {lost} of {len(run)} slots lost, the first is step {run.k[0]} of the recording"
        )
    if not compare:
        return
    comparison = compare_run(run, with_settings(run.scenario, settings))
    click.echo(f"errors:   {_words(comparison.error)}\ncommands: {_words(comparison.command)}")
    if json_file is not None:
        write_json(json_file, comparison.to_json())
    if comparison.differs:
        raise click.exceptions.Exit(1)


def _words(difference: Difference) -> str:
    found = f"{difference.compared} steps compared, "
    if difference.first is None:
        return found + f"equal (largest difference {difference.largest:.1e})"
    return found + (
        f"step {difference.first} is the first to differ, by {difference.first_size:.3g}; "
        f"largest {difference.largest:.3g} at step {difference.largest_at}"
    )
