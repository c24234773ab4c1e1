"""Loops at constant speed with a closed form, and how much each of many of them can take.

On a straight track margins are closed forms. On a curve, of all points at once, the largest constant delay comes from
the spectral radius of the lifted system, by bisection, and the largest repeated burst from the maps between receptions
M_(L+1) = F M_L + G, one burst length after the other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats
from agv_analysis.stability.joint_spectral_radius import largest_n_across, largest_n_along
from agv_analysis.stability.kanayama_delay import critical_delay_across, critical_delay_along, radii_of
from agv_analysis.stability.linearisation import step_matrices

Ints = NDArray[np.int64]

LIMIT = 100_000
"""Largest n that is looked for; a loop that is stable with it is listed with this number."""

LONGEST = 1000
"""Longest repeated bursts [slots] that are tried on a curve."""


class Point(NamedTuple):
    """A loop at constant speed, its fields the axes that a map can have."""

    kx: float
    """K_x [1/s]."""
    ky: float
    """K_y [1/m^2]."""
    ktheta: float
    """K_theta [1/m]."""
    ts: float
    """T_s [s]."""
    v: float
    """v_r [m/s]."""
    curvature: float
    """w_r / v_r [1/m]."""

    @property
    def a(self) -> float:
        """T_s K_x."""
        return self.ts * self.kx


def largest_repeated_burst(point: Point) -> int:
    """Largest n such that bursts of n losses, again and again, contract on a straight track."""
    along = largest_n_along(point.a)
    if along is None:  # K_x = 0: what is off along the track stays off
        return -1
    across = LIMIT if point.v == 0.0 else largest_n_across(point.v, point, point.ts)
    return min(along, LIMIT if across is None else across)


def largest_repeated_bursts(points: Sequence[Point]) -> Ints:
    """Largest n up to which bursts of n losses, again and again, contract at each point, shape (points,)."""
    n = np.array([largest_repeated_burst(point) for point in points], dtype=np.int64)
    curved = np.flatnonzero([point.ts * point.v * point.curvature != 0.0 for point in points])
    n[curved] = _first_refuted([points[i] for i in curved.tolist()]) - 1
    return n


def _first_refuted(points: Sequence[Point]) -> Ints:
    """Smallest n whose repetition does not die out at each point, LIMIT + 1 where none up to LONGEST does so."""
    found, going = np.full(len(points), LIMIT + 1), np.arange(len(points))
    if not len(points):
        return found
    at: Any = Point(*np.array(points).T)  # each field an array
    F, G = step_matrices(at.v, at.v * at.curvature, at, at.ts)
    M = F + G
    for n in range(LONGEST + 1):
        refuted = ~_are_inside(M)
        found[going[refuted]] = n
        going, F, G, M = going[~refuted], F[~refuted], G[~refuted], M[~refuted]
        if not len(going):
            break
        M = F @ M + G
    return found


def _are_inside(M: Floats) -> NDArray[np.bool_]:
    """Are all eigenvalues of each matrix, shape (points, 3, 3), inside the unit circle?

    By Jury's test of z^3 + a z^2 + b z + c (Theory and Application of the z-Transform Method, 1964).
    """
    trace, c = np.trace(M, axis1=1, axis2=2), -np.linalg.det(M)
    a, b = -trace, 0.5 * (trace**2 - np.trace(M @ M, axis1=1, axis2=2))
    return np.asarray((np.abs(c) < 1.0) & (np.abs(a + c) < 1.0 + b) & (np.abs(b - a * c) < 1.0 - c * c))


def largest_delays(points: Sequence[Point]) -> Ints:
    """Largest constant n that is stable at each point, shape (points,)."""
    n = np.array([_on_a_straight_track(point) for point in points], dtype=np.int64)
    kx, ky, ktheta, ts, v, curvature = np.array(points).T
    a, step = ts * kx, ts * v
    curved = np.flatnonzero(step * curvature)
    if len(curved):
        numbers = (a, step * ktheta, step * step * ky, step * curvature, v == 0.0)
        n[curved] = _on_curves(n[curved], *(values[curved] for values in numbers))
    return n


def _on_a_straight_track(point: Point) -> int:
    along = critical_delay_along(point.a)
    across = critical_delay_across(abs(point.v), point, point.ts) if point.v >= 0.0 else 0.0
    # A delay that is a whole number is marginal itself; 1e-9 is more than rounding makes of it.
    return max(-1, math.ceil(min(along, across, LIMIT) - 1e-9) - 1)


def _on_curves(guess: Ints, *numbers: NDArray[Any]) -> Ints:
    """By doubling from what a straight track allows, which is nearly right, then bisection, of all points at once."""

    def are_stable(n: Ints, at: Ints) -> NDArray[np.bool_]:
        return np.asarray(radii_of(n[at].astype(np.float64), *(values[at] for values in numbers)) < 1.0 - 1e-12)

    low, high = np.full_like(guess, -1), guess + 1
    going = np.arange(len(guess))
    while len(going):
        going = going[are_stable(high, going) & (high[going] < LIMIT)]
        low[going], high[going] = high[going], np.minimum(2 * high[going] + 1, LIMIT)
    going = np.flatnonzero((guess >= 0) & (low < guess))
    stable = are_stable(guess, going)
    low[going[stable]], high[going[~stable]] = guess[going[stable]], guess[going[~stable]]
    while len(going := np.flatnonzero(high - low > 1)):
        middle = (low + high) // 2
        stable = are_stable(middle, going)
        low[going[stable]], high[going[~stable]] = middle[going[stable]], middle[going[~stable]]
    return low
