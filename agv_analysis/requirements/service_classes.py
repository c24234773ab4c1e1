"""Classes of radio service in one data file, each with its source; users add files of their own."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from agv_ros.errors import UserError, open_text

_OWN = Path(__file__).with_name("service_classes.yaml")

SERVICE, QOS = "service", "qos"


@dataclass(frozen=True)
class ServiceClass:
    """A row: what an application asks of a network, or what a network promises for a flow. None: the row is silent."""

    name: str
    kind: str
    """service or qos."""
    document: str
    """Where the figures stand; `own figures` for a user's."""
    table: str
    version: str
    """Of the document; `not recorded` where it is not recorded."""
    read: bool
    """Did somebody read the figures in the document itself?"""
    availability: float | None = None
    mtbf_s: float | None = None
    """Mean time between failures [s]."""
    latency_s: float | None = None
    """Maximum end-to-end latency, or packet delay budget [s]."""
    survival_time_s: float | None = None
    transfer_interval_s: float | None = None
    reliability: float | None = None
    """Share of the packets that arrive within the latency."""
    loss_rate: float | None = None
    """Packet error rate: share of packets that do not arrive within the latency."""
    message_bytes: int | None = None
    remarks: str = ""

    @property
    def source(self) -> str:
        """Document, table and version, and whether they were read."""
        table = "" if self.table == "not recorded" else f", table {self.table}"
        version = "version not recorded" if self.version == "not recorded" else self.version
        return f"{self.document}{table} ({version}{'' if self.read else ', not read in the document'})"

    @property
    def largest_loss(self) -> float | None:
        """Share of packets that may be lost or too late; None where the row is silent."""
        return self.loss_rate if self.reliability is None else 1.0 - self.reliability


_FIELDS = {field.name: field for field in dataclasses.fields(ServiceClass)}
_TEXTS = ("name", "kind", "document", "table", "version")


def load_classes(*files: Path) -> tuple[ServiceClass, ...]:
    """The classes of this package and of further files. Raises UserError that names file and row of a bad one.

    A file is a YAML list of rows, each with name, kind, document, table, version, read, and figures.
    """
    found: dict[str, ServiceClass] = {}
    for file in (_OWN, *files):
        with open_text(str(file), UserError) as text:
            content = text.read()
        try:
            rows = yaml.safe_load(content)
        except (yaml.YAMLError, ValueError) as error:  # ValueError: a date that is none
            raise UserError(f"{file}: is not YAML: {' '.join(str(error).split())}") from None
        if not isinstance(rows, list):
            raise UserError(f"{file}: must be a list of classes, got {'nothing' if rows is None else repr(rows)[:80]}")
        for number, row in enumerate(rows, start=1):
            one = _class(row, f"{file}: class {number}")
            found[one.name] = one
    return tuple(found.values())


def find_class(name: str, classes: tuple[ServiceClass, ...]) -> ServiceClass:
    """The class of this name. Raises UserError if there is none."""
    for one in classes:
        if one.name == name:
            return one
    raise UserError(f"no class is called {name!r}: use one of {', '.join(repr(one.name) for one in classes)}")


def _class(row: Any, where: str) -> ServiceClass:
    if not isinstance(row, dict):
        raise UserError(f"{where}: must have names and values, got {row!r}")
    for name in ("name", "kind", "document", "table", "version", "read"):
        if row.get(name) in (None, ""):
            raise UserError(f"{where}: has no {name}, without which its figures have no source")
    unknown = sorted(set(row) - set(_FIELDS))
    if unknown:
        raise UserError(f"{where}: no figure is called {unknown[0]!r}; known are {', '.join(_FIELDS)}")
    if row["kind"] not in (SERVICE, QOS):
        raise UserError(f"{where}: kind must be service or qos, got {row['kind']!r}")
    values = dict(row)
    for name in (*_TEXTS, "remarks"):
        values[name] = str(row.get(name, ""))
    if not isinstance(row["read"], bool):
        raise UserError(f"{where}: read must be true or false, got {row['read']!r}")
    for name in set(row) - {*_TEXTS, "read", "remarks"}:
        value = row[name]
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
            raise UserError(f"{where}: {name} must be a number above 0, got {value!r}")
        if name in ("availability", "reliability", "loss_rate") and not value < 1:
            raise UserError(f"{where}: {name} must be below 1, got {value!r}")
    return ServiceClass(**values)
