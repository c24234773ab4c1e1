"""What a run of finite length proves of a corridor: how often an outage leads out of it.

Of N outages some, perhaps none, led outside. That bounds the probability that the next one does, exactly and without a
model. What the tail of their lengths says goes further, and rests on more: that it goes on as a geometric one beyond
the longest that was seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from agv_analysis.corridor.corridor import probability
from agv_analysis.corridor.shares import path_shares
from agv_analysis.corridor.widths import Widths
from agv_analysis.link.channel_fit import Estimate
from agv_analysis.link.heavy_tail import tail_is_heavy
from agv_analysis.link.transitions import SAMPLES
from agv_analysis.metrics.confidence import clopper_pearson, percent
from agv_analysis.metrics.deviation import DIVERGED
from agv_analysis.metrics.distance_text import three_digits
from agv_analysis.metrics.outages import outage_begins, outage_lengths
from agv_analysis.run import Floats, Run
from agv_ros.counted import counted

FEW = 10
"""Outages below which a tail is not to be trusted."""

_LONGER = 0.5
"""Share of the outages, the longest, whose lengths say how the tail falls; FEW of them at least."""

_SEED = 1


@dataclass(frozen=True)
class RecordedOutages:
    """The outages of a run after its initial error has settled, and those that led out of the corridor."""

    outages: int
    left: int
    """Outages between whose beginning and that of the next the AGV was outside."""
    largest: float
    """Largest share of the corridor that was used; inf where the AGV's pose is not a number."""
    at_most: float
    """Probability that an outage leads outside, at most: exact one-sided 95 % bound. 1 if there was no outage."""
    tail: Estimate | None
    """The same from the tail of their lengths, with its 95 % interval; None where no length leads outside."""
    tail_of: int
    """Outages whose lengths say how the tail falls."""
    per_hour: float
    """Outages an hour."""
    warnings: tuple[str, ...]

    def rows(self) -> list[tuple[str, str]]:
        """Name and value of each figure, in plain text."""
        seen = f"{self.left} of {counted(self.outages, 'outage')} led outside, {_used(self.largest)}"
        found = [("Seen in the run", seen)]
        bound = f"with 95 % confidence at most {percent(self.at_most)} of all outages lead outside"
        found.append(("Proved by the run", bound if self.outages else "nothing: there was no outage"))
        if self.tail is not None:
            tail = f"{probability(self.tail)} of all outages"
            found.append(("By the tail of their lengths", f"{tail}, from the {self.tail_of} longest"))
        return found

    def to_json(self) -> dict[str, Any]:
        """The figures by name."""
        tail = self.tail
        return {
            "outages": self.outages,
            "left": self.left,
            "largest_share": self.largest if np.isfinite(self.largest) else None,
            "p_outage_at_most": self.at_most,
            "p_outage_tail": None if tail is None else tail.value,
            "p_outage_tail_interval": None if tail is None else [tail.low, tail.high],
            "tail_outages": self.tail_of,
            "outages_per_hour": self.per_hour,
            "warnings": list(self.warnings),
        }


def _used(share: float) -> str:
    """How much of a corridor was used, at most."""
    if not share <= DIVERGED:
        return "and the AGV diverged"
    if share >= _MANY_TIMES:
        return f"up to {three_digits(share)} times the half-width away"
    return f"at most {100.0 * share:.3g} % of the half-width was used"


_MANY_TIMES = 10.0
"""Share of a corridor from which on per cent say little."""


def recorded_outages(run: Run, widths: Widths, n_single: int | None, settled: int | None) -> RecordedOutages:
    """Of a run. A single outage of up to `n_single` slots stays inside, or all do (None).

    What happens before row `settled` is the initial error's; None: it never settles, and the whole run is taken.
    """
    rows = slice(settled or 0, None)
    shares, lost, k = path_shares(run.pose[rows], run.reference[rows], widths), run.lost[rows], run.k[rows]
    begins, lengths = outage_begins(k, lost), outage_lengths(k, lost)
    count = len(begins)
    left = sum(bool(part.max() > 1.0) for part in np.split(shares, begins)[1:])
    at_most = clopper_pearson(left, count, confidence=0.9)[1] if count else 1.0
    tail, tail_of = None, 0
    if n_single is not None and count:
        tail, tail_of = geometric_tail(lengths, max(1, n_single + 1))
    hours = len(k) * run.ts / 3600.0
    return RecordedOutages(
        count, left, float(shares.max()), at_most, tail, tail_of, count / hours,
        tuple(_warnings(lengths, tail_of, settled)),
    )  # fmt: skip


def geometric_tail(lengths: np.ndarray[Any, np.dtype[np.int64]], length: int) -> tuple[Estimate, int]:
    """P(an outage is as long as `length` or longer) from those seen, shape (N,), and how many say how the tail falls.

    Above a length u, that of the shortest of the longer half, they are taken for geometric: share above u times
    (1 - h)^(length - u). Its interval is that of the posterior (Jeffreys) of both. A `length` below u is counted.
    """
    ordered, count = np.sort(lengths), len(lengths)
    taken = min(count, max(FEW, int(_LONGER * count)))
    first = int(ordered[count - taken])
    if length <= first:
        return Estimate.of(int((lengths >= length).sum()), count), taken
    above = ordered[ordered >= first]
    beyond = int((above - first).sum())
    share, ends = len(above) / count, len(above) / (len(above) + beyond)
    rng = np.random.default_rng(_SEED)
    shares: Floats = (
        rng.beta(len(above) + 0.5, count - len(above) + 0.5, SAMPLES) if len(above) < count else np.ones(SAMPLES)
    )
    hazards = rng.beta(len(above) + 0.5, beyond + 0.5, SAMPLES)
    low, high = np.quantile(shares * (1.0 - hazards) ** (length - first), [0.025, 0.975])
    return Estimate.about(share * (1.0 - ends) ** (length - first), float(low), float(high)), len(above)


def _warnings(lengths: np.ndarray[Any, np.dtype[np.int64]], tail_of: int, settled: int | None) -> list[str]:
    found = []
    if len(lengths) < FEW:
        found.append(
            f"what is said of longer outages than those seen rests on {len(lengths)} of them, fewer than {FEW}"
        )
    if tail_of and tail_is_heavy(lengths):
        found.append("the longest outages are longer than a geometric tail has them: it says too little of them")
    if settled is None:
        found.append("the initial error has not settled: it is part of what was seen")
    return found
