"""`agv-ncs run`: the loop on DDS."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import click

from agv_analysis.commands import corridor_settings, needs_ros, with_settings, write_json
from agv_ros.counted import counted

if TYPE_CHECKING:
    from agv_analysis.runtime.fleet import Vehicle
    from agv_analysis.runtime.outcome import Outcome
    from agv_analysis.scenario import Scenario

PITCH = 20.0
"""Distance [m] of the tracks of two neighbours in a fleet: the paper's track is 18.07 m wide."""


@click.command("run", short_help="Run the loop, or a fleet of loops, on DDS.")
@with_settings
@click.option("--bag", type=click.Path(path_type=Path), help="Record to this directory, which must not exist.")
@click.option("--fsync", is_flag=True, help="Have the disk write each chunk of the bag: for a loss of power.")
@click.option(
    "--if-unwritable",
    type=click.Choice(["end", "continue"]),
    default="end",
    show_default=True,
    help="When the bag cannot be written any more, as on a full disk.",
)
@click.option("--clock", type=click.Choice(["lockstep", "realtime"]), help="As --set plant.clock=...")
@click.option("--processes", is_flag=True, help="One process for each node, of a fleet for each vehicle.")
@click.option("--duration", type=float, help="As --set plant.duration=... [s]; cuts the run short.")
@click.option("--seed", type=int, help="As --set relay.seed=... --set plant.seed=...")
@click.option(
    "--fleet",
    type=click.IntRange(1, 1000),
    metavar="N",
    help="N loops, in the namespaces agv_01, agv_02, ..., that share one uplink; each records to BAG/agv_01, ...",
)
@click.option(
    "--corridor", type=click.FloatRange(min=0.0, min_open=True), metavar="D",
    help="The AGV should stay within D [m] of its reference: recorded for `analyse`, and how much of it a fleet uses.",
)  # fmt: skip
@click.option("--live", is_flag=True, help="Serve a page in the browser that shows the run while it goes on.")
@click.option("--host", default="127.0.0.1", show_default=True, help="--live: address to serve the page on.")
@click.option("--port", type=click.IntRange(0, 65535), default=8051, show_default=True, help="--live: 0: any free one.")
@click.option("--pitch", type=float, default=PITCH, show_default=True, help="Fleet: distance between tracks [m].")
def command(
    params: str,
    settings: tuple[str, ...],
    bag: Path | None,
    fsync: bool,
    if_unwritable: str,
    clock: str | None,
    processes: bool,
    duration: float | None,
    seed: int | None,
    fleet: int | None,
    corridor: float | None,
    pitch: float,
    live: bool,
    host: str,
    port: int,
) -> None:
    """Run the loop of the params file PARAMS on DDS, or a fleet of such loops.

    The uplink of a fleet is relay.uplink.model=shared with as many vehicles, and with blocks, scheduler and p of the
    file; perfect becomes shared with p=0, bernoulli shared with its p, and other models are refused.

    \b
    Examples:
      agv-ncs run config/paper.yaml
      agv-ncs run config/outages.yaml --bag bags/first --seed 7
      agv-ncs run config/paper.yaml --clock realtime --processes --duration 10
      agv-ncs run config/outages.yaml --clock realtime --live
      agv-ncs run config/paper.yaml --set relay.uplink.blocks=2 --fleet 8 --bag bags/fleet
    """
    from agv_analysis.scenario import load_scenario

    shorthands = {"plant.clock": clock, "plant.duration": duration, "relay.seed": seed, "plant.seed": seed}
    given = [f"{name}={value}" for name, value in shorthands.items() if value is not None]
    scenario = load_scenario(params, (*settings, *given, *corridor_settings(corridor, None)))
    if fleet is not None:
        if live:
            raise click.UsageError("--live shows one loop: watch one of a fleet with agv-ncs watch --namespace agv_01")
        _run_fleet(scenario, fleet, pitch, bag, processes, (fsync, if_unwritable))
        return
    with needs_ros():
        from agv_analysis.runtime.run_setup import OnDisk

        if processes:
            from agv_analysis.runtime.processes import run_in_processes
        else:  # the nodes, and rclpy, are imported here only if they run here
            from agv_analysis.runtime.runner import run_in_process
    from agv_analysis.commands.progress import step_bar
    from agv_ros.discovery import discovery_note

    click.echo(discovery_note(), err=True)
    with (
        _watched(scenario, host, port) if live else nullcontext(),
        step_bar(scenario.plant.duration / scenario.plant.ts) as progress,
    ):
        disk = OnDisk(fsync, if_unwritable)
        if processes:
            outcome = run_in_processes(scenario, bag, progress, on_disk=disk)
        else:
            outcome = run_in_process(scenario, bag, progress, on_disk=disk, is_watched=live)
    click.echo(counted(outcome.steps, "step") + (f", {outcome.rate:.0f} steps/s" if outcome.rate else ""))
    if outcome.recording:
        click.echo(f"bag: {bag}: {outcome.recording}")
    failures = dict.fromkeys(failure for failure in (outcome.failure, outcome.recording_failure) if failure)
    if failures:
        raise click.ClickException("; ".join(failures))


@contextmanager
def _watched(scenario: Scenario, host: str, port: int) -> Iterator[None]:
    """With the page of a run, in a process beside it."""
    from agv_analysis.runtime.run_setup import params_file
    from agv_analysis.watch.beside_run import watcher_beside

    def ready(address: str) -> None:
        click.echo(f"live: {address}", err=True)

    with params_file(scenario) as params, watcher_beside(scenario, params, host, port, ready):
        yield


def _run_fleet(
    scenario: Scenario, count: int, pitch: float, bag: Path | None, processes: bool, disk: tuple[bool, str]
) -> None:
    from agv_analysis.bags.writer import new_directory
    from agv_analysis.commands.progress import step_bar
    from agv_analysis.runtime.fleet import to_json, vehicle_names, vehicle_scenarios
    from agv_analysis.sweep.rows_file import write_rows

    fleet = dict(zip(vehicle_names(count), vehicle_scenarios(scenario, count, pitch), strict=True))
    with needs_ros():
        from agv_analysis.runtime.run_setup import OnDisk

        if processes:
            from agv_analysis.runtime.processes import run_fleet_in_processes as run
        else:
            from agv_analysis.runtime.runner import run_fleet as run
    if bag is not None:
        with new_directory(bag):
            pass  # each vehicle's recorder goes on in it
    with step_bar(count * scenario.plant.duration / scenario.plant.ts) as progress:
        outcomes = run(fleet, bag, progress, OnDisk(*disk))
    ended = dict(zip(fleet, outcomes, strict=True))
    rate = sum(outcome.rate for outcome in outcomes)
    click.echo(
        f"{counted(count, 'AGV')}, {sum(outcome.steps for outcome in outcomes)} steps"
        + (f", {rate:.0f} steps/s" * bool(rate))
    )
    vehicles = _judged(ended, bag)
    if bag is not None:
        _print_fleet(vehicles)
        content, as_json, as_csv = to_json(vehicles), bag / "fleet.json", bag / "fleet.csv"
        write_json(as_json, content)
        write_rows(content["vehicles"], as_csv)
        click.echo(f"json:    {as_json}\ncsv:     {as_csv}")
    failures = [f"{vehicle.vehicle}: {vehicle.failure}" for vehicle in vehicles if vehicle.failure]
    if failures:
        raise click.ClickException("\n".join(failures))


def _judged(ended: dict[str, Outcome], bag: Path | None) -> list[Vehicle]:
    """Each vehicle by its recording, if there is one."""
    from agv_analysis.commands.progress import step_bar
    from agv_analysis.runtime.fleet import Vehicle, judge

    vehicles = []
    with step_bar(len(ended), "judging") as progress:
        for name, outcome in ended.items():
            failure = "; ".join(filter(None, (outcome.failure, outcome.recording_failure)))
            vehicles.append(
                Vehicle(name, outcome.steps, failure)
                if bag is None
                else judge(name, outcome.steps, failure, bag / name)
            )
            progress(len(vehicles))
    return vehicles


def _print_fleet(vehicles: list[Vehicle]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from agv_analysis.report.table import print_framed

    table = Table(box=None, pad_edge=False)
    table.add_column("AGV", no_wrap=True)
    for heading in ("steps", "lost", "outage", "to 1 cm", "deviation [m]", "of corridor", "twins"):
        table.add_column(escape(heading), justify="right")
    table.add_column("verdict")
    for one in vehicles:
        table.add_row(
            one.vehicle, str(one.steps), _text(one.loss_rate, ".2%"), _text(one.longest_outage, "d"),
            _text(one.settle_1cm_steps, "d"), "-" if one.deviation is None else _deviation(one).removesuffix(" m"),
            _text(one.corridor_share, ".0%"), _text(one.contraction, ".2g"),
            one.verdict or "-",
        )  # fmt: skip
    console = Console(highlight=False)
    if headlines := list(_headlines(vehicles)):
        print_framed(console, headlines)
    console.print(table)
    if worst := _worst(vehicles):
        console.print(f"{worst.vehicle}: [bold]{worst.verdict}[/], {escape(str(worst.verdict_reason))}.")
    if any(one.unstable is not None for one in vehicles):
        console.print(
            "Twins: how far apart two AGVs end that begin a micrometre apart and meet the losses of this run, as a "
            "multiple of that."
        )


def _headlines(vehicles: list[Vehicle]) -> Iterator[tuple[str, str]]:
    """What the fleet does, and which AGV is the reason, with rich's markup; nothing without recordings."""
    from agv_analysis.metrics.confidence import percent
    from agv_analysis.report.table import colour_of
    from agv_analysis.runtime.fleet import instability
    from agv_analysis.sweep.verdicts import words_said

    if worst := _worst(vehicles):
        words = words_said([{"verdict": one.verdict} for one in vehicles])
        yield "Verdict", f"[{colour_of(str(worst.verdict))}]{words}[/]"
    if strayed := [one for one in vehicles if one.deviation is not None]:
        farthest = max(strayed, key=_largest)
        yield "Deviation", f"largest: {_deviation(farthest)} ({farthest.vehicle})"
    if used := {one.vehicle: one.corridor_share for one in vehicles if one.corridor_share is not None}:
        most = max(used, key=lambda name: used[name])
        yield "Corridor", f"{used[most]:.0%} of it used at most ({most})"
    found = instability(vehicles)
    if found.judged:
        yield (
            "Unstable",
            (
                f"{found.unstable} of {counted(found.judged, 'AGV')}, {percent(found.fraction)} "
                f"({percent(found.low)} .. {percent(found.high)} with {percent(found.confidence)} confidence)"
            ),
        )


def _worst(vehicles: list[Vehicle]) -> Vehicle | None:
    """The first one with the worst word, None if none has a word."""
    from agv_analysis.stability.verdict import WORDS

    judged = [one for one in vehicles if one.verdict is not None]
    return max(judged, key=lambda one: WORDS.index(str(one.verdict)), default=None)


def _largest(one: Vehicle) -> float:
    """The largest deviation of a vehicle [m], inf of one that diverges, of which there is no number."""
    largest = None if one.deviation is None else one.deviation["max"]
    return math.inf if largest is None else float(largest)


def _deviation(one: Vehicle) -> str:
    from agv_analysis.metrics.distance_text import metres

    return metres(_largest(one))


def _text(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"
