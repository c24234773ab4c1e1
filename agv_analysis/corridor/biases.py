"""What an outage does to an AGV that has no deviation: the b_i of `outer_tube`, by the nonlinear loop."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.corridor.lap_loop import LapLoop, outage
from agv_analysis.run import Floats
from agv_analysis.stability.linear_loop import LinearLoop

_LARGEST_BIAS = 3_000_000
"""Rows of the b_i that are computed; in a longer lap those between are interpolated."""


class Biases(NamedTuple):
    """b_i, and the errors of the loss-free motion."""

    rows: Floats
    """b_i of outages that begin at every so many steps of the lap, shape (., n + 2, 3); entry i: i slots after a
    reception."""
    every: int
    nominal: Floats
    """Shape (R, 3)."""

    def at(self, steps: NDArray[np.int64]) -> Floats:
        """Of outages that begin at these steps, which are interpolated linearly, shape (S, n + 2, 3)."""
        lap, found = len(self.nominal), np.empty((len(steps), *self.rows.shape[1:]))
        for row, step in enumerate(steps.tolist()):
            before, after, share = neighbours(step % lap, self.every, len(self.rows), lap)
            found[row] = (1.0 - share) * self.rows[before] + share * self.rows[after]
        return found

    def up_to(self, n: int) -> Biases:
        """Of outages of no more than `n` slots: they are as longer ones begin."""
        return self._replace(rows=np.ascontiguousarray(self.rows[:, : n + 2]))


def neighbours(step: int, every: int, rows: int, lap: int) -> tuple[int, int, float]:
    """(row before a step, row after it, share of the second) where there is a row for every so many steps of a lap."""
    before = min(step // every, rows - 1)
    width = every if before + 1 < rows else lap - before * every
    return before, (before + 1) % rows, (step - before * every) / width


def biases(loop: LapLoop, linear: LinearLoop, n: int) -> Biases:
    """Of outages of `n` slots."""
    lap = 1 if linear.is_constant else loop.steps
    every = max(1, math.ceil(lap * (n + 2) / _LARGEST_BIAS))
    _, (free,) = loop.excursions(np.zeros(lap + n + 2, dtype=np.bool_), loop.steps, kept=lap + n + 2, follow=False)
    _, lost = loop.excursions(outage(n), loop.steps if linear.is_constant else every, kept=n + 2, follow=False)
    for row, path in enumerate(lost):
        path -= free[row * every : row * every + n + 2]
    return Biases(lost, every, np.ascontiguousarray(free[:lap]))
