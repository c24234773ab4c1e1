"""Does a Gilbert channel describe the recorded outcomes?

Under it the lengths of outages and of the gaps between them are geometric and independent. Both are looked at:

- chi-square over lengths, neighbouring lengths pooled until each cell expects five;
- the longest outage and the longest gap, one that is still open at an end included: P(max >= observed), which a
  pooled last cell would hide;
- the rank correlation of successive outages, and of successive gaps (Spearman), which a channel whose state changes
  slowly shows.

The fit is rejected where the smallest p-value, times the number of tests, is below `SIGNIFICANCE`.

Source of the test and of its degrees of freedom: Cochran, Some Methods for Strengthening the Common chi^2 Tests,
Biometrics 10, 1954.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from agv_analysis.link.chi_square import chi_square_tail
from agv_analysis.link.reception_intervals import Intervals, Outcomes, Steps, reception_intervals
from agv_analysis.run import Floats

SIGNIFICANCE = 0.01
"""Share of recordings of a Gilbert channel that are rejected, at most."""

_EXPECTED = 5.0
"""Least expected count of a cell."""

_CELLS = 12

_UNLIKE = 20
"""Lengths other than the most frequent one from which on a rank correlation is nearly normal."""


@dataclass(frozen=True)
class Goodness:
    """p-values of the tests; None where there is too little to test."""

    outage_lengths: float | None = None
    gap_lengths: float | None = None
    longest_outage: float | None = None
    longest_gap: float | None = None
    independence: float | None = None
    """Of successive outages and of successive gaps, the smaller one doubled."""

    @property
    def p_value(self) -> float | None:
        """Smallest p-value times the number of tests, at most 1; None where nothing could be tested."""
        found = [value for value in dataclasses.astuple(self) if value is not None]
        return min(1.0, len(found) * min(found)) if found else None

    @property
    def fits(self) -> bool:
        """Is the Gilbert channel not rejected?"""
        return self.p_value is None or self.p_value >= SIGNIFICANCE

    def to_json(self) -> dict[str, float | bool | None]:
        """All p-values by name."""
        return {**dataclasses.asdict(self), "p_value": self.p_value, "fits": self.fits}


def goodness_of_fit(k: Steps, lost: Outcomes) -> Goodness:
    """Tests on outcomes of the slots `k`, increasing, shape (N,)."""
    return goodness_of_intervals(reception_intervals(k, lost))


def goodness_of_intervals(found: Intervals) -> Goodness:
    """Tests on the outages and gaps of a recording."""
    outages, gaps = found.outages, found.gaps
    correlations = [p for p in map(_independence, (outages, gaps)) if p is not None]
    return Goodness(
        outage_lengths=geometric_p_value(outages),
        gap_lengths=geometric_p_value(gaps),
        longest_outage=_longest(outages, found.longest_open),
        longest_gap=_longest(gaps, found.longest_open_gap),
        independence=min(1.0, len(correlations) * min(correlations)) if correlations else None,
    )


def geometric_p_value(lengths: Steps) -> float | None:
    """Chi-square test that lengths >= 1, shape (n,), are geometric; None where pooling leaves no degree of freedom."""
    count = len(lengths)
    if count < 3 * _EXPECTED:
        return None
    ends = _cell_ends(count / float(lengths.sum()), count)
    if len(ends) < 2:
        return None
    beyond = np.exp(np.append(ends, np.inf) * math.log1p(-count / float(lengths.sum())))
    expected = count * -np.diff(beyond, prepend=1.0)
    observed = np.diff(np.searchsorted(np.sort(lengths), ends, side="right"), prepend=0, append=count)
    return chi_square_tail(float(((observed - expected) ** 2 / expected).sum()), len(expected) - 2)


def _cell_ends(hit: float, count: int) -> Floats:
    """Last length of each cell but the open last one, such that each expects `_EXPECTED` of `count` lengths."""
    if hit >= 1.0:
        return np.zeros(0)
    share = max(_EXPECTED / count, 1.0 / _CELLS)
    ends: list[float] = []
    last, left = 0, 1.0
    while left >= 2.0 * share:
        # The smallest length that takes `share` away, and leaves as much for the cells behind it.
        last = max(last + 1, math.ceil(math.log(left - share) / math.log1p(-hit) - 1e-9))
        left = (1.0 - hit) ** last
        if left < share:
            break
        ends.append(last)
    return np.array(ends, dtype=np.float64)


def _longest(lengths: Steps, open_length: int) -> float | None:
    """P(the longest of as many geometric lengths of this sum is at least as long as observed), by Bonferroni.

    The sum is sufficient for the unknown parameter, and given a sum T all ways to write it as n lengths are equally
    likely: P(one of them >= l) = C(T - l, n - 1) / C(T - 1, n - 1). One that is still open counts as it is.
    """
    lengths = np.append(lengths, open_length) if open_length else lengths
    count, total, longest = len(lengths), int(lengths.sum()), int(lengths.max(initial=0))
    if count < 3 or total == count:
        return None
    if total - longest < count - 1:
        return 0.0
    logs = _log_choose(total - longest, count - 1) - _log_choose(total - 1, count - 1)
    return min(1.0, count * math.exp(logs))


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)


def _independence(lengths: Steps) -> float | None:
    """p-value, two-sided, of the rank correlation of successive lengths; None where most are the same or few."""
    _, inverse, counts = np.unique(lengths, return_inverse=True, return_counts=True)
    if len(lengths) - counts.max(initial=0) < _UNLIKE:
        return None
    ranks = (np.cumsum(counts) - 0.5 * (counts - 1))[inverse]
    ranks = ranks - ranks.mean()
    correlation = float(ranks[1:] @ ranks[:-1] / (ranks @ ranks))
    return math.erfc(abs(correlation) * math.sqrt(len(lengths) / 2.0))
