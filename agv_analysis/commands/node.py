"""`agv-ncs node`: one node of the loop, where there is no `ros2 run`."""

from __future__ import annotations

import click

from agv_analysis.commands import needs_ros
from agv_analysis.runtime.executables import NODE_MODULES, run_node_of


@click.command(
    "node",
    short_help="Run one node, as `ros2 run` does.",
    context_settings={"ignore_unknown_options": True, "allow_interspersed_args": False},
)
@click.argument("name", type=click.Choice(list(NODE_MODULES)), metavar="NAME")
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def command(name: str, arguments: tuple[str, ...]) -> None:
    """Run the node NAME with ARGUMENTS, as `ros2 run` does.

    NAME: plant, relay, error_detector, controller, recorder or link_emulator.

    \b
    Examples:
      agv-ncs node relay --ros-args --params-file config/outages.yaml
      agv-ncs node link_emulator --ros-args -p uplink.topics:='[/scan]' -p uplink.model:=bernoulli -p uplink.p:=0.1
      agv-ncs node recorder --ros-args -p bag:=bags/first -p params_file:=config/outages.yaml
    """
    with needs_ros():
        run_node_of(name, arguments)
