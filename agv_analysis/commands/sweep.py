"""`agv-ncs sweep`: the loop over a grid of parameters, under many seeds."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from agv_analysis.commands import corridor_settings, with_corridor, with_force, with_report, with_settings
from agv_analysis.sweep import CORRIDOR_COLUMNS, METRICS, MOST_POINTS
from agv_ros.counted import counted

if TYPE_CHECKING:
    from rich.table import Table

    from agv_analysis.sweep.execute import Results
    from agv_analysis.sweep.plan import Part, Sweep

_LONGEST_TABLE = 40
"""Points that fit on a screen."""


@click.command("sweep", short_help="Simulate a grid of parameters under many seeds.")
@with_settings
@with_corridor
@click.option(
    "--vary", "axes", multiple=True, required=True, metavar="NODE.PARAMETER=VALUES",
    help="What to vary: first:last:count, evenly spaced, or a,b,c. May be repeated: all combinations are run.",
)  # fmt: skip
@click.option("--seeds", type=int, default=1, show_default=True, help="How many, counted from relay.seed on.")
@click.option(
    "--metric", "metrics", multiple=True, type=click.Choice(["instability", *METRICS, *CORRIDOR_COLUMNS]),
    default=["instability"], show_default=True,
    help="What to draw; of the others the median over the seeds, or what is said of the --corridor. May be repeated.",
)  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), help="Keep results and pictures in this directory.")
@click.option("--format", "suffix", type=click.Choice(["csv", "parquet"]), default="csv", show_default=True)
@click.option("--resume", is_flag=True, help="Go on with the sweep in --out, which was stopped.")
@click.option(
    "--verdicts/--no-verdicts", default=None,
    help=f"A verdict on each point, by the rules of `stability`; by default for up to {MOST_POINTS} points.",
)  # fmt: skip
@click.option("--workers", type=click.IntRange(1), help="Threads on this machine; one a core by default.")
@click.option("--scheduler", metavar="ADDRESS", help="Run on the Dask cluster whose scheduler is there.")
@with_report
@with_force
def command(
    params: str,
    settings: tuple[str, ...],
    corridor_width: float | None,
    corridor_along: float | None,
    laps: int | None,
    axes: tuple[str, ...],
    seeds: int,
    metrics: tuple[str, ...],
    out: Path | None,
    suffix: str,
    resume: bool,
    verdicts: bool | None,
    workers: int | None,
    scheduler: str | None,
    report: Path | None,
    figures: Path | None,
) -> None:
    """Simulate the params file PARAMS at every point of a grid, under many seeds: how likely is the loop unstable?

    A run is unstable if a twin that begins a micrometre away and meets the same losses does not come closer by its end,
    or if the loop does not settle even without losses; undecided, if runs are shorter than its transient. Every point
    meets the same seeds, so points with the same channel meet the same outages. The verdict on a point is that of
    `stability`, with the runs of the sweep for its twins if they are ten or more.

    \b
    Examples:
      agv-ncs sweep config/outages.yaml --vary controller.kx=5,25,250 --seeds 20
      agv-ncs sweep config/paper.yaml --set relay.uplink.model=bernoulli --vary controller.kx=5:400:40
        --vary relay.uplink.p=0:0.95:20 --seeds 200 --out sweeps/gain
      agv-ncs sweep config/outages.yaml --vary controller.kx=2:50:9 --corridor 0.25 --metric p_hour --out sweeps/metres
      (the same with --resume goes on where Ctrl-C stopped it)
    """
    from agv_analysis.commands.progress import step_bar
    from agv_analysis.scenario import load_scenario
    from agv_analysis.sweep.collect import collect
    from agv_analysis.sweep.corridors import has_corridor, with_corridors
    from agv_analysis.sweep.plan import Sweep, SweepError, parse_axis
    from agv_analysis.sweep.store import Store
    from agv_analysis.sweep.verdicts import with_verdicts

    if resume and out is None:
        raise SweepError("--resume goes on with a sweep in a directory: name it by --out")
    settings = (*settings, *corridor_settings(corridor_width, corridor_along))
    sweep = Sweep(load_scenario(params, settings), tuple(map(parse_axis, axes)), seeds)
    sweep.check()
    if not has_corridor(sweep) and (asked := [metric for metric in metrics if metric in CORRIDOR_COLUMNS]):
        raise SweepError(f"--metric {asked[0]} needs a corridor: give its half-width by --corridor")
    store = None if out is None else Store(out, sweep, resume)

    def results(parts: list[Part]) -> Results:
        from agv_analysis.sweep.execute import on_dask, on_this_machine

        return on_dask(sweep, parts, scheduler) if scheduler else on_this_machine(sweep, parts, workers)

    with step_bar(sweep.size * seeds, "simulating") as progress:
        rows, complete = collect(sweep, store, results, progress)
    if complete and (verdicts or (verdicts is None and len(rows) <= MOST_POINTS)):
        with step_bar(len(rows), "judging") as progress, suppress(KeyboardInterrupt):
            complete = False
            rows = with_verdicts(sweep, rows, workers, progress)
            complete = True
    if complete and has_corridor(sweep):
        with step_bar(len(rows), "within the corridor") as progress, suppress(KeyboardInterrupt):
            complete = False
            rows = with_corridors(sweep, rows, laps, progress)
            complete = True
    _write_rows(sweep, rows, metrics, out, suffix)
    _write_reports(sweep, rows, report, figures)
    if not complete:
        again = ": the same command with --resume goes on" if out is not None else ""
        click.echo(
            f"interrupted after {sum(row['runs'] for row in rows)} of {counted(sweep.size * seeds, 'run')}{again}",
            err=True,
        )
        raise click.exceptions.Exit(130)


def _write_rows(
    sweep: Sweep, rows: list[dict[str, Any]], metrics: tuple[str, ...], out: Path | None, suffix: str
) -> None:
    from agv_analysis.sweep.picture import can_draw, draw
    from agv_analysis.sweep.rows_file import write_rows

    if len(rows) <= _LONGEST_TABLE:
        _print_rows(sweep, rows)
    if out is None or not rows:
        return
    write_rows(rows, out / f"points.{suffix}")
    click.echo(f"points:  {out / f'points.{suffix}'}")
    for metric in metrics if can_draw(sweep) else ():
        column = f"{metric}_p50" if metric in METRICS else metric
        if column in rows[0]:  # a sweep that was interrupted has no figures of its corridor
            draw(sweep, rows, column, out / f"{metric}.png")
            click.echo(f"picture: {out / f'{metric}.png'}")


def _write_reports(sweep: Sweep, rows: list[dict[str, Any]], report: Path | None, figures: Path | None) -> None:
    """Write what `with_report` asks for."""
    if report is not None:
        from agv_analysis.report.sweep_page import write_sweep_report

        axes = " ".join(f"--vary {axis.name}={','.join(map(str, axis.values))}" for axis in sweep.axes)
        command = f"agv-ncs sweep params.yaml {axes} --seeds {len(sweep.seeds)} --report report.html"
        write_sweep_report(sweep, rows, report, command)
        click.echo(f"report:  {report}")
    if figures is not None and rows:
        from agv_analysis.report.sweep_page import draw_sweep_figures

        draw_sweep_figures(sweep, rows, figures)
        click.echo(f"figures: {figures}")


def _print_rows(sweep: Sweep, rows: list[dict[str, Any]]) -> None:
    from rich.console import Console

    from agv_analysis.metrics.distance_text import metres
    from agv_analysis.report.table import print_framed
    from agv_analysis.sweep.verdicts import words_said

    names = ("unstable\nruns", "\nshare", "95 %\nconfidence", "steps to\n1 cm", "deviates\nup to")
    table = _table(sweep, names)
    for row in rows:
        table.add_row(
            *(_plain(row[axis.name]) for axis in sweep.axes),
            f"{row['unstable']} of {row['runs']}", "-" if row["undecided"] else f"{row['instability']:.3f}",
            f"{row['instability_low']:.3f} .. {row['instability_high']:.3f}", _steps(row["settle_1cm_steps_p50"]),
            metres(row["deviation_max_p50"]),
        )  # fmt: skip
    console = Console(highlight=False)
    print_framed(console, _headlines(sweep, rows))
    console.print(table)
    if rows and "verdict" in rows[0]:
        console.print(_verdicts(sweep, rows))
        console.print(f"Verdicts: {words_said(rows)}")
    if rows and "p_lap" in rows[0]:
        console.print(_corridors(sweep, rows))
    unsaid = sum(row["undecided"] for row in rows)
    if unsaid:
        console.print(
            f"[bold yellow]Undecided:[/] {counted(unsaid, 'run is', 'runs are')} shorter than the transient of "
            "the loop without losses, "
            "so neighbouring trajectories that are not closer by their end say nothing; make plant.duration longer."
        )


def _headlines(sweep: Sweep, rows: list[dict[str, Any]]) -> Iterator[tuple[str, str]]:
    """Where the loop is stable, how far it strays at best, and how sure that is: with rich's markup."""
    from rich.markup import escape

    from agv_analysis.metrics.distance_text import metres
    from agv_analysis.sweep.sweep_sentence import best_point, is_calm, sweep_reason, sweep_sentence

    yield "Verdict", escape(sweep_sentence(rows, *sweep.axes))
    calm = [row for row in rows if is_calm(row)]
    if reason := sweep_reason(rows, *sweep.axes):
        yield "The others" if 0 < len(calm) < len(rows) else "Because", escape(reason)
    if not calm:
        return
    best = best_point(rows)
    where = ", ".join(f"{axis.name} {_plain(best[axis.name])}" for axis in sweep.axes)
    largest = metres(best["deviation_max_p50"])
    yield "Deviation", f"largest {largest} at {where} (best point, median)"
    sure = 100.0 * max(row["instability_high"] for row in calm)
    yield "Confidence", f"below {sure:.3g} % of runs unstable at stable points (95 %)"


_IN_A_LAP = "leaves in\na lap"
"""The widest column, with an interval, which may take two lines."""


def _table(sweep: Sweep, names: Sequence[str] = ()) -> Table:
    """A table that begins with a column for each axis, as narrow as a name allows that tells it from the others."""
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for name in _short_names([axis.name for axis in sweep.axes]):
        table.add_column(escape(name.replace(".", ".\n")), justify="right", no_wrap=True)
    for name in names:
        table.add_column(escape(name), justify="right", no_wrap=name != _IN_A_LAP)
    return table


def _short_names(names: Sequence[str]) -> list[str]:
    """Of each name with points the shortest ending that none of the others has: `kx`, `uplink.p`, `downlink.p`."""

    def short(name: str) -> str:
        parts = name.split(".")
        endings = (".".join(parts[place:]) for place in range(len(parts) - 1, 0, -1))
        others = [other for other in names if other != name]
        return next((end for end in endings if not any(f".{other}".endswith(f".{end}") for other in others)), name)

    return [short(name) for name in names]


def _corridors(sweep: Sweep, rows: list[dict[str, Any]]) -> Table:
    """What each point does within its corridor, the best one marked."""
    from agv_analysis.metrics.confidence import computed
    from agv_analysis.sweep.corridors import best_for_corridor

    best = best_for_corridor(sweep, rows)
    table = _table(sweep, ("single\noutage", "any\noutages", _IN_A_LAP, "in an\nhour", "mean time", ""))
    for row in rows:
        table.add_row(
            *(_plain(row[axis.name]) for axis in sweep.axes), f"{row['n_single']:g}", f"{row['n_any']:g}",
            f"{row['p_lap']:.3g}\n({row['p_lap_low']:.2g} .. {row['p_lap_high']:.2g})", computed(row["p_hour"]),
            _mean_time(row), "most rarely" if row is best else "",
        )  # fmt: skip
    return table


def _mean_time(row: dict[str, Any]) -> str:
    from agv_analysis.metrics.duration_text import duration_text

    if math.isfinite(row["mean_time_s"]):
        return duration_text(row["mean_time_s"])
    return "not seen" if row["p_hour_high"] > 0.0 else "never"


def _verdicts(sweep: Sweep, rows: list[dict[str, Any]]) -> Table:
    """The word on each point, and why."""
    from rich.markup import escape

    from agv_analysis.report.table import colour_of

    table = _table(sweep)
    table.add_column("verdict", no_wrap=True)
    table.add_column("because")
    for row in rows:
        word = row["verdict"]
        values = (_plain(row[axis.name]) for axis in sweep.axes)
        table.add_row(*values, f"[{colour_of(word)}]{word}[/]", escape(row["verdict_reason"]))
    return table


def _steps(count: float) -> str:
    return "-" if math.isnan(count) else "never" if math.isinf(count) else f"{count:g}"


def _plain(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
