"""`agv-ncs replay`: a recording against the edge of today, and its outages for another run."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from agv_analysis.commands import OUTPUT, needs_ros, with_force, write_json
from agv_ros.counted import counted

if TYPE_CHECKING:
    from agv_analysis.run import Run
    from agv_analysis.runtime.edge_comparison import Comparison
    from agv_analysis.scenario import Scenario
    from agv_analysis.simulation.edge_answers import Difference


@click.command("replay", short_help="Play a recording to the edge again, or repeat its run.")
@click.argument("bag", type=click.Path(path_type=Path))
@click.option("--lockstep", is_flag=True, help="On DDS, each slot as soon as the one before is answered.")
@click.option("--rate", type=click.FloatRange(min=0.0, min_open=True), help="On DDS, R times as fast as recorded.")
@click.option("--edge", type=click.Choice(["own", "running"]), default="own", help="On DDS, which nodes answer.")
@click.option("--bag", "out", type=click.Path(path_type=Path), help="Record the replay to this directory.")
@click.option(
    "--compare", is_flag=True, help="Compare errors and commands with the recorded; exit status 1 if different."
)
@click.option("--again", is_flag=True, help="Repeat the run under the recorded outages; both runs in one table.")
@click.option("--ros", is_flag=True, help="With --again: on DDS instead of simulated.")
@click.option("--outages", type=OUTPUT, help="Write the outcomes of the slots to this CSV file.")
@click.option("--link", type=click.Choice(["uplink", "downlink"]), default="uplink", help="Whose outcomes.")
@click.option("--json", "json_file", type=OUTPUT, help="Write the result to this file, too.")
@click.option("--config", type=click.Path(path_type=Path), help="The params file to use instead of the bag's own.")
@click.option("--set", "settings", multiple=True, metavar="NODE.PARAMETER=VALUE", help="Change a parameter.")
@click.option("--namespace", help="Which loop, for a bag of several.")
@with_force
def command(
    bag: Path, lockstep: bool, rate: float | None, edge: str, out: Path | None, compare: bool, again: bool, ros: bool,
    outages: Path | None, link: str, json_file: Path | None, config: Path | None, settings: tuple[str, ...],
    namespace: str | None,
) -> None:  # fmt: skip
    """Play the recording BAG to the edge's nodes or functions again, or repeat the run under its outages.

    \b
    Examples:
      agv-ncs replay bags/first
      agv-ncs replay bags/first --lockstep --compare --bag bags/answers
      agv-ncs replay bags/first --compare --set controller.kx=5.0 --json changed.json
      agv-ncs replay bags/first --again --set controller.kx=5.0
      agv-ncs replay bags/first --outages outages.csv
    """
    from agv_analysis.recordings.recording import read_run
    from agv_analysis.runtime.edge_comparison import compare as compare_run
    from agv_analysis.runtime.edge_comparison import with_settings
    from agv_analysis.runtime.recorded_outages import write_outages
    from agv_cloud.parameters import PATH
    from agv_ros.errors import UserError

    on_dds = lockstep or rate is not None or edge == "running" or out is not None or not (compare or again or outages)
    _check(lockstep and rate is not None, "--lockstep and --rate exclude each other")
    _check(again and (on_dds or compare), "--again cannot go with --compare, --rate, --lockstep or --bag")
    _check(ros and not again, "--ros needs --again; --rate and --lockstep use DDS without it")
    _check(json_file is not None and not (compare or again), "--json belongs to --compare or --again")
    _check(bool(settings) and not (compare or again or on_dds), "--set belongs to a replay, --compare or --again")
    _check(bool(settings) and edge == "running", "--set cannot change nodes that run already: use `ros2 param set`")
    run = read_run(bag, config, namespace)
    for note in run.notes:
        click.echo(note, err=True)
    if outages is not None:
        lost = write_outages(outages, run, link == "downlink")
        click.echo(
            f"outages: {outages}: {lost} of {counted(len(run), 'slot')} lost, the first is step {run.k[0]} of the "
            "recording"
        )
    scenario = with_settings(run.scenario, settings)
    if scenario.error_detector.track == PATH and (again or (on_dds and edge == "own")):
        raise UserError(
            f"{bag}: its reference came as paths, which are not in it, so its edge and its run cannot be rerun; "
            "only --compare works, with the recorded reference"
        )
    if again:
        _drive_again(run, scenario, ros, json_file)
    elif on_dds:
        _play(run, scenario, namespace, lockstep, rate or 1.0, edge == "own", out, compare, json_file)
    elif compare:
        _say(compare_run(run, scenario), json_file)


def _check(is_wrong: bool, text: str) -> None:
    if is_wrong:
        raise click.UsageError(text)


def _runner() -> Any:
    with needs_ros("; --compare and --again alone need none"):
        from agv_analysis.runtime import runner
    return runner


def _play(
    run: Run, scenario: Scenario, namespace: str | None, lockstep: bool, rate: float, starts_edge: bool,
    out: Path | None, compare: bool, json_file: Path | None,
) -> None:  # fmt: skip
    runner = _runner()
    from agv_analysis.commands.progress import step_bar
    from agv_analysis.runtime.edge_comparison import compare_answers
    from agv_analysis.runtime.edge_inputs import aligned_answers, read_inputs
    from agv_analysis.runtime.replay_node import Pace

    inputs = read_inputs(Path(run.source), scenario.grid, namespace)
    with step_bar(len(inputs.slots), "playing") as progress:
        outcome, errors, commands = runner.replay_in_process(
            scenario, inputs, Pace(lockstep, rate), out, progress, starts_edge
        )
    click.echo(
        f"{counted(outcome.steps, 'slot')} played, {counted(len(errors), 'error')} and "
        f"{counted(len(commands), 'command')} came back"
    )
    if outcome.recording:
        click.echo(f"bag: {out}: {outcome.recording}")
    failures = [failure for failure in (outcome.failure, outcome.recording_failure) if failure]
    if failures:
        raise click.ClickException("; ".join(failures))
    if compare:
        _say(compare_answers(*aligned_answers(run, inputs, errors, commands)), json_file)


def _say(comparison: Comparison, json_file: Path | None) -> None:
    click.echo(f"errors:   {_words(comparison.error)}\ncommands: {_words(comparison.command)}")
    if json_file is not None:
        write_json(json_file, comparison.to_json())
    if comparison.differs:
        raise click.exceptions.Exit(1)


def _drive_again(run: Run, scenario: Scenario, ros: bool, json_file: Path | None) -> None:
    from agv_analysis.report.table import print_side_by_side
    from agv_analysis.runtime.recorded_outages import with_outages_of
    from agv_analysis.simulation.single import simulate
    from agv_analysis.stability.analysis import analyse

    with tempfile.TemporaryDirectory(prefix="agv_ncs_") as folder:
        scenario = with_outages_of(run, scenario, Path(folder))
        second = _on_dds(scenario, Path(folder) / "bag") if ros else simulate(scenario)
        analyses = {"recorded": analyse(run), "again": analyse(second)}
    print_side_by_side(analyses)
    if json_file is not None:
        write_json(json_file, {name: analysis.to_json() for name, analysis in analyses.items()})


def _on_dds(scenario: Scenario, bag: Path) -> Run:
    runner = _runner()
    from agv_analysis.commands.progress import step_bar
    from agv_analysis.recordings.recording import read_run

    with step_bar(scenario.plant.duration / scenario.plant.ts) as progress:
        outcome = runner.run_in_process(scenario, bag, progress)
    if outcome.recording_failure:
        raise click.ClickException(outcome.recording_failure)
    if outcome.failure:
        click.echo(outcome.failure, err=True)
    return read_run(bag)


def _words(difference: Difference) -> str:
    found = f"{counted(difference.compared, 'step')} compared, "
    if difference.first is None:
        return found + f"equal (largest difference {difference.largest:.1e})"
    return found + (
        f"step {difference.first} is the first to differ, by {difference.first_size:.3g}; "
        f"largest {difference.largest:.3g} at step {difference.largest_at}"
    )
