"""`agv-ncs channel`: what a channel does to its messages."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from agv_analysis.commands import OUTPUT, with_force, with_settings, write_json
from agv_ros.counted import counted

if TYPE_CHECKING:
    from agv_analysis.link.channel_study import ChannelStudy


@click.command("channel", short_help="Show what a channel does to its messages, beside theory.")
@with_settings
@click.option("--link", type=click.Choice(["uplink", "downlink"]), default="uplink", help="Whose channel.")
@click.option(
    "--slots", type=click.IntRange(1, 10_000_000), default=100_000, show_default=True, help="Number of slots."
)
@click.option("--fit", metavar="TRACE", help="Use the model that fits this trace, instead of the file's channel.")
@click.option(
    "--from-netem", metavar="LINE", help='Use netem\'s channel, as in "delay 20ms loss 5% 25%", or a pasted tc line.'
)
@click.option("--netem", is_flag=True, help="Print the channel as an option of `tc qdisc ... netem`, and nothing else.")
@click.option("--json", "json_file", type=OUTPUT, help="Write the figures to this file, too.")
@click.option("--csv", "csv_file", type=OUTPUT, help="Write the distribution of n_ul to this file.")
@click.option("--picture", type=OUTPUT, help="Draw the channel to this file.")
@with_force
def command(
    params: str,
    settings: tuple[str, ...],
    link: str,
    slots: int,
    fit: str | None,
    from_netem: str | None,
    netem: bool,
    json_file: Path | None,
    csv_file: Path | None,
    picture: Path | None,
) -> None:
    """Show what a channel of the params file PARAMS does to its messages, beside theory.

    The slots are those that a run with the file's seed meets; where it matters, with the AGV on its reference.

    \b
    Examples:
      agv-ncs channel config/outages.yaml --picture channel.png
      agv-ncs channel config/outages.yaml --set relay.uplink.r=0.05 --netem
      agv-ncs channel config/outages.yaml --fit outages.csv
    """
    from rich.console import Console
    from rich.table import Table

    from agv_analysis.link.channel_files import draw, write_csv
    from agv_analysis.link.channel_study import fitted, study
    from agv_analysis.link.netem import to_netem
    from agv_analysis.link.netem_text import read_netem
    from agv_analysis.scenario import load_scenario
    from agv_analysis.simulation.reference import reference_of
    from agv_plant.channels.timed_trace import read_trace
    from agv_ros.errors import UserError

    scenario = load_scenario(params, settings)
    relay = scenario.relay
    channel = relay.downlink if link == "downlink" else relay.uplink
    if fit is not None and from_netem is not None:
        raise UserError("--fit and --from-netem both name a channel: give one of them")
    if fit is not None:
        channel = fitted(read_trace(fit, link).lost, channel)
    if from_netem is not None:
        channel, differences = read_netem(from_netem, channel)
        for sentence in differences:
            click.echo(f"not the same: {sentence}", err=True)
    if netem:
        click.echo(to_netem(channel))
        return
    places = reference_of(scenario.error_detector, slots)[:, :2] if channel.is_placed else None
    found = study(channel, relay.seed, link, slots, relay.ts, places)
    table = Table(box=None, pad_edge=False)
    for column in ("", "these slots", "closed form"):
        table.add_column(column, style=None if column else "bold")
    for row in rows(found):
        table.add_row(*row)
    console = Console(highlight=False)
    console.print(
        f"[bold]{link}[/]: {setting(found)}, {counted(slots, 'slot')} of {1e3 * relay.ts:g} ms, seed {relay.seed}",
        soft_wrap=True,
    )
    console.print(table)
    if csv_file is not None:
        write_csv(csv_file, found)
        click.echo(f"csv:     {csv_file}")
    if picture is not None:
        draw(picture, found)
        click.echo(f"picture: {picture}")
    if json_file is not None:
        write_json(json_file, found.to_json())


_SHOWN = {
    "bernoulli": ("p",), "gilbert_elliott": ("p", "r", "h", "k"), "burst": ("n", "start_step"),
    "trace": ("trace_file", "trace_end"), "coverage_hole": ("p", "hole_loss", "hole_circles", "hole_polygons"),
    "rayleigh": ("carrier", "margin"),
}  # fmt: skip
"""The parameters that say what a model does."""

_ON_TOP = ("delay", "jitter", "duplicate", "schedule", "reliable")
"""Those that say what comes on top of it, unless they are empty."""

_AGES = (1, 2, 5, 10, 20, 50, 100)
"""The ages whose probability is printed; --csv writes all."""


def setting(found: ChannelStudy) -> str:
    """Model and parameters as text, as in `bernoulli, p 0.3`."""
    changed = [name for name in _ON_TOP if getattr(found.channel, name)]
    shown = (*_SHOWN.get(found.channel.model, ()), *changed)
    return ", ".join([found.channel.model, *(f"{name} {getattr(found.channel, name)}" for name in shown)])


def rows(found: ChannelStudy) -> Iterator[tuple[str, str, str]]:
    """Name, measured and expected value, as text; the last is a dash where nothing is known."""
    outages, theory = found.outages, found.expected

    def pair(name: str, measured: float, expected: float | None, unit: str) -> tuple[str, str, str]:
        return name, f"{measured:.5g}{unit}", "-" if expected is None else f"{expected:.5g}{unit}"

    yield pair("Loss rate", outages.loss_rate, theory.loss_rate, "")
    yield pair("Mean outage", outages.mean_burst, theory.mean_burst, " slots")
    yield "Longest outage", counted(outages.longest, "slot"), "-"
    yield pair("Mean n_ul", outages.age.mean, theory.mean_age, " slots")
    if found.channel.delays:
        yield pair("Late", found.late, None, " of what is not lost")
    measured, expected = found.age_shares, found.expected_age_shares
    for n in _AGES:
        if n < len(measured):
            share = None if expected is None else 1.0 - float(expected[:n].sum())
            yield pair(f"P(n_ul >= {n})", float(measured[n:].sum()), share, "")
