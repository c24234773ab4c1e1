"""`agv-ncs bag`: what is in a recording, what is wrong with it, and export and recovery."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from agv_analysis.commands import OUTPUT, with_force, write_json
from agv_ros.counted import counted

if TYPE_CHECKING:
    from agv_analysis.bags import Bag

_LONG = 2**28
"""Bags of more bytes than this are read under a progress bar."""


@click.group("bag", short_help="Inspect, export or recover recordings.")
def command() -> None:
    """Inspect a recording, export it, or recover the intact messages of a damaged one.

    A BAG is a rosbag2 directory or a bare .mcap or .db3 file, compressed or not.
    """


_DEFINITIONS = click.option(
    "--definitions", type=click.Path(path_type=Path, exists=True, file_okay=False), metavar="DIR",
    help="Folder with the .msg, .idl or .srv files of types that BAG does not define, as a workspace's share or src.",
)  # fmt: skip


@command.command("info", short_help="Show what a recording contains, and what is wrong with it.")
@click.argument("bag", type=click.Path(path_type=Path))
@_DEFINITIONS
@click.option("--json", "json_file", type=OUTPUT, help="Write what is printed to this file, too.")
@with_force
def info(bag: Path, definitions: Path | None, json_file: Path | None) -> None:
    """Show what BAG holds, and everything that is wrong with it.

    Reads and decodes every message. The exit status is 1 only if nothing can be read.

    \b
    Examples:
      agv-ncs bag info bags/first
      agv-ncs bag info someone_elses.mcap --json info.json
      agv-ncs bag info custom_types --definitions ~/ws/install
    """
    from agv_analysis.bags import read_bag
    from agv_analysis.bags.bag_summary import describe
    from agv_ros.printable import printable

    with _bar(bag, "reading") as progress:
        content = read_bag(bag, progress=progress, definitions=definitions)
    summary = describe(content)
    for line in summary.lines():
        click.echo(printable(line))
    if json_file is not None:
        write_json(json_file, summary.to_json())


@command.command("export", short_help="Write the messages as tables for other programs.")
@click.argument("bag", type=click.Path(path_type=Path))
@click.option("--csv", "form", flag_value="csv", help="One CSV file for each topic, in the directory OUT.")
@click.option("--parquet", "form", flag_value="parquet", help="One Parquet file for each topic, in the directory OUT.")
@click.option("--npz", "form", flag_value="npz", help="One file OUT of numpy arrays.")
@click.option("--tum", "form", flag_value="tum", help="One TUM trajectory for each topic with poses, as for evo.")
@click.option("--topic", "topics", multiple=True, help="Only this topic. May be repeated.")
@_DEFINITIONS
@click.option("--out", "-o", type=click.Path(path_type=Path), help="Where to; by default beside BAG.")
def export(bag: Path, form: str | None, topics: tuple[str, ...], definitions: Path | None, out: Path | None) -> None:
    """Write the messages of BAG for other programs: one row a message, one column a value.

    \b
    Examples:
      agv-ncs bag export bags/first --csv --topic /agv/pose
      agv-ncs bag export bags/first --npz --out first.npz
      agv-ncs bag export bags/first --tum --topic /agv/pose --out trajectories
    """
    from agv_analysis.bags.export import EXPORTS

    if form is None:
        raise click.UsageError(f"choose a format: {', '.join(f'--{name}' for name in EXPORTS)}")
    content = _read(bag, topics, definitions)
    where = out or bag.with_name(f"{bag.name}_{form}" if form != "npz" else f"{bag.name}.npz")
    for path in EXPORTS[form](content, where):
        click.echo(path)
    _warn(content.problems, content.is_complete)


def _read(bag: Path, topics: tuple[str, ...], definitions: Path | None) -> Bag:
    """The topics that are asked for, each of which must be there and decodable; all that are, if none is."""
    from agv_analysis.bags import read_bag

    with _bar(bag, "reading") as progress:
        content = read_bag(bag, topics or None, progress, definitions)
    for topic in topics:
        content[topic]
    return content


@command.command("recover", short_help="Write every intact message to a clean bag.")
@click.argument("bag", type=click.Path(path_type=Path))
@click.argument("out", type=click.Path(path_type=Path))
@_DEFINITIONS
def recover(bag: Path, out: Path, definitions: Path | None) -> None:
    """Write every intact message of BAG to a clean bag OUT, and report what is missing.

    OUT becomes an MCAP file if its name ends in .mcap, else a rosbag2 directory.

    \b
    Example:
      agv-ncs bag recover bags/interrupted bags/recovered
    """
    from agv_analysis.bags.recover import recover as recover_bag
    from agv_ros.printable import printable

    with _bar(bag, "copying") as progress:
        recovery = recover_bag(bag, out, progress, definitions)
    for topic, count in recovery.counts.items():
        click.echo(f"{printable(topic)}: {counted(count, 'message')}")
    click.echo(f"{out}: {counted(sum(recovery.counts.values()), 'message')}")
    _warn(recovery.problems, recovery.is_complete)


@command.command("outages", short_help="Show which messages of a periodic topic are missing.")
@click.argument("bag", type=click.Path(path_type=Path))
@click.option("--topic", required=True, help="Whose messages: of any type with a header, or of any other.")
@click.option("--period", type=click.FloatRange(min=0.0, min_open=True), help="Time between messages sent [s].")
@_DEFINITIONS
@click.option("--trace", type=OUTPUT, help="Write a file for the channel trace, with times.")
@click.option("--picture", type=OUTPUT, help="Draw the outages to this file.")
@click.option("--json", "json_file", type=OUTPUT, help="Write the figures to this file, too.")
@with_force
def outages(
    bag: Path, topic: str, period: float | None, definitions: Path | None, trace: Path | None, picture: Path | None,
    json_file: Path | None,
) -> None:  # fmt: skip
    """Show which messages of a periodic topic of BAG are missing: losses, outages, ages, delays, a fitted channel.

    The stamps in the messages' headers say which are missing; where there are none, or the type cannot be decoded, the
    log times do. Without --period it is what most messages are apart.

    \b
    Examples:
      agv-ncs bag outages someone_elses.mcap --topic /odom
      agv-ncs bag outages drive.db3 --topic /scan --period 0.1 --trace scan.csv
    """
    from rich.console import Console

    from agv_analysis.bags import BagError, read_bag
    from agv_analysis.commands.link import show_measurement
    from agv_analysis.link.formats.bag_topic import measure_topic

    names = (topic, f"/{topic.strip('/')}")
    with _bar(bag, "reading") as progress:
        content = read_bag(bag, names, progress, definitions)
    name = next((name for name in names if name in content.topics), None)
    if name is None:
        raise BagError(f"{bag}: no topic {topic}; it has {', '.join(content.topics) or 'none'}")
    measured = measure_topic(content, name, period)
    found = show_measurement(Console(highlight=False), measured, None, "half", trace, picture)
    if json_file is not None:
        write_json(json_file, found)
    _warn(content.problems, content.is_complete)


def _warn(problems: tuple[str, ...], is_complete: bool) -> None:
    for problem in problems:
        click.echo(problem, err=True)
    if not is_complete:
        click.echo("the recording is not complete", err=True)


@contextlib.contextmanager
def _bar(bag: Path, what: str) -> Iterator[Callable[[int], None] | None]:
    """A progress bar in percent for bags that take long."""
    from agv_analysis.commands.progress import step_bar

    files = [bag] if bag.is_file() else [file for file in bag.glob("*") if file.is_file()]
    if sum(file.stat().st_size for file in files) < _LONG:
        yield None
        return
    with step_bar(100, what) as progress:
        yield progress
