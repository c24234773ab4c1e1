"""`agv-ncs probe`: measure a link from both ends with packets like the loop's own."""

from __future__ import annotations

import math
from pathlib import Path

import click

from agv_analysis.commands import OUTPUT, with_force
from agv_analysis.output_file import output_file
from agv_ros.counted import counted


@click.command("probe", short_help="Measure the link to another host.")
@click.argument("host", required=False)
@click.option("--listen", is_flag=True, help="Be the edge's end: answer one peer after another.")
@click.option("--port", type=click.IntRange(1, 65535), default=47474, show_default=True, help="Of the edge's end, UDP.")
@click.option("--peer", help="With --listen: answer this address alone.")
@click.option("--params", type=click.Path(), help="Take the interval from this params file.")
@click.option("--interval", type=click.FloatRange(0.0005, 60.0), help="Time between packets [s], 0.005 by default.")
@click.option(
    "--duration", type=click.FloatRange(0.001, 36000.0), default=10.0, show_default=True, help="How long [s]."
)
@click.option("--seconds", type=click.FloatRange(0.1, 864000.0), default=3600.0, help="With --listen: for how long.")
@click.option("--size", type=click.IntRange(1, 1400), help="Bytes of a packet; that of a pose by default.")
@click.option("--trace", type=OUTPUT, default=Path("link.csv"), show_default=True, help="To where.")
@with_force
def command(
    host: str | None, listen: bool, port: int, peer: str | None, params: str | None, interval: float | None,
    duration: float, seconds: float, size: int | None, trace: Path,
) -> None:  # fmt: skip
    """Measure the link to HOST, where `agv-ncs probe --listen` runs; the trace is what `agv-ncs link` reads.

    The packets are as long as a pose and a command on their way, each way numbered and stamped; no ROS is needed.

    \b
    Examples:
      agv-ncs probe --listen                                  # at the edge
      agv-ncs probe edge.local --duration 60 --trace link.csv # on the AGV
      agv-ncs link link.csv config/outages.yaml
    """
    from agv_analysis.link import link_probe

    if listen == (host is not None):
        raise click.UsageError("give either --listen or the HOST that listens")
    try:
        if listen:
            answered, refused = link_probe.listen(port, peer=peer, seconds=seconds, ready=_say_ready)
            click.echo(f"{counted(answered, 'packet')} answered, {refused} refused")
            return
        assert host is not None
        _measure(host, port, _interval(params, interval), duration, size, trace)
    except link_probe.ProbeError as error:
        raise click.ClickException(str(error)) from None
    except KeyboardInterrupt:
        if not listen:
            raise click.ClickException("stopped: nothing was written") from None


def _say_ready(port: int) -> None:
    click.echo(f"listening on UDP port {port}")


def _interval(params: str | None, interval: float | None) -> float:
    if interval is not None or params is None:
        return interval or 0.005
    from agv_analysis.scenario import load_scenario

    return load_scenario(params).plant.ts


def _measure(host: str, port: int, interval: float, duration: float, size: int | None, trace: Path) -> None:
    from agv_analysis.commands.progress import step_bar
    from agv_analysis.link import link_probe
    from agv_ros.codec import encode_command, encode_pose
    from agv_ros.messages import Command, StampedPose

    pose, command = encode_pose(StampedPose(1, 0.0, 0.0, 0.0)), encode_command(Command(1, 0.0, 0.0))
    count = max(1, math.floor(duration / interval + 1e-9))
    with step_bar(count, "measuring") as progress:
        found = link_probe.measure(
            host, port, count, interval, size or len(pose), min(size or len(command), len(command)), progress
        )
    try:
        output_file(trace).write_text("\n".join(link_probe.rows_of(found)) + "\n", encoding="utf-8")
    except OSError as error:
        raise click.ClickException(f"{trace}: cannot be written: {error.strerror}") from None
    up = sum(arrived is None for arrived in found.arrived)
    back = sum(returned is None for returned in found.returned)
    said = f"{up} lost on the way up, {back - up} on the way down" if found.is_listed else f"{back} without an answer"
    click.echo(f"{counted(count, 'packet')}, {said}")
    for note in found.notes:
        click.echo(f"note: {note}")
    click.echo(f"trace: {trace}; see agv-ncs link {trace}")
