"""One line of a benchmark: what is ours, what is the peer measured in the same run, and the aim for their ratio."""

from __future__ import annotations

from typing import NamedTuple


class Comparison(NamedTuple):
    """Two figures in one unit; each module of this folder gives a list of them by `measure()`.

    They are speeds, the larger the better, unless `smaller_is_better`.
    """

    what: str
    ours: float
    peer_name: str
    peer: float
    unit: str
    aim: float | None = None
    """Smallest ratio that is aimed at, None where there is no aim."""
    smaller_is_better: bool = False

    @property
    def ratio(self) -> float:
        """How many times as good as the peer; NaN where both are zero within the resolution."""
        better, worse = (self.peer, self.ours) if self.smaller_is_better else (self.ours, self.peer)
        return better / worse if worse else float("nan")

    @property
    def met(self) -> bool | None:
        """Is the aim reached? None without one."""
        return None if self.aim is None else self.ratio >= self.aim
