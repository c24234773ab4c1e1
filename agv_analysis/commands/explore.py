"""`agv-ncs explore`: a page on this machine on which settings are moved."""

from __future__ import annotations

import click

from agv_analysis.commands import corridor_settings, with_settings


@click.command("explore", short_help="Move sliders in the browser; each move simulates the lap.")
@with_settings
@click.option(
    "--corridor", "corridor_width", type=click.FloatRange(min=0.0, min_open=True), metavar="D",
    help="Say, too, which outages keep the AGV within D [m] of its reference.",
)  # fmt: skip
@click.option("--port", type=click.IntRange(0, 65535), default=8050, show_default=True, help="0: any free one.")
@click.option("--no-browser", is_flag=True, help="Only print the address of the page.")
def command(
    params: str, settings: tuple[str, ...], corridor_width: float | None, port: int, no_browser: bool
) -> None:  # fmt: skip
    """Explore the params file PARAMS in the browser: every move of a slider simulates the lap again. Ctrl-C stops it.

    \b
    Examples:
      agv-ncs explore config/paper.yaml
      agv-ncs explore config/outages.yaml --corridor 0.25
      agv-ncs explore config/outages.yaml --set controller.v_max=6.0 --port 9000 --no-browser
    """
    from agv_analysis.explore.app import serve
    from agv_analysis.scenario import load_scenario

    def ready(address: str) -> None:
        click.echo(f"explore: {address} (Ctrl-C stops it)")
        if not no_browser:
            import webbrowser

            webbrowser.open(address)

    serve(load_scenario(params, (*settings, *corridor_settings(corridor_width, None))), port, ready)
