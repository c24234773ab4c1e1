"""Ages by receive time: what a receiver held when a step was due, from the log times of a recording.

Theory of operation. A log time is an instant of the recorder's clock, a stamp one of the AGV's. Their difference is the
offset of the clocks plus the time that a message was under way, so only differences of it are used: the least delay is
taken for none at all. Two clocks drift apart, so the least delay is a line below all delays, with a slope of at most
`MAX_DRIFT`; what rises faster is delay. Hence ages say nothing of a delay that was always there, and do not depend on
the offset.

Each step lasts one sampling period. A message that comes before its own step has ended is in time, as one that comes
in its own slot is: jitter below one period changes no age. One that comes m periods later makes what is held m steps
older until then.

No file and no message type in here: steps and log times go in, ages come out.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats

Steps = NDArray[np.int64]

MAX_DRIFT = 500e-6
"""Most that the rates of two clocks differ: two quartzes of 100 ppm, or NTP at its fastest, 500 ppm."""

MAX_RATE = 0.01
"""Stamps whose rate differs by more than this from that of the log times are of another kind of time."""

_BLOCKS = 512
"""The line lies below the least delay of each of so many blocks of messages."""


class ClockLine(NamedTuple):
    """Least delay over time: log time of what was sent at a stamp and was not delayed, `first_ns` being a stamp."""

    first_ns: int
    offset_ns: int
    drift: float
    rate: float
    """Slope of the line if it had no limit."""

    def log_times(self, stamps: Steps) -> Steps:
        """Log time [ns] of messages with these stamps [ns] without delay."""
        since = stamps - self.first_ns
        return np.asarray(stamps + self.offset_ns + np.floor(self.drift * since).astype(np.int64))


def clock_line(stamps: Steps, log_times: Steps) -> ClockLine:
    """The line below all delays, from stamps [ns] and log times [ns], shape (M,), M >= 1."""
    first, base = int(stamps[0]), int(log_times[0] - stamps[0])
    since, delays = (stamps - first).astype(np.float64), (log_times - stamps - base).astype(np.float64)
    rate = _slope_below(since, delays)
    drift = min(max(rate, -MAX_DRIFT), MAX_DRIFT)
    return ClockLine(first, base + int(np.floor(np.min(delays - drift * since))), drift, rate)


def _slope_below(x: Floats, y: Floats) -> float:
    """Slope of the highest line below all points (x, y), on average: the edge of their hull at the mean x."""
    order = np.argsort(x, kind="stable")
    blocks = np.array_split(order, min(_BLOCKS, len(order)))
    hull: list[tuple[float, float]] = []
    for index in (int(block[np.argmin(y[block])]) for block in blocks):
        point = (float(x[index]), float(y[index]))
        while len(hull) > 1 and _is_above(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    middle = float(np.mean(x))
    for (x_0, y_0), (x_1, y_1) in pairwise(hull):
        if x_1 >= middle and x_1 > x_0:
            return (y_1 - y_0) / (x_1 - x_0)
    return 0.0


def _is_above(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    """Does `b` lie on or above the line from `a` to `c`?"""
    return (b[1] - a[1]) * (c[0] - a[0]) >= (c[1] - a[1]) * (b[0] - a[0])


def usable_from(steps: Steps, log_times: Steps, ends: Steps) -> Steps:
    """First step at which each message can be used: its own, or the one in which it came; len(ends) if none.

    `ends`, shape (N,), not decreasing: log time at which each of the steps 0 .. N - 1 ends.
    """
    return np.asarray(np.maximum(steps, np.searchsorted(ends, log_times, side="right")))


def newest_held(steps: Steps, usable: Steps, count: int) -> Steps:
    """Step of the freshest message that is held at each of `count` steps, shape (count,); -1 before the first."""
    held = np.full(count, -1, dtype=np.int64)
    within = (usable < count) & (steps >= 0)
    np.maximum.at(held, usable[within], steps[within])
    return np.maximum.accumulate(held)


def newest_at(steps: Steps, log_times: Steps, instants: Steps) -> Steps:
    """Step of the freshest message with a log time before each of `instants`; -1 if there is none."""
    order = np.argsort(log_times, kind="stable")
    newest = np.concatenate(([-1], np.maximum.accumulate(steps[order])))
    return np.asarray(newest[np.searchsorted(log_times[order], instants, side="left")])


def says_nothing(stamps: Steps, log_times: Steps) -> str:
    """Why log times do not say when messages came; empty if they do. Shapes (M,)."""
    if np.array_equal(stamps, log_times):
        return "log times are the stamps"
    if len(log_times) > 1 and log_times.min() == log_times.max():
        return "all log times are the same"
    return ""
