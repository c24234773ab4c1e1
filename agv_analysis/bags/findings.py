"""What a reader finds wrong with a bag, counted by kind, in words."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from agv_ros.counted import counted
from agv_ros.printable import printable


@dataclass
class _Kind:
    count: int = 0
    first: int | None = None
    messages: int = 0
    is_loss: bool = False


@dataclass
class Findings:
    """Everything that was lost, that could not be checked, or that is not as it should be."""

    _kinds: dict[str, _Kind] = field(default_factory=dict)
    _unchecked: Counter[str] = field(default_factory=Counter)

    def add(
        self, what: str, count: int = 1, *, at: int | None = None, messages: int = 0, is_loss: bool = False
    ) -> None:
        """Count a finding of the kind `what`; `at`: its byte in the file; `messages`: how many went with it."""
        kind = self._kinds.setdefault(what, _Kind(first=at))
        kind.count += count
        kind.messages += messages
        kind.is_loss |= is_loss

    def add_unchecked(self, what: str, count: int = 1) -> None:
        """Count something of the kind `what` that is used although no CRC covers it."""
        self._unchecked[what] += count

    def merge(self, other: Findings) -> None:
        """Take over what another reader found."""
        for what, kind in other._kinds.items():
            self.add(what, kind.count, at=kind.first, messages=kind.messages, is_loss=kind.is_loss)
        self._unchecked += other._unchecked

    @property
    def is_loss(self) -> bool:
        """Is anything known to be missing?"""
        return any(kind.is_loss for kind in self._kinds.values())

    def texts(self) -> tuple[str, ...]:
        """One line for each kind, and one for all that no CRC covers."""
        found = tuple(_text(what, kind) for what, kind in self._kinds.items())
        found = tuple(map(printable, found))
        unchecked = printable(", ".join(f"{what}: {count}" for what, count in self._unchecked.items()))
        return (*found, f"not checked, because there is no CRC: {unchecked}") if unchecked else found


def _text(what: str, kind: _Kind) -> str:
    where = "" if kind.first is None else f", the first at byte {kind.first}"
    messages = f", with {counted(kind.messages, 'message')}" if kind.messages else ""
    return f"{what}: {kind.count}{where}{messages}"
