"""Outcomes of links in plain numpy, beside the product's own channels: many recordings at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Outcomes = NDArray[np.bool_]


def gilbert(p: float, r: float, slots: int, recordings: int, seed: int) -> Outcomes:
    """Stationary two-state chains, True where lost: shape (recordings, slots)."""
    rng = np.random.default_rng(seed)
    lost = np.empty((slots, recordings), dtype=bool)
    now = rng.random(recordings) < p / (p + r)
    for row, u in zip(lost, rng.random((slots, recordings)), strict=True):
        row[:] = now
        now = np.where(now, u >= r, u < p)
    return np.ascontiguousarray(lost.T)


def series(part: Callable[[], Outcomes], slots: int) -> Outcomes:
    """Random parts, one after the other, cut at `slots`."""
    parts: list[Outcomes] = []
    while sum(map(len, parts)) < slots:
        parts.append(part())
    return np.concatenate(parts)[:slots]


def gap_and_outage(gap: float, outage: float) -> Outcomes:
    """So many received slots, then so many lost ones."""
    return np.concatenate((np.zeros(int(gap), dtype=bool), np.ones(int(outage), dtype=bool)))
