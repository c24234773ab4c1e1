"""Of many values the one that a share of them does not exceed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from agv_analysis.run import Floats

P99 = 0.99


_SAMPLE = 64
"""One of so many values is looked at to guess from where on values are worth putting into order."""


_TOGETHER = 32
"""Rows of columns that are taken as one: numpy is slow with short rows."""


def not_exceeded(values: Floats, share: float) -> float:
    """The smallest of some values >= 0, shape (n,), that a share of them do not exceed; inf where one is NaN or inf."""
    if not math.isfinite(values.max()):
        return math.inf
    large = values[values >= likely_below(values, share)]
    return _of_largest(large, values, share)


def likely_below(values: Floats, share: float) -> Any:
    """A guess, too low rather than too high, of `not_exceeded`, by a sample along the first axis of values."""
    sample = values[::_SAMPLE]
    place = max(0, math.ceil(len(sample) * (1.0 - 2.0 * (1.0 - share))) - 3)
    return np.partition(sample, place, axis=0)[place]


def _of_largest(large: Floats, values: Floats, share: float) -> float:
    """`not_exceeded` by those above a guess, which are few, unless the guess was too high."""
    beyond = len(values) - math.ceil(share * len(values))
    ordered = large if len(large) > beyond else values
    return float(np.partition(ordered, len(ordered) - 1 - beyond)[len(ordered) - 1 - beyond])


class Distances(NamedTuple):
    """Of some distances [m] the largest, the root mean square, and the one that 99 % of them do not exceed."""

    largest: float
    rms: float
    p99: float


def distances_of(squares: Floats) -> Distances:
    """Of distances whose squares [m^2] have shape (n,); all are 0 without any."""
    if not len(squares):
        return Distances(0.0, 0.0, 0.0)
    with np.errstate(over="ignore"):
        return Distances(
            math.sqrt(squares.max()), math.sqrt(np.mean(squares)), math.sqrt(not_exceeded(squares, P99))
        )  # fmt: skip


def not_exceeded_in_columns(values: Floats, first: Sequence[int], share: float) -> list[float]:
    """`not_exceeded` of each column of finite values, shape (n, m), from its row `first` on.

    What is common to all columns is compared at once: each lies scattered in memory, so that alone it takes longer.
    """
    steps, lanes = values.shape
    common = max(first) + (steps - max(first)) % _TOGETHER
    rest, guess = values[common:], np.full(lanes, math.inf)
    if len(rest):
        guess = likely_below(rest, share)
    places = np.flatnonzero(rest.reshape(-1, _TOGETHER * lanes) >= np.tile(guess, _TOGETHER))
    columns = (places % lanes).astype(np.uint8)
    large = rest.reshape(-1)[places[np.argsort(columns, kind="stable")]]
    ends = np.concatenate(([0], np.cumsum(np.bincount(columns, minlength=lanes))))
    found = []
    for column, begun in enumerate(first):
        head, of_rest = values[begun:common, column], large[ends[column] : ends[column + 1]]
        candidates = np.concatenate((of_rest, head[head >= of_rest.min(initial=math.inf)]))
        found.append(_of_largest(candidates, values[begun:, column], share))
    return found
