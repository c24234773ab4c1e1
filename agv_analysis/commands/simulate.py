"""`agv-ncs simulate`: the loop without ROS."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from agv_analysis.commands import (
    OUTPUT,
    corridor_json,
    corridor_settings,
    print_corridor,
    report_on,
    with_corridor,
    with_force,
    with_report,
    with_settings,
    write_json,
)
from agv_analysis.output_file import output_file

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from agv_analysis.run import Run


@click.command("simulate", short_help="Simulate the loop without ROS.")
@with_settings
@with_corridor
@click.option("--csv", "csv_file", type=OUTPUT, help="Write the run to this file, a row a step.")
@click.option("--json", "json_file", type=OUTPUT, help="Write what is printed to this file, too.")
@with_report
@with_force
def command(
    params: str,
    settings: tuple[str, ...],
    corridor_width: float | None,
    corridor_along: float | None,
    laps: int | None,
    csv_file: Path | None,
    json_file: Path | None,
    report: Path | None,
    figures: Path | None,
) -> None:
    """Simulate the loop of the params file PARAMS without ROS and say whether it is stable, and why.

    \b
    Examples:
      agv-ncs simulate config/paper.yaml
      agv-ncs simulate config/outages.yaml --set controller.kx=250.0 --set relay.seed=7 --json fast.json
      agv-ncs simulate config/outages.yaml --corridor 0.5
      agv-ncs simulate config/paper.yaml --set error_detector.track=eight --csv eight.csv
    """
    from agv_analysis.report.table import print_table
    from agv_analysis.scenario import load_scenario
    from agv_analysis.simulation.single import simulate
    from agv_analysis.stability.analysis import analyse

    scenario = load_scenario(params, (*settings, *corridor_settings(corridor_width, corridor_along)))
    run = simulate(scenario)
    analysis = analyse(run)
    print_table(analysis)
    within = print_corridor(analysis, scenario, True, laps)
    if csv_file is not None:
        write_csv(csv_file, run)
        click.echo(f"csv:     {csv_file}")
    report_on(analysis, report, figures, within)
    if json_file is not None:
        write_json(json_file, {**analysis.to_json(), **corridor_json(within)})


COLUMNS = (
    "k", "t", "x_c", "y_c", "theta_c", "x_r", "y_r", "theta_r", "v_r", "w_r", "x_e", "y_e", "theta_e", "v", "w", "n_ul",
    "lost", "downlink_lost", "n_dl", "cause", "gain", "downlink_cause", "downlink_gain",
)  # fmt: skip
"""Columns of the CSV file: [s], [m], [rad], [m/s], [rad/s]; x_e .. theta_e as the edge computed them; outcomes 0, 1.

Causes are those of losses, gains those of the channel [dB], nan where it has none.
"""


def _reasons(run: Run) -> Iterator[NDArray[Any]]:
    """The columns of a run's links."""
    assert run.n_dl is not None
    yield run.n_dl
    for link in (run.uplink, run.downlink):
        assert link is not None
        yield from (link.cause, link.gain)


def write_csv(path: Path, run: Run) -> None:
    """Write a run to a CSV file, a row a step, numbers in full precision; a path that cannot be written is an error."""
    flags = (run.lost.astype(int), run.downlink_lost.astype(int))
    arrays = (
        run.k,
        run.time,
        *run.pose.T,
        *run.reference.T,
        *run.error.T,
        *run.command.T,
        run.n_ul,
        *flags,
        *_reasons(run),
    )
    try:
        with open(output_file(path), "w", encoding="utf-8", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(COLUMNS)
            rows.writerows(zip(*(array.tolist() for array in arrays), strict=True))
    except OSError as error:
        raise click.ClickException(f"{path}: cannot be written: {error.strerror}") from None
