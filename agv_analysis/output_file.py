"""Files that commands write: never through a link that leads elsewhere, never in place of what another program wrote.

Each output carries a mark of its origin: a key in JSON, a `generator` in HTML, metadata in PNG, SVG and PDF, a comment
in Markdown and YAML, the names of its columns in CSV. A file that is there is replaced if it carries one, or with
--force.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import click

from agv_ros.errors import UserError

ORIGIN = "agv_ncs"

JSON_MARK = {"written_by": ORIGIN}
"""First entry of each JSON file."""

MARKDOWN_MARK = f"<!-- written by {ORIGIN} -->\n"
"""Last line of each Markdown file."""

YAML_MARK = f"# written by {ORIGIN}\n"
"""First line of each YAML file."""

FORCE = "agv_analysis.force"
"""Key of --force in the context of click."""

_METADATA: dict[str, dict[str, str | None]] = {
    ".png": {"Software": ORIGIN},
    ".svg": {"Creator": ORIGIN, "Date": None},
    ".pdf": {"Creator": ORIGIN, "CreationDate": None},
}

_COLUMNS = (
    r"k,lost",  # outcomes of one link
    r"time,uplink_lost(,\w+)*",  # both links with times
    r"time,seq,sent_monotonic_ns(,\w+)*",  # a link that was probed
    r"k,t,x_c,y_c,theta_c,x_r(,\w+)*",  # a run
    r"n_ul,slots,share,closed_form",  # a channel
    r"[a-z]\w*,[a-z]\w*,n_\w+(,\w+)*",  # a map of margins
)

_OURS = re.compile(
    rb"\s*\{\s*\"written_by\": *\"agv_ncs\""
    rb"|<!DOCTYPE html>.{,1000}?<meta name=\"generator\" content=\"agv_ncs\">"
    rb"|# written by agv_ncs\r?\n"
    rb"|\x89PNG.{,4000}?tEXtSoftware\0agv_ncs"
    rb"|<\?xml.{,4000}?<dc:creator>\s*<cc:Agent>\s*<dc:title>agv_ncs</dc:title>"
    rb"|%PDF.*/Creator \(agv_ncs\)"
    rb"|.*<!-- written by agv_ncs -->\s*\Z"
    rb"|(" + "|".join(_COLUMNS).encode() + rb")\r?\n",
    re.DOTALL,
)

_END = 1 << 16
"""So many bytes at each end of a file are searched for a mark."""


class Figure(Protocol):
    """What draws itself to a file: matplotlib's."""

    @property
    def savefig(self) -> Callable[..., Any]:
        """Draw to a path."""


def not_linked_out(path: Path | str) -> Path:
    """The path. Raises UserError if a link at this place leads out of its directory.

    A recording may come from anybody, and its directory is where pictures go: a link in it must not choose the file.
    """
    path = Path(path)
    if path.is_symlink() and path.resolve().parent != path.parent.resolve() and path.parent != Path("/dev"):
        raise UserError(
            f"{path}: is a link to {path.resolve()}, out of its directory, and not written to: remove it or name "
            "another file"
        )
    return path


def output_file(path: Path | str) -> Path:
    """The path, to be written to.

    Raises UserError for a link that leads out of its directory, and, without --force, for a file that is neither empty
    nor an earlier output. Code outside of a command has no --force and removes the file first.
    """
    path = not_linked_out(path)
    if path.is_file() and not is_forced() and not is_ours(path):
        raise UserError(f"{path}: was not written by agv-ncs and is kept: name another file, or give --force")
    return path


def is_forced() -> bool:
    """Was the command that runs given --force?"""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.meta.get(FORCE, False))


def save_figure(figure: Figure, path: Path | str, title: str = "", **options: Any) -> None:
    """Draw to a file of `output_file`, with the mark that its kind can carry, and a title: PNG, SVG and PDF can."""
    path = output_file(path)
    metadata = _METADATA.get(path.suffix.lower())
    if metadata is not None and title:
        metadata = {**metadata, "Title": title}
    figure.savefig(path, metadata=metadata, **options)


def is_ours(path: Path) -> bool:
    """Is a file empty, or does it carry a mark? One that is not there or cannot be read is not ours."""
    try:
        with path.open("rb") as file:
            start = file.read(_END)
            file.seek(max(len(start), path.stat().st_size - _END))
            return not start or _OURS.match(start + file.read(_END)) is not None
    except OSError:
        return False
