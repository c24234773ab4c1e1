"""The header of a table: which column is what, in which unit, and how its cells are written."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from typing import NamedTuple

from agv_analysis.link.measurement import MeasurementError

ROLES = (
    "time", "seq", "sent", "received", "lost", "delay", "rtt", "uplink_lost", "downlink_lost", "uplink_delay",
    "downlink_delay",
)  # fmt: skip
"""What a column may be."""

FLAGS = ("lost", "received", "uplink_lost", "downlink_lost")
"""Roles whose cells may be yes and no."""

INSTANTS = ("time", "sent", "received")
"""Roles whose cells may be dates."""

_KNOWN = {
    "frame.time_epoch": "time", "frame.time_relative": "time", "timestamp": "time", "t": "time", "date": "time",
    "datetime": "time", "icmp.seq": "seq", "icmp.seq_le": "seq", "rtps.sm.seqnumber": "seq", "rtp.seq": "seq",
    "seqno": "seq", "sequence": "seq", "icmp_seq": "seq", "k": "seq", "icmp.resptime": "rtt_ms", "latency": "delay",
    "verdict": "lost", "loss": "lost",
}  # fmt: skip
"""Usual names for a role."""

_UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "msecs", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "usec", "usecs", "microsecond", "microseconds", "µs", "μs"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanosecond", "nanoseconds"), 1e-9),
}
"""What a unit of time is worth [s]."""

_WITH_UNIT = re.compile(rf"(.+?)(?:[\s_/,:]+(?:in\s+)?|\s*[\[(]\s*)({'|'.join(_UNITS)})\s*[\])]?", re.IGNORECASE)

_SEPARATORS = (",", ";", "\t", "|")

BLANKS = " "
"""The separator of a table whose cells are apart by blanks or tabulators, as many as there are."""

_NAMED = {"tab": "\t", "\\t": "\t", "space": BLANKS, "blank": BLANKS, "comma": ",", "semicolon": ";"}
"""Separators that are hard to write on a command line."""


class TableColumn(NamedTuple):
    """A column that says something of packets."""

    place: int
    role: str
    unit: float
    """What a number in it is worth [s]."""


class Header(NamedTuple):
    """The first line of a table that is not a comment."""

    separator: str
    names: list[str]
    line: int
    """Its number in the file, from 1 on."""

    @property
    def may_have_commas(self) -> bool:
        """May a comma be a decimal mark? It may not where it separates cells."""
        return self.separator != ","


def header_of(head: bytes, separator: str = "") -> Header:
    """The header in the beginning of a file. A line with # before it is a comment, unless it names columns itself.

    The `separator` is by default the one that splits it into most names. Raises MeasurementError for one that is none.
    """
    separator = _NAMED.get(separator, separator)
    if separator and (len(separator) > 1 or not separator.isascii() or separator in '"#\r\n'):
        raise MeasurementError(f"--delimiter must be one character, or one of {', '.join(_NAMED)}; got {separator!r}")
    lines = head.decode("utf-8-sig", "replace").splitlines() or [""]
    for number, line in enumerate(lines, start=1):
        found = _header(line.lstrip("#").strip() if line.startswith("#") else line, number, separator)
        if line.strip() and (not line.startswith("#") or is_enough({one.role for one in columns_of(found)})):
            return found
    return _header(lines[0], 1, separator)


def _header(line: str, number: int, separator: str) -> Header:
    text = line.strip("\r\n")
    if not separator:
        separator = max(_SEPARATORS, key=text.count)
        found = _split(text, separator, number)
        if separator in text or is_enough({one.role for one in columns_of(found)}):
            return found
        apart = _split(text, BLANKS, number)
        roles = {one.role for one in columns_of(apart)}
        return apart if len(roles) > 1 and is_enough(roles) else found
    return _split(text, separator, number)


def _split(text: str, separator: str, number: int) -> Header:
    if separator == BLANKS:
        text = " ".join(text.split())
    try:
        names = next(csv.reader([text], delimiter=separator, skipinitialspace=True), [""])
    except csv.Error:  # no text
        names = text.split(separator)
    return Header(separator, [name.strip().strip("\"'").strip() for name in names], number)


def role_of(name: str) -> tuple[str, float]:
    """The role of a column of this name, and its unit [s]; an empty role for one that has none."""
    name, unit = name.lower(), 1.0
    if name not in ROLES and name not in _KNOWN:
        name, unit = _without_unit(name)
    name, known = _without_unit(_KNOWN.get(name, name))
    return (name, unit * known) if name in ROLES else ("", 1.0)


def _without_unit(name: str) -> tuple[str, float]:
    """A name without the unit at its end, and what that is worth [s], 1 without one."""
    found = None if name in ROLES else _WITH_UNIT.fullmatch(name)
    return (name, 1.0) if found is None else (found[1].strip(), _UNITS[found[2].lower()])


def columns_of(header: Header, chosen: Mapping[str, str] | None = None, source: str = "") -> list[TableColumn]:
    """The columns that matter, `chosen` being names by role. Raises MeasurementError for one that is not there."""
    found: dict[str, TableColumn] = {}
    for role, name in (chosen or {}).items():
        if role not in ROLES:
            raise MeasurementError(f"--column {role}={name}: must be one of {', '.join(ROLES)}")
        if name not in header.names:
            raise MeasurementError(f"{source}: has no column {name!r}; it has {', '.join(header.names)}")
        _, unit = role_of(name)
        found[role] = TableColumn(header.names.index(name), role, unit if unit != 1.0 else _without_unit(name)[1])
    for place, name in enumerate(header.names):
        role, unit = role_of(name)
        if role and role not in found and place not in {column.place for column in found.values()}:
            found[role] = TableColumn(place, role, unit)
    return list(found.values())


def is_enough(roles: set[str]) -> bool:
    """Do these columns say which packets were lost?"""
    says_it = {"lost", "received", "delay", "rtt", "uplink_lost", "downlink_lost"}
    return bool(roles & says_it) or roles >= {"time", "seq"}
