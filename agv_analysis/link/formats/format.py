"""What a file format of measured links is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from agv_analysis.link.formats.text_columns import Progress
from agv_analysis.link.measurement import Reading


@dataclass(frozen=True)
class Options:
    """What a user says of a file that it does not say itself."""

    interval: float | None = None
    """Time between packets sent [s], for files without times."""
    columns: Mapping[str, str] = field(default_factory=dict)
    """Of a table: the name of the column that is the `time`, `seq`, `sent`, `received`, `lost`, `delay` or `rtt`."""
    delimiter: str = ""
    """What separates its cells; by default what splits the header into most names."""
    topic: str = ""
    """Of a bag."""
    received: Path | None = None
    """The capture at the receiving end, beside one at the sending end."""
    progress: Progress | None = None


class Format(NamedTuple):
    """One file format."""

    name: str
    """As in --format."""
    title: str
    """In words."""
    order: int
    """When its turn is to recognise a file: those with unmistakable signs come first."""
    matches: Callable[[bytes, Path], bool]
    """Does a file with this beginning, unpacked, look like it? Of a directory the beginning is empty."""
    read: Callable[[Path, Options], Reading]
    takes: tuple[str, ...] = ()
    """Which `Options` it takes beside the interval."""
