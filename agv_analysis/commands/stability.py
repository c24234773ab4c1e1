"""`agv-ncs stability`: margins of a scenario, without a recording."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from agv_analysis.commands import OUTPUT, corridor_settings, with_corridor, with_force, with_settings, write_json
from agv_ros.counted import counted

if TYPE_CHECKING:
    from collections.abc import Iterator

    from agv_analysis.corridor.corridor import Corridor
    from agv_analysis.scenario import Scenario
    from agv_analysis.stability.empirical import Twins
    from agv_analysis.stability.gains import GainChoice
    from agv_analysis.stability.verdict import Evidence, Verdict


_POLICIES = {
    "hold": "held (error_detector.policy is hold)",
    "align": "held, and compared with the reference of its own time (error_detector.policy is align)",
    "predict": "moved on by the plant's model (error_detector.policy is predict)",
}

_SEEDS = 20
"""Runs under the scenario's channel that the criteria are held against."""


@click.command("stability", short_help="Find how many outages the loop tolerates, by each criterion.")
@with_settings
@with_corridor
@click.option(
    "--confidence", type=click.FloatRange(0.0, 1.0, min_open=True, max_open=True), metavar="C",
    help="Say, too, which corridor a lap keeps with the probability C, and up to which speed it keeps the --corridor.",
)  # fmt: skip
@click.option("--json", "json_file", type=OUTPUT, help="Write what is printed to this file, too.")
@click.option(
    "--map", "axes", metavar="AXIS,AXIS",
    help="Instead, to the files of --csv and --picture: margins over a grid of two of the control law's gains (kx, ky, "
    "ktheta), ts, v and curvature, each from a tenth to ten times the scenario's value. Its n_bursts is the longest "
    "outage whose repetition dies out; outages of changing length may allow less, which the margins of one scenario "
    "prove.",
)  # fmt: skip
@click.option("--points", type=click.IntRange(2, 1000), default=100, show_default=True, help="Points of each axis.")
@click.option("--csv", "csv_file", type=OUTPUT, help="Where the map goes, map.csv by default.")
@click.option("--picture", type=OUTPUT, help="Where the map is drawn, map.png by default.")
@click.option("--report", type=OUTPUT, help="With --map: write a page for the browser to this file.")
@with_force
def command(
    params: str,
    settings: tuple[str, ...],
    corridor_width: float | None,
    corridor_along: float | None,
    laps: int | None,
    confidence: float | None,
    json_file: Path | None,
    axes: str | None,
    points: int,
    csv_file: Path | None,
    picture: Path | None,
    report: Path | None,
) -> None:
    """Say how much the loop of the params file PARAMS can take, by each criterion, and where they disagree.

    \b
    Examples:
      agv-ncs stability config/paper.yaml
      agv-ncs stability config/outages.yaml --set controller.kx=5.0 --set error_detector.track=line --json margins.json
      agv-ncs stability config/outages.yaml --corridor 0.25
      agv-ncs stability config/outages.yaml --set error_detector.track=eight --corridor 0.25 --confidence 0.95
      agv-ncs stability config/paper.yaml --map kx,ts --csv map.csv --picture map.png --report map.html
    """
    from concurrent.futures import ThreadPoolExecutor

    from rich.console import Console
    from rich.markup import escape

    from agv_analysis.corridor.corridor import corridor
    from agv_analysis.corridor.kept_with_confidence import kept_with_confidence
    from agv_analysis.output_file import output_file
    from agv_analysis.report.table import print_framed, print_groups
    from agv_analysis.report.verdict_sentence import by_what
    from agv_analysis.scenario import load_scenario
    from agv_analysis.stability.empirical import simulated_twins, too_short, with_an_end
    from agv_analysis.stability.evidence import evidence_of_scenario
    from agv_analysis.stability.margins import margins
    from agv_analysis.stability.repeated_run import settles_without_losses
    from agv_analysis.stability.twins_border import twins_border
    from agv_analysis.stability.verdict import decide

    scenario = load_scenario(params, (*settings, *corridor_settings(corridor_width, corridor_along)))
    if axes is not None:
        _map(scenario, axes, points, csv_file or output_file("map.csv"), picture or output_file("map.png"), report)
        return
    if report is not None:
        raise click.UsageError("--report needs --map with its two axes; `simulate --report` reports on a run")
    console = Console(highlight=False)
    seeds = range(scenario.relay.seed, scenario.relay.seed + _SEEDS)
    with Console(stderr=True).status("computing the margins ...") as status, ThreadPoolExecutor(1) as beside:

        def within_corridor(what: str) -> None:
            status.update(f"within the corridor: {what} ...")

        within_it = beside.submit(corridor, scenario, laps, within_corridor)
        found, run = margins(scenario), with_an_end(scenario)
        twins = simulated_twins(run, seeds)
        status.update("simulating under more and more losses ...")
        border = twins_border(run, progress=lambda done: status.update(f"simulated: {done} loss probabilities"))
        found = dataclasses.replace(found, twins=twins, found={**found.found, border.name: border})
        evidence = evidence_of_scenario(scenario, twins.evidence)
        verdict = decide(evidence)
        within = within_it.result()
        kept = None if confidence is None else kept_with_confidence(scenario, confidence, laps, within_corridor)
    print_framed(console, _headlines(verdict, evidence, within))
    said_of_twins = _told(twins, seeds)
    if twins.contracting and not settles_without_losses(scenario):
        said_of_twins += "; they converge, but the loop does not settle even without losses"
    elif not twins.is_long_enough and settles_without_losses(scenario):
        said_of_twins += f"; {too_short(twins.left_without_losses)}"
    policy = scenario.error_detector.policy
    outdated = ("An outdated pose is", _POLICIES.get(policy, f"taken on by error_detector.policy {policy}"))
    best, why_no_gain = _best_gains(scenario)
    gains = [(f"For {objective.replace('_', ' ')}", choice.words) for objective, choice in best.items()]
    groups = {
        "How much the loop can take": [outdated, *found.rows(), ("Simulation check", said_of_twins)],
        "Corridor": [*(() if within is None else within.rows()), *(() if kept is None else kept.rows())],
        "Verdict": [("Decided by", by_what(verdict.criterion)), ("Because", verdict.reason)],
        "Best K_x": gains or [("For any aim", why_no_gain)],
    }
    shown = ((title, [(name, escape(value)) for name, value in rows]) for title, rows in groups.items() if rows)
    print_groups(console, shown)
    if found.recommendation:
        console.print(f"[bold]Design with[/] {escape(found.recommendation)}.")
    for sentence in found.disagreements():
        console.print(f"[bold yellow]They disagree:[/] {sentence}.")
    if found.infeasible and found.infeasible != verdict.reason:
        console.print(f"[bold red]Infeasible:[/] {escape(found.infeasible)}.")
    for note in found.notes:
        console.print(f"[bold yellow]Loss-free motion:[/] {escape(note)}.")
    for note in () if within is None else within.notes:
        console.print(f"[bold yellow]Corridor:[/] {escape(note)}.")
    if found.left_out:
        console.print(
            f"[bold yellow]Left out of all margins, not of the simulation check:[/] {', '.join(found.left_out)}."
        )
    if json_file is not None:
        link = evidence.link  # as a run shows it, where the channel is not known
        fit = None if link is None else {"goodness": link.goodness.to_json()}
        word: dict[str, Any] = {**verdict.to_json(), "margin": verdict.margin, **evidence.to_json(), "channel_fit": fit}
        if within is not None:
            word["corridor"] = {**within.to_json(), "kept": None if kept is None else kept.to_json()}
        write_json(json_file, {**word, **found.to_json(), **_gains_to_json(best, why_no_gain)})


def _headlines(verdict: Verdict, evidence: Evidence, within: Corridor | None) -> Iterator[tuple[str, str]]:
    """Is it stable, how far does it stray, how much more can it take: with rich's markup."""
    from rich.markup import escape

    from agv_analysis.report.table import colour_of
    from agv_analysis.report.verdict_sentence import beside_track, in_words
    from agv_analysis.stability.verdict import GREEN

    said = in_words(verdict.word, evidence.n) + beside_track(verdict.word, evidence)
    yield "Verdict", f"[bold {colour_of(verdict.word)}]{said[0].upper()}{said[1:]}[/]"
    if verdict.word not in GREEN:
        yield "Because", escape(verdict.reason)
    yield "Deviation", "--corridor METRES says how far it strays" if within is None else escape(within.in_short)
    if verdict.word in GREEN:
        yield "Margin", escape(verdict.margin)


def _told(twins: Twins, seeds: range) -> str:
    """What twins did, in words."""
    if twins.different == 1 < len(seeds):
        word = f"contracts to {twins.median:.2g}" if twins.contracting else "does not contract"
        return f"1 run, which {word}: the seeds {seeds[0]} to {seeds[-1]} all give the same"
    runs = f"in {twins.contracting} of {counted(len(seeds), 'run')} (seeds {seeds[0]} to {seeds[-1]})"
    converge = f"neighbouring trajectories converge {runs}"
    if not math.isfinite(twins.median):
        return f"{converge}; the others diverge"
    if twins.median == 0.0:
        return f"{converge}, in the median until no distance is left"
    return f"{converge}, in the median to {twins.median:.2g} of their distance"


def _best_gains(scenario: Scenario) -> tuple[dict[str, GainChoice], str]:
    """Best K_x by objective under the scenario's uplink, and why there is none.

    None behind a predictor, for another law, for a channel that is not a Markov chain or loses all.
    """
    from agv_analysis.link.markov_channel import chain_of, why_no_chain
    from agv_analysis.stability.derived_loop import is_kanayamas_law
    from agv_analysis.stability.gains import best_kx
    from agv_analysis.stability.scenario_loop import lap_of, straight_loop_of

    chain, model = chain_of(scenario.relay.uplink), scenario.relay.uplink.model
    if scenario.error_detector.policy == "predict":
        return {}, "no answer: computed for a pose that is held, not for one that is predicted"
    if chain is None:
        return {}, f"no answer: the channel {model} {why_no_chain(scenario.relay.uplink)}"
    if chain.loss_rate >= 1.0:
        return {}, "no answer: the scenario's uplink loses everything"
    # With a gain of 1 the loop's a is how far a commanded speed of 1 m/s moves the AGV in a step.
    unit = dataclasses.replace(scenario, controller=dataclasses.replace(scenario.controller, kx=1.0))
    loop = straight_loop_of(unit) if is_kanayamas_law(scenario) else None
    advance = None if loop is None else loop.along_gain
    if advance is None or advance <= 0.0:
        return {}, "no answer: computed for Kanayama's law and a drive that obeys at once"
    return best_kx(chain, advance, len(lap_of(scenario))), ""


def _gains_to_json(best: dict[str, GainChoice], why_no_gain: str) -> dict[str, Any]:
    """The best gains by objective, what each costs, and the reasons."""
    if not best:
        return {"best_kx": None, "best_kx_reason": why_no_gain}
    gains = {objective: choice.kx for objective, choice in best.items()}
    reasons = {f"{objective}_reason": choice.reason for objective, choice in best.items() if choice.reason}
    costs = {objective: choice.to_json() for objective, choice in best.items()}
    return {"best_kx": {**gains, **reasons}, "best_kx_costs": costs}


def _map(scenario: Scenario, axes: str, points: int, csv_file: Path, picture: Path, report: Path | None) -> None:
    """Write and draw the map over two axes."""
    from agv_analysis.commands.progress import step_bar
    from agv_analysis.corridor.corridor_map import best_point, with_corridor
    from agv_analysis.report.margin_map_files import draw, write_csv
    from agv_analysis.stability.margin_map import margin_map, ranges_of
    from agv_ros.errors import UserError

    names = tuple(axes.split(","))
    if len(names) != 2:
        raise UserError(f"--map takes two axes with a comma between them, as in kx,ts; got {axes!r}")
    first, second = ranges_of(scenario, names, points)
    with step_bar(points * points, "computing the map") as progress:
        found = margin_map(scenario, (names[0], names[1]), first, second, progress)
    if scenario.error_detector.corridor > 0.0:
        with step_bar(points * points, "within the corridor") as progress:
            found = with_corridor(found, scenario, progress)
    write_csv(csv_file, found)
    draw(picture, found, scenario)
    if best := best_point(found):
        click.echo(f"corridor: {best}")
    click.echo(f"map:     {csv_file}\npicture: {picture}")
    if report is not None:
        from agv_analysis.report.map_page import write_map_page

        write_map_page(found, scenario, report, f"agv-ncs stability params.yaml --map {axes} --points {points}")
        click.echo(f"report:  {report}")
