"""`agv-ncs link`: what somebody measured of a link, and what a loop does behind it."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from agv_analysis.commands import OUTPUT, corridor_settings, with_force, write_json
from agv_analysis.commands.link_file import FileOptions, read_link_file, with_link_file
from agv_ros.counted import counted

if TYPE_CHECKING:
    from rich.console import Console

    from agv_analysis.link.link_figures import DirectionFigures, LinkFigures, Spread
    from agv_analysis.link.measurement import LossRates, Measurement, Setting
    from agv_analysis.scenario import Scenario
    from agv_analysis.stability.through_link import ThroughLink


@click.command("link", short_help="Read a measured link: ping, irtt, a capture, a bag, ...")
@click.argument("file", type=click.Path(path_type=Path))
@click.argument("params", type=click.Path(), required=False)
@click.option("--set", "settings", multiple=True, metavar="NODE.PARAMETER=VALUE", help="Change a parameter of PARAMS.")
@click.option("--corridor", type=click.FloatRange(min=0.0, min_open=True), help="How often is it further off [m]?")
@with_link_file
@click.option(
    "--rtt", type=click.Choice(["up", "half", "down"]), default="up", show_default=True,
    help="Where only round trips are known: on which way packets and time were lost.",
)  # fmt: skip
@click.option("--trace", type=OUTPUT, help="Write a file for the channel trace, with times.")
@click.option("--picture", type=OUTPUT, help="Draw the link to this file.")
@click.option("--json", "json_file", type=OUTPUT, help="Write the figures to this file, too.")
@with_force
def command(
    file: Path, params: str | None, settings: tuple[str, ...], corridor: float | None, rtt: str, trace: Path | None,
    picture: Path | None, json_file: Path | None, **of_file: Any,
) -> None:  # fmt: skip
    """Show what FILE says of a link: output of ping, irtt, owping, iperf3, a capture, a table, a bag, a line for netem.

    With the params file PARAMS: what its loop does behind this very link, and behind the channel fitted to it.

    \b
    Examples:
      agv-ncs link ping.txt --picture link.png
      agv-ncs link irtt.json config/outages.yaml --json link.json
      agv-ncs link "delay 20ms 5ms loss 1% 25%"
      agv-ncs link capture.csv --column time=frame.time_epoch --column seq=icmp.seq --trace trace.csv
    """
    from rich.console import Console

    from agv_analysis.link.measurement import LossRates, Setting
    from agv_analysis.scenario import load_scenario

    if params is None and (settings or corridor is not None):
        raise click.UsageError("--set and --corridor are about the loop of a params file: give PARAMS behind FILE")
    scenario = None if params is None else load_scenario(params, (*settings, *corridor_settings(corridor, None)))
    reading = read_link_file(file, FileOptions(**of_file))
    console = Console(highlight=False)
    if isinstance(reading, Setting):
        found = _setting(console, reading, scenario)
    elif isinstance(reading, LossRates):
        found = _rates(console, reading)
    else:
        found = show_measurement(console, reading, scenario, rtt, trace, picture)
    if json_file is not None:
        write_json(json_file, found)
    if isinstance(reading, LossRates) and (scenario is not None or trace is not None or picture is not None):
        raise click.ClickException(reading.refusal)
    if isinstance(reading, Setting) and (trace is not None or picture is not None):
        raise click.ClickException(f"{reading.source}: {reading.line!r} is a setting, of which there is no measurement")


def _setting(console: Console, found: Setting, scenario: Scenario | None) -> dict[str, Any]:
    from dataclasses import replace

    from agv_analysis.link.link_figures import setting_to_json

    content = setting_to_json(found)
    shown = ", ".join(f"{key} {value}" for key, value in content["channel"].items())
    console.print(f"[bold]{found.source}[/]: a setting of netem, no measurement", soft_wrap=True)
    console.print(f"Channel: {shown}", soft_wrap=True)
    for sentence in found.differences:
        console.print(f"[bold yellow]Not the same:[/] {sentence}.", soft_wrap=True)
    if scenario is not None:
        from agv_analysis.stability.through_link import through_channel

        relay = replace(scenario.relay, uplink=found.channel)
        with _busy("driving the loop ..."):
            driven = through_channel(replace(scenario, relay=relay))
        _print_driven(console, "through it as the uplink", driven)
        content["loop"] = driven.to_json()
    return content


def _rates(console: Console, found: LossRates) -> dict[str, Any]:
    from agv_analysis.link.link_figures import rate_of, rates_to_json

    rate = rate_of(found)
    console.print(
        f"[bold]{found.source}[/]: {found.format}, {counted(int(found.packets.sum()), 'packet')} in "
        f"{len(found.packets)} "
        f"intervals, {_percent(rate.value)} lost (95 %: {_percent(rate.low)} to {_percent(rate.high)})",
        soft_wrap=True,
    )
    for note in found.notes:
        console.print(f"[bold yellow]Note:[/] {note}.", soft_wrap=True)
    return rates_to_json(found)


def show_measurement(
    console: Console, measured: Measurement, scenario: Scenario | None, rtt: str, trace: Path | None,
    picture: Path | None,
) -> dict[str, Any]:  # fmt: skip
    """Print what a measured link comes to, and what a loop does behind it; returns the figures as JSON."""
    from rich.markup import escape
    from rich.table import Table

    from agv_analysis.link.link_figures import LinkFigures
    from agv_analysis.link.measured_picture import draw_link
    from agv_analysis.link.measured_trace import link_of_loop, write_trace

    found, link = LinkFigures(measured), link_of_loop(measured, rtt)
    with _busy("working out the figures ..."):
        figures = found.to_json()
    console.print(
        f"[bold]{escape(measured.source)}[/]: {measured.format}, {counted(measured.packets, 'packet')} in "
        f"{measured.span:.6g} s, "
        f"one every {1e3 * measured.interval:.4g} ms",
        soft_wrap=True,
    )
    table = Table(box=None, pad_edge=False)
    for column in ("", *(name.replace("_", " ") for name in found.directions)):
        table.add_column(column, style=None if column else "bold")
    for row in rows(found):
        table.add_row(*row)
    console.print(table)
    for sentence in sentences(found):
        console.print(sentence, soft_wrap=True)
    for note in (*measured.notes, *measured.malformed.sentences(), *link.notes):
        console.print(f"[bold yellow]Note:[/] {escape(note)}.", soft_wrap=True)
    content = {**figures, "assumed": list(link.notes)}
    if trace is not None:
        write_trace(trace, link)
        console.print(f"trace:   {trace}")
    if picture is not None:
        draw_link(picture, found)
        console.print(f"picture: {picture}")
    if scenario is not None:
        content["loop"] = _driven(console, scenario, found, link)
    return content


def _driven(console: Console, scenario: Scenario, found: LinkFigures, link: Any) -> dict[str, Any]:
    """Drive a loop through a link, without its delays where it has some, and as fitted."""
    from agv_analysis.stability.through_link import fitted_scenario, through_channel, through_trace, without_delays

    content = {}
    has_delays = any(delay is not None for delay in (link.uplink_delay, link.downlink_delay))
    with tempfile.TemporaryDirectory() as folder, _busy("driving the loop through the link ..."):
        driven = through_trace(scenario, link, Path(folder) / "link.csv")
        alone = through_trace(scenario, without_delays(link), Path(folder) / "losses.csv") if has_delays else None
        fitted = through_channel(fitted_scenario(scenario, link, found.measured.interval))
    _print_driven(console, "through this very link", driven)
    content = driven.to_json()
    if alone is not None:
        _print_driven(console, "through its losses alone", alone)
        content["losses_alone"] = alone.to_json()
    _print_driven(console, "through the fitted channel", fitted)
    content["fitted"] = fitted.to_json()
    return content


def _busy(what: str) -> Any:
    from rich.console import Console

    return Console(stderr=True).status(what)


def _print_driven(console: Console, how: str, driven: ThroughLink) -> None:
    import numpy as np
    from rich.markup import escape

    from agv_analysis.report.table import colour_of

    verdict = driven.verdict
    console.print(
        f"The loop {how}: [bold {colour_of(verdict.word)}]{verdict.word}[/], {escape(verdict.reason)}", soft_wrap=True
    )
    largest, count = float(driven.deviations.max()), len(driven.deviations)
    runs = f"a run of {driven.seconds:g} s" if count == 1 else f"{counted(count, 'run')} of {driven.seconds:g} s"
    far = f"up to {largest:.3g} m from its reference" if np.isfinite(largest) else "without bound"
    median = "" if count == 1 else f", the median run up to {float(np.median(driven.deviations)):.3g} m"
    console.print(f"  Deviation in {runs}: {far}{median}", soft_wrap=True)
    if driven.judged is not None:
        console.print(f"  Judged by the first {driven.judged:g} s of the measurement", soft_wrap=True)
    if driven.corridor:
        leaves = driven.leaves
        console.print(
            f"  Further off than {driven.corridor:g} m: {driven.left} of {counted(count, 'run')} (95 %: "
            f"{leaves.low:.3g} to "
            f"{leaves.high:.3g} of them)",
            soft_wrap=True,
        )


def rows(found: LinkFigures) -> Iterator[tuple[str, ...]]:
    """Name and value for each direction, as text; a dash where the file does not tell."""
    directions = list(found.directions.values())
    yield "Packets", *(str(direction.count) for direction in directions)
    yield "Loss rate (95 %)", *map(_rate, directions)
    yield "Outages", *(str(len(direction.outages)) if direction.is_told else "-" for direction in directions)
    yield "Longest outage", *(_ms(direction.longest) if direction.is_told else "-" for direction in directions)
    for title, part in (("Age", "age"), ("Delay", "delay"), ("Jitter", "jitter")):
        spreads = [getattr(direction, part) for direction in directions]
        if any(spread is not None for spread in spreads):
            yield f"{title} p50, p95, p99, max", *map(_spread, spreads)


def _rate(direction: DirectionFigures) -> str:
    rate = direction.loss_rate
    if rate is None:
        return "-"
    return f"{_percent(rate.value)} ({_percent(rate.low)} to {_percent(rate.high)})"


def _percent(rate: float) -> str:
    return f"{100.0 * rate:.3g} %"


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.4g} ms"


def _spread(spread: Spread | None) -> str:
    if spread is None:
        return "-"
    return ", ".join(f"{1e3 * value:.4g}" for value in (*spread.percentiles, spread.largest)) + " ms"


def sentences(found: LinkFigures) -> Iterator[str]:
    """What is said below the table: the fit, changes, what was not seen."""
    direction = found.fitted
    fit, measured = direction.fit, found.measured
    name = direction.name.replace("_", " ")
    if fit.model == "gilbert_elliott" and fit.p is not None and fit.r is not None:
        p, r = fit.transitions.estimate
        said = f"gilbert_elliott, p {p:.4g}, r {r:.4g} a packet: {fit.mean_burst:.3g} lost in a row on average"
    else:
        said = "perfect" if fit.model == "perfect" else f"bernoulli, p {fit.loss_rate.value:.4g} a packet"
    goodness = fit.goodness.p_value
    fits = "too little was lost to test it" if goodness is None else (
        f"which describes the losses (p-value {goodness:.3g})" if fit.goodness.fits
        else f"which does not describe the losses (p-value {goodness:.3g}): judge by the trace"
    )  # fmt: skip
    yield f"Fitted to the {name}: {said}, {fits}."
    times = found.change_times
    if times:
        yield f"The link changed at {', '.join(f'{time:.4g} s' for time in times)}."
    elif found.stationarity.p_value is None:
        yield "Too short for its outages to say whether the link changed."
    else:
        yield f"The link did not change while it was measured (p-value {found.stationarity.p_value:.3g})."
    if measured.duplicates or measured.reordered:
        yield (
            f"{counted(measured.duplicates, 'packet')} came twice, {measured.reordered} after one that was sent later."
        )
    if measured.interval > 0.0:
        yield f"Outages shorter than {_ms(measured.interval)} between two packets were not seen."
