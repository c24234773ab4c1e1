"""What a bag says about its topics, which may be in several places."""

from __future__ import annotations

from typing import TypeVar

from agv_analysis.bags.chunk import Definition
from agv_analysis.bags.findings import Findings
from agv_analysis.bags.records import SCHEMA, Channel, Schema, parse_channel, parse_schema

D = TypeVar("D", Schema, Channel)


class Definitions:
    """Schemas and channels by number; what a CRC proves wins over what none covers."""

    def __init__(self, findings: Findings) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._proven: set[tuple[str, int]] = set()
        self._findings = findings

    def add(self, definition: Definition, is_proven: bool) -> None:
        """Take a Schema or Channel record. Raises DamagedError."""
        if definition.opcode == SCHEMA:
            self._add("schema", self.schemas, parse_schema(definition.content), is_proven)
        else:
            self._add("channel", self.channels, parse_channel(definition.content), is_proven)

    def _add(self, kind: str, known: dict[int, D], new: D, is_proven: bool) -> None:
        key = (kind, new.id)
        was_proven = key in self._proven
        old = known.get(new.id)
        if old is not None and old != new:
            which = "the one that a CRC covers is used" if was_proven != is_proven else "the first is used"
            self._findings.add(f"{kind} {new.id} defined in two ways, {which}", is_loss=was_proven == is_proven)
        if old is None or (is_proven and not was_proven):
            known[new.id] = new
        if is_proven:
            self._proven.add(key)
