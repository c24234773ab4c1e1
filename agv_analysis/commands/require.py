"""`agv-ncs require`: what a loop asks of its radio, and whether a link gives it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from agv_analysis.commands import OUTPUT, corridor_settings, with_force, with_settings, write_json
from agv_analysis.commands.link_file import FileOptions, read_link_file, refuse_without_file, with_link_file
from agv_analysis.output_file import MARKDOWN_MARK, output_file

if TYPE_CHECKING:
    from agv_analysis.requirements.link_availability import LinkAvailability
    from agv_analysis.requirements.loop_requirements import LoopRequirements
    from agv_analysis.requirements.offered_service import OfferedService
    from agv_analysis.requirements.service_classes import ServiceClass
    from agv_analysis.scenario import Scenario


@click.command("require", short_help="List what the loop asks of its radio.")
@with_settings
@click.option("--corridor", type=click.FloatRange(min=0.0, min_open=True), help="Stay within so much [m] as well.")
@click.option("--corridor-along", type=click.FloatRange(min=0.0, min_open=True), help="So much [m] along the track.")
@click.option("--link", "file", type=click.Path(path_type=Path), help="A measured link, as `agv-ncs link` reads it.")
@with_link_file
@click.option("--class", "name", help="A class of service: is it met, would it do, and what does the loop do on it?")
@click.option("--classes", "files", multiple=True, type=click.Path(path_type=Path), help="A file with more classes.")
@click.option(
    "--availability",
    type=click.FloatRange(0.0, 1.0, min_open=True, max_open=True),
    help="Offered, and asked of the link.",
)
@click.option("--mtbf", type=click.FloatRange(min=0.0, min_open=True), help="Mean time between failures [s], likewise.")
@click.option("--survival-time", type=click.FloatRange(min=0.0), help="Offered [s], by default that of the loop.")
@click.option("--transfer-interval", type=click.FloatRange(min=0.0, min_open=True), help="Offered with it [s].")
@click.option("--latency", type=click.FloatRange(min=0.0), help="Offered with it [s].")
@click.option("--table", type=OUTPUT, help="Write tables in Markdown to this file.")
@click.option("--report", type=OUTPUT, help="Write a page for the browser to this file.")
@click.option("--json", "json_file", type=OUTPUT, help="Write the figures to this file, too.")
@with_force
def command(
    params: str, settings: tuple[str, ...], corridor: float | None, corridor_along: float | None, file: Path | None,
    name: str | None, files: tuple[Path, ...], availability: float | None, mtbf: float | None,
    survival_time: float | None, transfer_interval: float | None, latency: float | None, table: Path | None,
    report: Path | None, json_file: Path | None, **of_file: Any,
) -> None:  # fmt: skip
    """Say what the loop of the params file PARAMS asks of its radio, in the words of those who plan radios.

    Then what its uplink gives, or the measured link of --link, and which classes of service would do. With a --class,
    an --availability, a --mtbf or a --survival-time the inverse, too: does the loop hold on such a service, how fast
    may it go, with which gains and sampling period, and which corridor does it keep?

    \b
    Examples:
      agv-ncs require config/outages.yaml --table requirements.md
      agv-ncs require config/outages.yaml --link ping.txt --availability 0.999999
      agv-ncs require config/outages.yaml --corridor 0.25 --class "mobile operation panel, emergency stop"
      agv-ncs require config/outages.yaml --availability 0.9999 --mtbf 3600 --survival-time 0.05
    """
    from rich.console import Console

    from agv_analysis.requirements.class_check import meets, would_do
    from agv_analysis.requirements.loop_requirements import require
    from agv_analysis.requirements.requirement_table import (
        markdown,
        rows_of_classes,
        rows_of_link,
        rows_of_loop,
    )
    from agv_analysis.requirements.service_classes import find_class, load_classes
    from agv_analysis.scenario import load_scenario
    from agv_ros.errors import UserError

    is_offered = name is not None or not availability is mtbf is survival_time is None
    if transfer_interval is not None and not is_offered:
        raise UserError(
            "--transfer-interval is offered with a --survival-time, --availability, --mtbf or --class: give one"
        )
    if file is None:
        refuse_without_file(FileOptions(**of_file))
    scenario = load_scenario(params, (*settings, *corridor_settings(corridor, corridor_along)))
    classes = load_classes(*files)
    if name is not None:
        classes = (find_class(name, classes),)
    asked = () if name is None else classes
    if availability is not None or mtbf is not None:
        asked = (*asked, _asked(availability, mtbf))
        classes = (*classes, asked[-1])
    console = Console(highlight=False)
    with Console(stderr=True).status("computing what the loop asks ..."):
        loop = require(scenario)
    link = _link_of(scenario, loop, file, FileOptions(**of_file))  # which may have a progress bar of its own
    enough = {one.name: would_do(one, loop) for one in classes}
    met = {one.name: meets(one, link) for one in classes}
    sections: dict[str, list[tuple[str, ...]]] = {"What the loop asks of its radio": list(rows_of_loop(loop))}
    if link is not None:
        sections["What the link gives it"] = list(rows_of_link(link))
    content: dict[str, Any] = {
        **loop.to_json(),
        **(dict.fromkeys(("availability", "unavailability", "mtbf_s")) if link is None else link.to_json()),
        "meets": {one: answer for one, (answer, _) in met.items()},
        "meets_reason": {one: why for one, (_, why) in met.items()},
        "would_do": {one: answer for one, (answer, _) in enough.items()},
        "would_do_reason": {one: why for one, (_, why) in enough.items()},
        "classes": {one.name: one.source for one in classes},
    }
    if is_offered:
        given = _offered(loop, asked, survival_time, latency, transfer_interval)
        with Console(stderr=True).status("asking what the loop does on the service ..."):
            sections["On the offered service"], content["offered"] = _on_service(scenario, given)
    sections[_CLASSES] = list(rows_of_classes(classes, enough, met))
    _print(console, params, sections, loop)
    if table is not None:
        _write(table, markdown(sections, _HEADS))
        console.print(f"table:   {table}")
    if report is not None:
        from agv_analysis.report.requirements_page import write_requirements

        write_requirements(report, scenario, loop, sections, _HEADS, content)
        console.print(f"report:  {report}")
    if json_file is not None:
        write_json(json_file, content)


_CLASSES = "Classes of service"
_HEAD = ("class", "source", "would it do for the loop?", "does the link meet it?")
_HEADS: dict[str, tuple[str, ...]] = {_CLASSES: _HEAD}
"""Heads of the tables that have one."""


def _asked(availability: float | None, mtbf: float | None) -> ServiceClass:
    """What the command line asks of the link, as a class."""
    from agv_analysis.requirements.service_classes import SERVICE, ServiceClass

    return ServiceClass(
        "as asked", SERVICE, "own figures", "not recorded", "not recorded", True, availability=availability, mtbf_s=mtbf
    )


def _link_of(
    scenario: Scenario, loop: LoopRequirements, file: Path | None, of_file: FileOptions
) -> LinkAvailability | None:
    """What the measured link gives, or the scenario's uplink; None where nothing is known of it, or of the loop."""
    from agv_analysis.link.link_figures import LinkFigures
    from agv_analysis.link.markov_channel import chain_of
    from agv_analysis.link.measured_trace import of_trace
    from agv_analysis.link.measurement import LossRates, Measurement
    from agv_analysis.requirements.link_availability import of_channel, of_measurement
    from agv_ros.errors import UserError

    slots = loop.survival_slots
    uplink = scenario.relay.uplink
    if file is not None:
        reading = read_link_file(file, of_file)
        if isinstance(reading, LossRates):
            raise UserError(reading.refusal)
        if isinstance(reading, Measurement):
            survival = loop.survival_time
            return None if survival is None or survival < 0.0 else of_measurement(LinkFigures(reading), survival)
        uplink = reading.channel
    if uplink.model == "trace" and loop.survival_time is not None and loop.survival_time >= 0.0:
        figures = LinkFigures(of_trace(uplink.trace_file, "uplink", scenario.plant.ts))
        return of_measurement(figures, loop.survival_time)
    chain = chain_of(uplink)
    if slots is None or slots < 0 or chain is None:
        return None
    found = of_channel(chain, slots, scenario.plant.ts, uplink.delay + uplink.jitter)
    return found if file is None else replace(found, assumption="the link is the channel of the line for netem")


def _offered(
    loop: LoopRequirements, classes: tuple[ServiceClass, ...], survival_time: float | None, latency: float | None,
    transfer_interval: float | None,
) -> OfferedService | str:  # fmt: skip
    """What is offered: by the command line, where that is silent by the class named, and at last by what the loop asks.

    Or why nothing can be said of it.
    """
    from agv_analysis.requirements.offered_service import OfferedService

    def stated(figure: str) -> float | None:
        return next((value for one in reversed(classes) if (value := getattr(one, figure)) is not None), None)

    time = stated("survival_time_s") if survival_time is None else survival_time
    if time is None:
        time = 0.0 if loop.survival_slots is not None and loop.survival_slots < 0 else loop.survival_time
    if time is None:
        return f"nothing is to be asked: {loop.reasons.get('survival_time_s') or loop.infeasible}"
    late = stated("latency_s") if latency is None else latency
    period = stated("transfer_interval_s") if transfer_interval is None else transfer_interval
    return OfferedService(time, late or 0.0, period, stated("availability"), stated("mtbf_s"), stated("largest_loss"))


def _on_service(
    scenario: Scenario, offered: OfferedService | str
) -> tuple[list[tuple[str, ...]], dict[str, Any] | None]:
    from agv_analysis.requirements.offered_service import on_service
    from agv_analysis.requirements.requirement_table import rows_of_service

    if isinstance(offered, str):
        return [("Does the loop hold?", offered)], None
    found = on_service(scenario, offered)
    return list(rows_of_service(found)), found.to_json()


def _print(
    console: Any, params: str, sections: dict[str, list[tuple[str, ...]]], loop: LoopRequirements
) -> None:  # fmt: skip
    from rich.markup import escape
    from rich.table import Table

    for title, rows in sections.items():
        console.print(f"[bold]{title}[/]" + (f" ({escape(params)})" if title.startswith("What the loop") else ""))
        table = Table(box=None, show_header=len(rows[0]) > 2, pad_edge=False)
        for column in _HEAD if len(rows[0]) > 2 else ("", ""):
            table.add_column(column, style=None)
        for row in rows:
            table.add_row(*map(escape, row))
        console.print(table)
        console.print()
    for line in loop.netem():
        console.print(f"For netem, at the border: {line}", soft_wrap=True)


def _write(path: Path, text: str) -> None:
    try:
        output_file(path).write_text(text + MARKDOWN_MARK, encoding="utf-8")
    except OSError as error:
        raise click.ClickException(f"{path}: cannot be written: {error.strerror}") from None
