"""`agv-ncs watch`: a page beside a running loop."""

from __future__ import annotations

import os
from pathlib import Path

import click

from agv_analysis.commands import needs_ros


@click.command("watch", short_help="Watch a running loop in the browser.")
@click.option("--namespace", default="", help="Which loop, of several; a fleet's are agv_01, agv_02, ...")
@click.option("--config", type=click.Path(path_type=Path), help="The loop's params file; else its nodes are asked.")
@click.option("--plant-domain", type=click.IntRange(0, 232), help="DDS domain of the AGV, if not the usual one.")
@click.option("--edge-domain", type=click.IntRange(0, 232), help="DDS domain of the edge, likewise.")
@click.option("--save-to", type=click.Path(path_type=Path), default=Path("bags"), show_default=True,
              help="Where bags go that the page saves.")  # fmt: skip
@click.option("--host", default="127.0.0.1", show_default=True, help="Address of this machine to serve the page on.")
@click.option("--port", type=click.IntRange(0, 65535), default=8051, show_default=True, help="0: any free one.")
@click.option("--foxglove", is_flag=True,
              help="Serve the topics to Foxglove and Lichtblick as well, to programs on this machine.")  # fmt: skip
@click.option(
    "--foxglove-port", type=click.IntRange(0, 65535), default=8765, show_default=True, help="0: any free one."
)
@click.option("--no-browser", is_flag=True, help="Only print the address of the page.")
def command(
    namespace: str, config: Path | None, plant_domain: int | None, edge_domain: int | None, save_to: Path, host: str,
    port: int, foxglove: bool, foxglove_port: int, no_browser: bool,
) -> None:  # fmt: skip
    """Watch a running loop in the browser: track, deviation, speed, losses, and what they say of it. Ctrl-C stops it.

    It only listens, with best effort: the loop neither waits for it nor notices it. Sliders and buttons set
    parameters of the nodes.

    \b
    Examples:
      agv-ncs watch
      agv-ncs watch --namespace agv_03
      agv-ncs watch --foxglove
      agv-ncs watch --host 192.168.1.20 --port 8051 --no-browser
    """
    with needs_ros():
        from agv_analysis.watch.watching import watch
    from agv_analysis.watch.beside_run import OF_RUN, SERVED, STOP
    from agv_ros.discovery import discovery_note

    of_run = OF_RUN in os.environ
    if not of_run:
        click.echo(discovery_note(), err=True)

    def ready(address: str, to_foxglove: str) -> None:
        if to_foxglove:
            click.echo(f"Foxglove: {to_foxglove} (layout: config/foxglove.json)")
        click.echo(f"{SERVED}{address}" + ("" if of_run else " (Ctrl-C stops it)"))
        if not no_browser:
            import webbrowser

            webbrowser.open(address)

    domains = tuple(-1 if domain is None else domain for domain in (plant_domain, edge_domain))
    stop = (lambda: click.echo(STOP)) if of_run else None
    watch(
        namespace,
        config,
        (domains[0], domains[1]),
        save_to,
        (host, port),
        ready,
        stop,
        foxglove_port if foxglove else None,
    )
