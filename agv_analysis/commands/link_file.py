"""Reading a measured link, as the commands do that take one: which options say what its file does not."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from agv_analysis.link.measurement import Reading

F = TypeVar("F", bound=Callable[..., Any])

_LONG = 2**25
"""Files of more bytes than this are read under a progress bar."""


@dataclass(frozen=True)
class FileOptions:
    """What the options of `with_link_file` say, by the names that a command gets them by."""

    format_name: str
    interval: float | None
    columns: tuple[str, ...]
    delimiter: str
    topic: str
    received: Path | None

    def given(self) -> str:
        """Which of them are given, as the beginning of a complaint; empty if none is."""
        flags = {"format_name": "--format", "columns": "--column"}
        found = [flags.get(one.name, f"--{one.name}") for one in fields(self) if getattr(self, one.name)]
        are = "are" if len(found) > 1 else "is"
        return f"{', '.join(found)} {are} about the file of a measured link" if found else ""


def with_link_file(command: F) -> F:
    """The options of commands that read a measured link."""
    for option in reversed((
        click.option("--format", "format_name", default="", help="Its format, if it cannot be told by what is in it."),
        click.option(
            "--interval", type=click.FloatRange(min=0.0, min_open=True),
            help="Time between its packets [s], if not in the file.",
        ),
        click.option(
            "--column", "columns", multiple=True, metavar="ROLE=NAME", help="Which column of its table is what."
        ),
        click.option(
            "--delimiter", default="", metavar="CHARACTER", help="Between the cells of its table; or tab, space."
        ),
        click.option("--topic", default="", help="Which topic of a bag."),
        click.option(
            "--received", type=click.Path(path_type=Path), help="The capture at the other end, beside the first one."
        ),
    )):  # fmt: skip
        command = option(command)
    return command


def read_link_file(file: Path, of_file: FileOptions) -> Reading:
    """Read a measured link, a long file under a progress bar. Raises MeasurementError for one that is none."""
    from agv_analysis.commands.progress import step_bar
    from agv_analysis.link.formats import read_link
    from agv_analysis.link.formats.format import Options
    from agv_analysis.link.formats.netem_line import setting
    from agv_analysis.link.measurement import MeasurementError
    from agv_analysis.link.netem_text import is_netem

    columns, name = dict(map(_column, of_file.columns)), of_file.format_name
    options = Options(of_file.interval, columns, of_file.delimiter, of_file.topic, of_file.received)
    if is_netem(str(file)) and not os.path.exists(file):  # noqa: PTH110  # Path.exists minds what is too long for a name
        if given := of_file.given():
            raise MeasurementError(f"{given}, but {str(file)!r} is not a file: it is a line for netem")
        return setting(str(file), "the command line")
    if not file.is_file() or file.stat().st_size < _LONG:
        return read_link(file, options, name)
    with step_bar(100, "reading") as progress:
        return read_link(file, replace(options, progress=lambda share: progress(round(100 * share))), name)


def refuse_without_file(of_file: FileOptions) -> None:
    """Raises UserError if an option of `with_link_file` is given to a command that has no measured link to read."""
    from agv_ros.errors import UserError

    if given := of_file.given():
        raise UserError(f"{given}: name the file with --link")


def _column(text: str) -> tuple[str, str]:
    role, equals, name = text.partition("=")
    if not equals:
        raise click.ClickException(f"--column takes ROLE=NAME, as in time=frame.time_epoch; got {text!r}")
    return role, name
