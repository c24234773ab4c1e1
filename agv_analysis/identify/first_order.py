"""The motion of a first-order lag behind a dead time, integrated, for commands that are held until the next one.

    lag * dy/dt = u(t - dead_time) - y,    s(t) = integral of y

A change of u by D at the instant t_j adds D (tau - lag + lag exp(-tau / lag)) to s(t), tau = t - t_j - dead_time > 0.
Sums over all changes are cumulative sums, but for the exponentials, which are a first-order recursion.
"""

from __future__ import annotations

import numpy as np

from agv_analysis.identify.linear_recursion import Recursion
from agv_analysis.run import Floats


class HeldCommand:
    """A command u [m/s or rad/s] that is held from each instant [s] to the next; shapes (M,), instants rise."""

    def __init__(self, instants: Floats, values: Floats) -> None:
        self.instants = instants
        self._changes = np.diff(values, prepend=values[:1])
        self._level = values
        self._moment = np.cumsum(self._changes * instants)
        self._first = float(values[0])

    def positions(self, t: Floats, lag: float, dead_times: Floats) -> Floats:
        """s at the instants t [s], up to a constant, for each dead time [s], shape (D, N).

        Before the first command its value counts, as if it had been held for long.
        """
        moved = t - dead_times[:, np.newaxis]
        row = np.maximum(np.searchsorted(self.instants, moved, side="right") - 1, 0)
        s = self._level[row] * (moved - lag) - self._moment[row]
        if lag > 0.0:
            fading = Recursion(np.exp(-np.diff(self.instants, prepend=self.instants[:1]) / lag))(self._changes)
            since = np.maximum(moved - self.instants[row], 0.0)
            s += lag * fading[row] * np.exp(-since / lag)
        return np.asarray(s)
