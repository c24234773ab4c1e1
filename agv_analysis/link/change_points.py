"""Did the link change while it was recorded? Change points of the channel by the likelihood ratio.

For each step t the transitions before and after it get a Gilbert channel of their own; the gain in log likelihood is
largest at the most likely change. How large it gets by itself on a link that does not change depends on the link: its
maximum over t has no chi-square distribution, its limit (a Bessel bridge) is far off where outages are few, and lengths
that are not geometric scatter more. So it is compared with that of the same recording, cut into blocks much longer than
an outage, in random order: whatever the link, as long as it does not change these are as likely as the one observed.
Where losses come more regularly than by chance, as every hundredth packet, all orders are nearly the same, and any is
the largest by a hair. So the p-value is never below that of the likelihood ratio of a change at a known step, e^-gain.

Segments are split anew as long as there is such a change (binary segmentation). One outage is not a change of the link:
the part that loses more must hold at least three.

Source: Csoergo and Horvath, Limit Theorems in Change-Point Analysis, 1997, 1.2; Antoch and Huskova, Permutation Tests
in Change Point Analysis, Stat. Prob. Letters 53, 2001.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.large_arrays import release
from agv_analysis.link.reception_intervals import Outcomes, Steps, reception_intervals
from agv_analysis.run import Floats

ORDERS = 499
"""Random orders (generator PCG64, seed 1)."""

SIGNIFICANCE = 1.0 / (ORDERS + 1)
"""A change is one that no random order shows: so many links that do not change are called changing."""

_BLOCKS = 200

_FEWEST = 12
"""Blocks below which their orders are too few for such a significance."""

_OUTAGES = 3

_TOGETHER = 1 << 17
"""Slots whose transitions are counted together."""

Counts = NDArray[np.int64]


class Segment(NamedTuple):
    """A part of a recording over which the link did not change, as positions in the arrays."""

    begin: int
    end: int
    """One behind the last."""


@dataclass(frozen=True)
class Stationarity:
    """Is the link the same all along?"""

    p_value: float | None
    """Share of random orders with as large a likelihood ratio, or e^-gain if that is more; None if the recording is too
    short for its outages."""
    change_points: tuple[int, ...]
    """First step k of each segment but the first."""
    segments: tuple[Segment, ...]

    def to_json(self) -> dict[str, Any]:
        """`p_value` and `change_points` (steps)."""
        return {"p_value": self.p_value, "change_points": list(self.change_points)}


def stationarity(k: Steps, lost: Outcomes) -> Stationarity:
    """Change points of the outcomes of slots `k`, increasing, shape (N,), N >= 1."""
    whole = Segment(0, len(k))
    p_value, at = _most_likely_change(k, lost, whole)
    segments = tuple(_split(k, lost, whole, p_value, at))
    return Stationarity(p_value, tuple(int(k[segment.begin]) for segment in segments[1:]), segments)


def _split(k: Steps, lost: Outcomes, segment: Segment, p_value: float | None, at: int) -> list[Segment]:
    """Segments without a change, given the most likely one."""
    if p_value is None or p_value > SIGNIFICANCE:
        return [segment]
    parts = Segment(segment.begin, at), Segment(at, segment.end)
    return [found for part in parts for found in _split(k, lost, part, *_most_likely_change(k, lost, part))]


def _most_likely_change(k: Steps, lost: Outcomes, segment: Segment) -> tuple[float | None, int]:
    """p-value of the most likely change within a segment, and the first slot behind it."""
    k, lost = k[segment.begin : segment.end], lost[segment.begin : segment.end]
    length = _block_length(k, lost)
    if length * _FEWEST > len(k):
        return None, segment.begin
    edges = np.linspace(0, len(k) - 1, min(len(k) // length + 1, len(k))).astype(np.int64)  # no block is empty
    blocks = _transitions_within(k, lost, edges, max(1, _TOGETHER // length))
    before = np.cumsum(blocks, axis=1)
    observed = _gains(before)
    rng = np.random.default_rng(1)
    orders = np.argsort(rng.random((ORDERS, blocks.shape[1])), axis=1)
    reached = np.count_nonzero(_gains(np.cumsum(blocks[:, orders], axis=2)).max(axis=1) >= observed.max())
    best = int(np.argmax(observed))
    around = slice(edges[best], edges[best + 2] + 1)  # the change is in the block before the best border, or behind it
    near = np.arange(edges[best] + 1, edges[best + 2])
    counts = before[:, best, None] - blocks[:, best, None] + _transitions_before(k[around], lost[around])[:, 1:-1]
    exact = _gains(np.concatenate((counts, before[:, -1:]), axis=1))
    p_value = max(float(1 + reached) / (ORDERS + 1), math.exp(-float(observed.max())))
    return p_value, segment.begin + int(near[np.argmax(exact)]) + 1


def _block_length(k: Steps, lost: Outcomes) -> int:
    """Slots of a block: a part of the recording in which outages hardly reach from one block to the next."""
    found = reception_intervals(k, lost)
    mean = float(found.outages.mean()) if len(found.outages) else 0.0
    return max(-(-len(k) // _BLOCKS), 2 * found.longest, int(5.0 * mean), 1)


def _transitions_before(k: Steps, lost: Outcomes) -> Counts:
    """Transitions up to each slot: to lost, from delivered, to delivered, from lost; shape (4, N)."""
    known = np.diff(k) == 1
    before, after = lost[:-1], lost[1:]
    kinds = np.array([~before & after, ~before, before & ~after, before]) & known
    return np.concatenate((np.zeros((4, 1), dtype=np.int64), np.cumsum(kinds, axis=1)), axis=1)


def _transitions_within(k: Steps, lost: Outcomes, edges: Steps, together: int) -> Counts:
    """The same of each block, from an edge to the next, so many of them at once; shape (4, edges - 1)."""
    found = []
    for first in range(0, len(edges) - 1, together):
        some = edges[first : first + together + 1]
        part = slice(some[0], some[-1] + 1)
        found.append(np.diff(_transitions_before(k[part], lost[part])[:, some - some[0]], axis=1))
        release(k, lost)
    return np.concatenate(found, axis=1)


def _gains(before: Counts) -> Floats:
    """Log likelihood ratio of a change behind each position but the last, of counts so far, shape (4, ..., n)."""
    total, before = before[..., -1:], before[..., :-1]
    after = total - before
    gain = _log_likelihood(before) + _log_likelihood(after) - _log_likelihood(total)
    rates = [part[3] / np.maximum(1, part[1] + part[3]) for part in (before, after)]
    outages = np.where(rates[0] > rates[1], np.maximum(before[0], before[2]), np.maximum(after[0], after[2]))
    return np.where(outages >= _OUTAGES, gain, 0.0)


def _log_likelihood(counts: Counts) -> Floats:
    """Largest log likelihood of transitions, shape (4, ...), but for a constant."""
    return _binomial(counts[0], counts[1]) + _binomial(counts[2], counts[3])


def _binomial(hits: Counts, trials: Counts) -> Floats:
    return _x_log_x(hits) + _x_log_x(trials - hits) - _x_log_x(trials)


def _x_log_x(x: Counts) -> Floats:
    return np.asarray(x * np.log(np.maximum(x, 1)), dtype=np.float64)
