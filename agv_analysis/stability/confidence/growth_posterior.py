"""How sure a mean-square verdict is where the link is a Gilbert channel: from transitions to the growth of E[e^2].

The posterior of (p, r) given the transitions is one of the growth, by `gilbert_growths` on a grid of (log p, log r)
that spans it, linear between. What decides is on which side of the border they lie: for each p of the grid the r* below
which outages are too long, linear between in logarithms. All growths are moved such that they meet
`mean_square.lap_growth` at the estimate of the whole recording.

The probability is that of the posterior, or of one more pessimistic by about an outage, whichever is less sure: of
recordings of a link just beyond the border less than 5 % are then called stable, however few outages they hold.

How much longer to record: until the posterior that the same transitions would leave, had they been so many times as
many, is sure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from agv_analysis.link.markov_channel import gilbert_elliott
from agv_analysis.link.transitions import Transitions, interval_of
from agv_analysis.run import Floats
from agv_analysis.stability import mean_square
from agv_analysis.stability.confidence.gilbert_growth import gilbert_growths
from agv_analysis.stability.linear_loop import MARGINAL, LinearLoop

SURE = 0.95
"""Probability from which on a word is given."""

_COARSE = (0.0005, 0.025, 0.5, 0.975, 0.9995)
_FINE = (0.0005, 0.025, 0.1, 0.3, 0.6, 0.9, 0.975, 0.9995)
"""Quantiles of the posterior that the grid's lines go through."""

_BISECTIONS = 6

_POSTERIORS = (Transitions.posterior, Transitions.pessimistic_posterior)

_RARER = 1e-3
"""A further line at so many times the smallest p: what a longer recording without an outage would leave."""

_LONGEST = 300.0
"""Longest recording that is proposed, in lengths of the one that there is: beyond, the link is at the border."""


@dataclass(frozen=True)
class GrowthPosterior:
    """The growth of E[e^2] over the Gilbert channels that a recording leaves possible."""

    loop: LinearLoop
    transitions: Transitions
    move: float = 0.0
    """As of `moved`: what is added to all growths."""

    @cached_property
    def estimate(self) -> float:
        """Growth (logarithm, per step) under the estimate of (p, r)."""
        return float(self._growths(*_as_arrays(self.transitions))[0])

    @cached_property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the growth, about the estimate."""
        low, high = interval_of(self.transitions, lambda p, r: _bilinear(np.log(p), np.log(r), *self._grid))
        return min(self.estimate, low), max(self.estimate, high)

    @property
    def probability_stable(self) -> float:
        """P(E[e^2] dies out | data), cautiously."""
        return self._probability(self.transitions)

    def times_longer(self) -> float | None:
        """How many times as long a recording like this one must be for a sure word; None: no length would do."""
        if not self._decided_by(_LONGEST):
            return None
        low, high = 1.0, _LONGEST
        while high > 1.1 * low:
            middle = math.sqrt(low * high)
            low, high = (low, middle) if self._decided_by(middle) else (middle, high)
        return high

    def _decided_by(self, factor: float) -> bool:
        return not 1.0 - SURE < self._probability(self.transitions.times(factor)) < SURE

    def _probability(self, transitions: Transitions) -> float:
        """That of the less sure of two posteriors, 1/2 if they do not agree."""
        stable = [self._share_above_border(*draws(transitions)) for draws in _POSTERIORS]
        return sorted((*stable, 0.5))[1]

    def _share_above_border(self, p: Floats, r: Floats) -> float:
        return float(np.mean(np.log(r) > np.interp(np.log(p), self._grid[0], self._border)))

    @cached_property
    def _border(self) -> Floats:
        """log r* at the grid's p: above it E[e^2] dies out; by false position (Illinois) between the grid's lines."""
        log_p, log_r, growths = self._grid
        grows = growths >= MARGINAL
        border = np.where(grows[:, -1], 1.0, log_r[0] - 1e-9)
        rows = np.flatnonzero(grows[:, 0] & ~grows[:, -1])
        if not len(rows):
            return border
        last = grows.shape[1] - 1 - np.argmax(grows[rows, ::-1], axis=1)
        low, high, f_low, f_high = log_r[last], log_r[last + 1], growths[rows, last], growths[rows, last + 1]
        for _ in range(_BISECTIONS):
            at = (low * f_high - high * f_low) / (f_high - f_low)
            f = self._growths(np.exp(log_p[rows]), np.exp(at))
            above = f < MARGINAL
            f_low, f_high = np.where(above, 0.5 * f_low, f), np.where(above, f, 0.5 * f_high)
            low, high = np.where(above, low, at), np.where(above, at, high)
        border[rows] = at
        return border

    @cached_property
    def _grid(self) -> tuple[Floats, Floats, Floats]:
        """Nodes log p and log r, and the growths, shape (nodes of p, nodes of r)."""
        p, r = np.hstack([draws(self.transitions) for draws in _POSTERIORS])
        grid = self._growths_at(np.quantile(p, _COARSE), np.quantile(r, _COARSE))
        if np.ptp(np.sign(grid[2])) == 0.0:
            return grid
        rarer = [float(p.min()) * _RARER] if self.transitions.to_lost < 3 else []
        return self._growths_at(np.append(rarer, np.quantile(p, _FINE)), np.quantile(r, _FINE))

    def _growths_at(self, p: Floats, r: Floats) -> tuple[Floats, Floats, Floats]:
        at_p, at_r = (axis.ravel() for axis in np.meshgrid(p, r, indexing="ij"))
        return np.log(p), np.log(r), self._growths(at_p, at_r).reshape(len(p), len(r))

    def _growths(self, p: Floats, r: Floats) -> Floats:
        return gilbert_growths(self.loop, p, r) + self.move


def moved(loop: LinearLoop, transitions: Transitions) -> float:
    """What the mean over a few places of the lap leaves out of the growth per step, at the estimate of (p, r)."""
    if loop.is_constant or transitions.to_lost == 0:
        return 0.0
    exact = mean_square.lap_growth(loop, gilbert_elliott(*transitions.estimate)) / loop.steps
    return exact - float(gilbert_growths(loop, *_as_arrays(transitions))[0]) if np.isfinite(exact) else 0.0


def _as_arrays(transitions: Transitions) -> tuple[Floats, Floats]:
    p, r = transitions.estimate
    return np.array([p]), np.array([r])


def _bilinear(x: Floats, y: Floats, x_nodes: Floats, y_nodes: Floats, values: Floats) -> Floats:
    """Linear between the nodes of a grid, constant beyond it, at points of shape (n,)."""
    i, s = _between(x, x_nodes)
    j, t = _between(y, y_nodes)
    below = (1.0 - t) * values[i, j] + t * values[i, j + 1]
    above = (1.0 - t) * values[i + 1, j] + t * values[i + 1, j + 1]
    return np.asarray((1.0 - s) * below + s * above)


def _between(x: Floats, nodes: Floats) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], Floats]:
    """Index of the node below each point, and how far it is to the next one, in [0, 1]."""
    i = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, len(nodes) - 2)
    width = nodes[i + 1] - nodes[i]
    return i, np.clip((x - nodes[i]) / np.where(width > 0.0, width, 1.0), 0.0, 1.0)
