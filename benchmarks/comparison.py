"""One line of a benchmark: what is ours, what is the peer measured in the same run, and the aim for their ratio."""

from __future__ import annotations

from typing import NamedTuple


class Comparison(NamedTuple):
    """Two speeds in one unit, the larger the better; each module of this folder gives a list of them by `measure()`."""

    what: str
    ours: float
    peer_name: str
    peer: float
    unit: str
    aim: float | None = None
    """Smallest ratio ours / peer that is aimed at, None where there is no aim."""

    @property
    def ratio(self) -> float:
        """Ours as a multiple of the peer's."""
        return self.ours / self.peer
