"""File formats of measured links, one module each, found by what is in the file.

A module of this folder with a `FORMAT` in it is a format; nothing else has to be changed for a new one.
"""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path

from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.text_columns import head_of
from agv_analysis.link.measurement import MeasurementError, Reading
from agv_analysis.link.packet_grid import NumbersError


def _found() -> dict[str, Format]:
    """The FORMAT of each module of this folder that has one, in the order in which they are asked."""
    modules = [importlib.import_module(f"{__name__}.{found.name}") for found in pkgutil.iter_modules(__path__)]
    formats = [module.FORMAT for module in modules if hasattr(module, "FORMAT")]
    return {found.name: found for found in sorted(formats, key=lambda found: found.order)}


FORMATS = _found()

_ABOUT = {
    "columns": ("table", "--column names columns of one"), "delimiter": ("table", "--delimiter separates cells of one"),
    "topic": ("bag or capture", "--topic is of one"),
    "received": ("capture", "--received is a capture of the other end"),
}  # fmt: skip
"""What each of `Options` but the interval is about, and what it says there."""


def format_of(path: Path, name: str = "") -> Format:
    """The format called `name`, or, without a name, that of what the file holds. Raises MeasurementError."""
    if name:
        if name not in FORMATS:
            raise MeasurementError(f"no format is called {name!r}: use one of {', '.join(FORMATS)}")
        return FORMATS[name]
    if not path.exists():
        raise MeasurementError(f"{path}: no such file")
    head = b"" if path.is_dir() else head_of(path)
    if not head and not path.is_dir():
        raise MeasurementError(f"{path}: is empty")
    for found in FORMATS.values():
        if found.matches(head, path):
            return found
    known = "; ".join(found.title for found in FORMATS.values())
    raise MeasurementError(f"{path}: unknown format, known are: {known}; if it is one of these, name it with --format")


def read_link(path: str | Path, options: Options | None = None, name: str = "") -> Reading:
    """What a file says of a link, in the format called `name` or, without a name, in the one found by content.

    Raises MeasurementError for a file that is not a measurement of a link; the text says what it is, and what to do.
    """
    path, options = Path(path), options or Options()
    found = format_of(path, name or ("table" if options.columns or options.delimiter else ""))
    for option, (other, what) in _ABOUT.items():
        if getattr(options, option) and option not in found.takes:
            raise MeasurementError(f"{path}: is not a {other} ({found.title}), and {what}")
    try:
        return found.read(path, options)
    except NumbersError as error:
        raise MeasurementError(f"{path}: {error}") from None
