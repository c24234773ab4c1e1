"""The commands of `agv-ncs`, one module each; here is what they share."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

F = TypeVar("F", bound=Callable[..., Any])


def with_settings(command: F) -> F:
    """The argument PARAMS and the option --set of commands that take a scenario."""
    command = click.option(
        "--set", "settings", multiple=True, metavar="NODE.PARAMETER=VALUE",
        help="Change a parameter of the file, as in --set relay.uplink.p=0.05. May be repeated.",
    )(command)  # fmt: skip
    return click.argument("params", type=click.Path())(command)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file; a path that cannot be written is the user's error."""
    try:
        path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise click.ClickException(f"{path}: cannot be written: {error.strerror}") from None
