"""The last minutes of a loop by step, in arrays of a fixed size."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats

COLUMNS = ("x", "y", "theta", "x_e", "y_e", "theta_e", "v", "w", "age", "lost", "command_lost")
"""Pose [m, m, rad], tracking error [m, m, rad], the command that acts [m/s, rad/s], age of the edge's pose [steps], and
whether the pose and the command of the step were lost (0 or 1). NaN: not seen."""

_PLACE = {name: i for i, name in enumerate(COLUMNS)}


class StepRing:
    """What was seen of each of the last `capacity` steps; of an earlier step nothing is known any more."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._steps = np.full(capacity, -1, dtype=np.int64)
        self._values = np.full((capacity, len(COLUMNS)), math.nan)
        # Single elements are read and written through views: several times faster than through numpy.
        self._step_at = self._steps.data.cast("B").cast("q")
        self._value_at = self._values.reshape(-1).data.cast("B").cast("d")

    def put(self, k: int, first: str, *values: float) -> None:
        """Keep values of step k >= 0, in the columns from `first` on."""
        row = k % self._capacity
        if self._step_at[row] != k:
            if k < self._step_at[row]:
                return
            self._step_at[row] = k
            self._values[row] = math.nan
        for place, value in enumerate(values, row * len(COLUMNS) + _PLACE[first]):
            self._value_at[place] = value

    def rows(self, begin: int, end: int) -> Floats:
        """What is known of the steps begin .. end - 1, shape (end - begin, columns)."""
        k, first = np.arange(begin, end, dtype=np.int64), begin % self._capacity
        # A slice, which is faster than single rows, unless the steps go on at the beginning of the arrays.
        rows = slice(first, first + len(k)) if first + len(k) <= self._capacity else k % self._capacity
        found = np.array(self._values[rows])
        found[self._steps[rows] != k] = math.nan
        return found

    def seen(self, column: str, end: int) -> tuple[NDArray[np.int64], Floats]:
        """The steps before `end` of which a column is known, increasing, and its values, both of shape (N,)."""
        k = np.arange(max(0, end - self._capacity), end, dtype=np.int64)
        values = self._values[k % self._capacity, _PLACE[column]]
        known = (self._steps[k % self._capacity] == k) & ~np.isnan(values)
        return k[known], values[known]
