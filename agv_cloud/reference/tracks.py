"""Reference tracks, each given by its speeds: (v_r(k) [m/s], w_r(k) [rad/s]) at step k of a lap of N steps.

Scalar functions of (k, N, T_s, speed); `reference` integrates them to postures with the plant's own recursion. All
repeat after N steps. `TRACKS` names them all; a track from a file is in `track_file`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

Speeds = tuple[float, float]
Track = Callable[[int, int, float, float], Speeds]

J0_FIRST_ZERO = 2.404825557695773
"""First zero j01 of the Bessel function J0."""


def paper(k: int, n: int, ts: float, speed: float) -> Speeds:
    """The paper's track: a closed oval, 100 m and 18.07 m x 42.45 m for a lap of 100 s; it has a speed of its own.

    v_r = 1 - 0.5 cos(8 pi k / N),  w_r = (2 pi / T) (1 - cos(4 pi k / N)).
    """
    return (
        1.0 - 0.5 * math.cos(8.0 * math.pi * k / n),
        2.0 * math.pi / (n * ts) * (1.0 - math.cos(4.0 * math.pi * k / n)),
    )


def line(k: int, n: int, ts: float, speed: float) -> Speeds:
    """A straight line: the track on which the paper's stability test cannot see outages."""
    return speed, 0.0


def circle(k: int, n: int, ts: float, speed: float) -> Speeds:
    """One full circle to the left per lap, of radius speed T / (2 pi)."""
    return speed, 2.0 * math.pi / (n * ts)


def eight(k: int, n: int, ts: float, speed: float) -> Speeds:
    """A figure of eight that closes: w_r = A cos(2 pi k / N), A = 2 j01 sin(pi / N) / T_s.

    The heading swings by j01 about its mean, and the mean of cos(j01 sin) is J0(j01) = 0: no net displacement.
    """
    amplitude = 2.0 * J0_FIRST_ZERO * math.sin(math.pi / n) / ts
    return speed, amplitude * math.cos(2.0 * math.pi * k / n)


def warehouse(k: int, n: int, ts: float, speed: float) -> Speeds:
    """A rectangle with clothoid corners and a full stop in the middle of either long side.

    Both halves of the lap are the same motion, turned by pi against each other, so the lap closes exactly; a lap of odd
    N stands still for one step more at its second stop. Half a lap: straight with a stop (40 %), corner (15 %),
    straight (30 %), corner (15 %). In a corner the curvature rises and falls linearly; sampled at interval midpoints
    its sum is pi / 2 exactly.
    """
    half = n // 2
    corner = 2 * max(1, 3 * half // 40)
    aisle = 4 * half // 10
    j = k % n
    if j >= half:
        j -= half
        if n % 2 == 1 and j >= aisle // 2:
            if j == aisle // 2:
                return 0.0, 0.0
            j -= 1
    if j < aisle:
        return speed * _stop_and_go((j + 0.5) / aisle), 0.0
    if j < aisle + corner:
        return speed, _corner_rate(j - aisle, corner, ts)
    if j < half - corner:
        return speed, 0.0
    return speed, _corner_rate(j - (half - corner), corner, ts)


def _stop_and_go(fraction: float) -> float:
    """Speed over one aisle, relative to cruise: 1, down to 0 between 0.45 and 0.55, and up to 1 again, smoothly."""
    distance = abs(fraction - 0.5)
    if distance <= 0.05:
        return 0.0
    if distance >= 0.15:
        return 1.0
    return 0.5 - 0.5 * math.cos(math.pi * (distance - 0.05) / 0.1)


def _corner_rate(j: int, samples: int, ts: float) -> float:
    """Turn rate [rad/s] at sample j of a quarter turn to the left with triangular curvature."""
    return math.pi / (samples * ts) * (1.0 - abs(2.0 * (j + 0.5) / samples - 1.0))


TRACKS: dict[str, Track] = {"paper": paper, "line": line, "circle": circle, "eight": eight, "warehouse": warehouse}
