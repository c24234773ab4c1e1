"""The commands of `agv-ncs`, one module each; here is what they share."""

from __future__ import annotations

import importlib.util
import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from agv_analysis.output_file import FORCE, JSON_MARK, output_file

if TYPE_CHECKING:
    from agv_analysis.corridor.corridor_of_run import CorridorOfRun
    from agv_analysis.scenario import Scenario
    from agv_analysis.stability.analysis import Observations

F = TypeVar("F", bound=Callable[..., Any])


def with_settings(command: F) -> F:
    """The argument PARAMS and the option --set of commands that take a scenario."""
    command = click.option(
        "--set", "settings", multiple=True, metavar="NODE.PARAMETER=VALUE",
        help="Change a parameter of the file, as in --set relay.uplink.p=0.05. May be repeated.",
    )(command)  # fmt: skip
    return click.argument("params", type=click.Path())(command)


def with_corridor(command: F) -> F:
    """The options of commands that say what a loop does within a corridor."""
    command = click.option(
        "--laps", type=click.IntRange(1), help="How many laps are simulated for that; by default some hundred."
    )(command)
    command = click.option(
        "--corridor-along", type=click.FloatRange(min=0.0, min_open=True), metavar="D",
        help="Allow so much [m] along the track; --corridor is then the half-width across it.",
    )(command)  # fmt: skip
    return click.option(
        "--corridor", "corridor_width", type=click.FloatRange(min=0.0, min_open=True), metavar="D",
        help="Say which outages keep the AGV within D [m] of its reference, and how often it leaves that corridor; in "
        "the params file: error_detector.corridor.",
    )(command)  # fmt: skip


def corridor_settings(width: float | None, along: float | None) -> tuple[str, ...]:
    """The options of `with_corridor` as settings of a scenario."""
    named = (("corridor", width), ("corridor_along", along))
    return tuple(f"error_detector.{name}={value!r}" for name, value in named if value is not None)


def print_corridor(
    analysis: Observations, scenario: Scenario, is_known: bool, laps: int | None
) -> CorridorOfRun | None:
    """Print what a run and its scenario say of the corridor, if there is one; returns it.

    `is_known`: the channel is the scenario's, else it is the one that fits the run.
    """
    from rich.console import Console
    from rich.markup import escape

    from agv_analysis.corridor.corridor_of_run import corridor_of_run
    from agv_analysis.report.table import print_groups

    with Console(stderr=True).status("within the corridor ...") as status:
        found = corridor_of_run(
            analysis, scenario, is_known, laps, lambda what: status.update(f"within the corridor: {what} ...")
        )
    if found is None:
        return None
    console = Console(highlight=False)
    print_groups(console, [("Corridor", [(name, escape(value)) for name, value in found.rows()])])
    for note in found.notes:
        console.print(f"[bold yellow]Corridor:[/] {escape(note)}.")
    return found


def corridor_json(within: CorridorOfRun | None) -> dict[str, Any]:
    """What `print_corridor` has found, for --json."""
    return {} if within is None else {"corridor": within.to_json()}


class OutputFile(click.Path):
    """A file to be written: that it may be is known before the command begins its work."""

    def __init__(self, allow_dash: bool = False) -> None:
        """`allow_dash`: - is the standard output."""
        super().__init__(path_type=Path, allow_dash=allow_dash)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The path. Raises UserError for one that `output_file` refuses."""
        return output_file(Path(os.fsdecode(super().convert(value, param, ctx))))


OUTPUT = OutputFile()


def with_force(command: F) -> F:
    """The option --force of commands that write files; `output_file` heeds it."""

    def note(ctx: click.Context, param: click.Parameter, value: bool) -> None:
        ctx.meta[FORCE] = value

    return click.option(
        "--force", is_flag=True, is_eager=True, expose_value=False, callback=note,
        help="Overwrite files that this program did not write.",
    )(command)  # fmt: skip


@contextmanager
def needs_ros(otherwise: str = "") -> Iterator[None]:
    """Where something is imported that needs ROS 2: without it the command ends with a line that says so.

    `otherwise` goes to its end: what works without ROS.
    """
    try:
        if importlib.util.find_spec("rclpy") is None:  # a runner of processes does not import it itself
            raise ImportError("No module named 'rclpy'")
        yield
    except ImportError as error:
        raise click.ClickException(
            f"the loop runs on ROS 2, which is not to be found here ({error}): source your ROS 2 installation, "
            f"or `pip install 'agv_ncs[ros]'`{otherwise}"
        ) from None


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file; a path that cannot be written is the user's error."""
    try:
        output_file(path).write_text(
            json.dumps({**JSON_MARK, **content}, indent=2, allow_nan=False) + "\n", encoding="utf-8"
        )
    except OSError as error:
        raise click.ClickException(f"{path}: cannot be written: {error.strerror}") from None


def with_report(command: F) -> F:
    """The options --report and --figures of commands that judge a run."""
    command = click.option(
        "--figures", type=click.Path(path_type=Path), help="Draw each plot to this directory, as SVG and PDF."
    )(command)
    return click.option("--report", type=OUTPUT, help="Write a page for the browser to this file.")(command)


def report_on(
    analysis: Observations, report: Path | None, figures: Path | None, within: CorridorOfRun | None = None
) -> None:
    """Write what `with_report` asks for, with what the run says of its corridor."""
    if report is not None:
        from agv_analysis.report.page import write_report

        write_report(analysis, report, within)
        click.echo(f"report:  {report}")
    if figures is not None:
        from agv_analysis.report.matplotlib_figures import draw_figures
        from agv_analysis.report.page import all_panels

        draw_figures(all_panels(analysis, within), figures)
        click.echo(f"figures: {figures}")
