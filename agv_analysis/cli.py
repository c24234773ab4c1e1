"""The command line `agv-ncs`.

Only click is imported at start; each command imports what it needs, so that `--help` and errors come at once and
analysis works where there is no ROS.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

F = TypeVar("F", bound=Callable[..., Any])


class _Group(click.Group):
    """Prints what is wrong with a request in one line, without a traceback, and exits with status 1."""

    def invoke(self, ctx: click.Context) -> Any:
        from agv_ros.errors import UserError

        try:
            return super().invoke(ctx)
        except UserError as error:
            raise click.ClickException(str(error)) from None


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120})
@click.version_option(package_name="agv_ncs")
def main() -> None:
    r"""Close an AGV's control loop over a lossy radio link, record it, and learn whether it is stable.

    \b
    Examples:
      agv-ncs run config/outages.yaml --bag bags/first
      agv-ncs run config/paper.yaml --set controller.kx=250.0 --set controller.v_max=6.0 --bag bags/fast
      agv-ncs analyse bags/first --json first.json
    """


def with_settings(command: F) -> F:
    """The argument PARAMS and the option --set of commands that take a scenario."""
    command = click.option(
        "--set", "settings", multiple=True, metavar="NODE.PARAMETER=VALUE",
        help="Change a parameter of the file, as in --set relay.uplink.p=0.05. May be repeated.",
    )(command)  # fmt: skip
    return click.argument("params", type=click.Path())(command)


@main.command()
@with_settings
@click.option("--bag", type=click.Path(path_type=Path), help="Record to this directory, which must not exist.")
@click.option("--clock", type=click.Choice(["lockstep", "realtime"]), help="As --set plant.clock=...")
@click.option("--processes", is_flag=True, help="One process for each node instead of one for all.")
@click.option("--duration", type=float, help="As --set plant.duration=... [s]; cuts the run short.")
@click.option("--seed", type=int, help="As --set relay.seed=...")
def run(
    params: str,
    settings: tuple[str, ...],
    bag: Path | None,
    clock: str | None,
    processes: bool,
    duration: float | None,
    seed: int | None,
) -> None:
    r"""Run the loop of the params file PARAMS on DDS.

    \b
    Examples:
      agv-ncs run config/paper.yaml
      agv-ncs run config/outages.yaml --bag bags/first --seed 7
      agv-ncs run config/paper.yaml --clock realtime --processes --duration 10
    """
    from agv_analysis.scenario import load_scenario

    shorthands = {"plant.clock": clock, "plant.duration": duration, "relay.seed": seed}
    given = [f"{name}={value}" for name, value in shorthands.items() if value is not None]
    scenario = load_scenario(params, (*settings, *given))
    try:
        from agv_analysis import runner
    except ImportError as error:
        raise click.ClickException(
            f"the loop runs on ROS 2, which is not to be found here ({error}): source your ROS 2 installation, "
            "or `pip install 'agv_ncs[ros]'`"
        ) from None
    from agv_analysis.progress import step_bar

    with step_bar(scenario.plant.duration / scenario.plant.ts) as progress:
        if processes:
            outcome = runner.run_in_processes(scenario, bag, progress)
        else:
            outcome = runner.run_in_process(scenario, bag, progress)
    rate = f", {outcome.steps / outcome.seconds:.0f} steps/s" if outcome.seconds else ""
    click.echo(f"{outcome.steps} steps in {outcome.seconds:.1f} s{rate}")
    if bag is not None:
        click.echo(f"bag: {bag}: {outcome.recording}")
    if outcome.failure:
        raise click.ClickException(outcome.failure)
    if not outcome.complete:
        raise click.ClickException("the recording is not complete")


@main.command()
@click.argument("bag", type=click.Path(path_type=Path))
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write what is printed to this file, too.")
@click.option(
    "--config", type=click.Path(path_type=Path), help="The run's params file, for a bag that does not carry it."
)
@click.option("--picture", type=click.Path(path_type=Path), help="Where to draw; beside the recording by default.")
def analyse(bag: Path, json_file: Path | None, config: Path | None, picture: Path | None) -> None:
    r"""Say from the recording BAG whether the loop is stable, and why.

    \b
    Examples:
      agv-ncs analyse bags/first
      agv-ncs analyse bags/first --json first.json --picture first.png
      agv-ncs analyse from_ros2_bag_record --config config/paper.yaml
    """
    from agv_analysis.analysis import analyse as analyse_run
    from agv_analysis.picture import draw
    from agv_analysis.recording import read_run
    from agv_analysis.table import print_table

    run_ = read_run(bag, config)
    analysis = analyse_run(run_)
    where = picture or (bag / "overview.png" if bag.is_dir() else bag.with_suffix(".png"))
    draw(run_, where)
    print_table(analysis)
    click.echo(f"bag:     {bag}\npicture: {where}")
    if json_file is not None:
        write_json(json_file, analysis.to_json())


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file; a path that cannot be written is the user's error."""
    try:
        path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise click.ClickException(f"{path}: cannot be written: {error.strerror}") from None


if __name__ == "__main__":
    main()
