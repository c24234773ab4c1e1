"""`agv-ncs run`: the loop on DDS."""

from __future__ import annotations

from pathlib import Path

import click

from agv_analysis.commands import needs_ros, with_settings


@click.command("run")
@with_settings
@click.option("--bag", type=click.Path(path_type=Path), help="Record to this directory, which must not exist.")
@click.option("--clock", type=click.Choice(["lockstep", "realtime"]), help="As --set plant.clock=...")
@click.option("--processes", is_flag=True, help="One process for each node instead of one for all.")
@click.option("--duration", type=float, help="As --set plant.duration=... [s]; cuts the run short.")
@click.option("--seed", type=int, help="As --set relay.seed=... --set plant.seed=...")
def command(
    params: str,
    settings: tuple[str, ...],
    bag: Path | None,
    clock: str | None,
    processes: bool,
    duration: float | None,
    seed: int | None,
) -> None:
    """Run the loop of the params file PARAMS on DDS.

    \b
    Examples:
      agv-ncs run config/paper.yaml
      agv-ncs run config/outages.yaml --bag bags/first --seed 7
      agv-ncs run config/paper.yaml --clock realtime --processes --duration 10
    """
    from agv_analysis.scenario import load_scenario

    shorthands = {"plant.clock": clock, "plant.duration": duration, "relay.seed": seed, "plant.seed": seed}
    given = [f"{name}={value}" for name, value in shorthands.items() if value is not None]
    scenario = load_scenario(params, (*settings, *given))
    with needs_ros():
        from agv_analysis import runner
    from agv_analysis.progress import step_bar

    with step_bar(scenario.plant.duration / scenario.plant.ts) as progress:
        if processes:
            outcome = runner.run_in_processes(scenario, bag, progress)
        else:
            outcome = runner.run_in_process(scenario, bag, progress)
    click.echo(f"{outcome.steps} steps" + (f", {outcome.rate:.0f} steps/s" if outcome.rate else ""))
    if outcome.recording:
        click.echo(f"bag: {bag}: {outcome.recording}")
    failures = [failure for failure in (outcome.failure, outcome.recording_failure) if failure]
    if failures:
        raise click.ClickException("; ".join(failures))
