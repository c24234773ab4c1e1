"""When the messages of a topic came, and what its stamps say beside the log times."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags.layout import LOG_TIME
from agv_analysis.recordings.receive_times import clock_line
from agv_ros.stamps import NS_PER_S

Times = NDArray[np.int64]

_GAP = 1.5
"""A period of more than this many times the median one is a gap."""

_FEWEST = 10
"""Messages from which on periods are compared with their median, and stamps with log times."""

_SILENCE_S = 1.0
_SILENCE = 20.0
"""No message of any topic for longer than this, and than this many times the mean distance, is a silence."""


class Periods(NamedTuple):
    """Log times between messages that follow each other; None where there are too few messages."""

    first: float | None = None
    """Log time of the first message [s]."""
    last: float | None = None
    rate: float | None = None
    """Messages per second between the first and the last."""
    period: float | None = None
    """Median [s]."""
    period_jitter: float | None = None
    """Standard deviation of the periods that are not gaps [s]."""
    longest_gap: float | None = None
    """Longest period [s]."""
    longest_gap_at: float | None = None
    """Log time at which it begins [s]."""
    gaps: int | None = None
    """Periods longer than 1.5 times the median: at least one message of a periodic topic is missing."""


def periods_of(log_times: Times) -> Periods:
    """Periods of a topic with these log times [ns], in any order."""
    if not len(log_times):
        return Periods()
    times = np.sort(log_times)
    steps = np.diff(times) / NS_PER_S
    first, last = float(times[0]) / NS_PER_S, float(times[-1]) / NS_PER_S
    if not len(steps):
        return Periods(first, last, gaps=0)
    span, median, longest = float(steps.sum()), float(np.median(steps)), int(np.argmax(steps))
    is_gap = steps > _GAP * median if median > 0 and len(times) >= _FEWEST else np.zeros(len(steps), np.bool_)
    return Periods(
        first, last, len(steps) / span if span else None, median, float(np.std(steps[~is_gap])),
        float(steps[longest]), float(times[longest]) / NS_PER_S, int(np.count_nonzero(is_gap)),
    )  # fmt: skip


class StampClock(NamedTuple):
    """The clock of a topic's stamps, held against that of the log times."""

    stamped: int
    """Messages with a stamp that is not zero."""
    offset: float
    """Log time minus stamp [s], median: difference of the clocks and time under way together."""
    drift: float
    """How much faster the clock of the log times runs [s/s]: slope of the line below all offsets."""
    spread: float
    """Distance of the 5 % and the 95 % quantile of the offsets, once the drift is taken out [s]."""


def stamp_clock(rows: NDArray[np.void]) -> StampClock | None:
    """The clock of `header.stamp`, or of the first other stamp that a message has; None without enough of them."""
    names = rows.dtype.names or ()
    path = next((name[:-4] for name in names if name.endswith("stamp.sec") and rows.dtype[name].shape == ()), None)
    if path is None or f"{path}.nanosec" not in names:
        return None
    stamps = rows[f"{path}.sec"].astype(np.int64) * NS_PER_S + rows[f"{path}.nanosec"]
    log_times = np.ascontiguousarray(rows[LOG_TIME])
    is_stamped = stamps != 0
    stamps, log_times = stamps[is_stamped], log_times[is_stamped]
    if len(stamps) < _FEWEST or stamps.min() == stamps.max():
        return None
    line = clock_line(stamps, log_times)
    offsets = (log_times - stamps).astype(np.float64)
    left = offsets - line.rate * (stamps - stamps[0])
    low, high = np.percentile(left, [5.0, 95.0])
    return StampClock(len(stamps), float(np.median(offsets)) / NS_PER_S, line.rate, float(high - low) / NS_PER_S)


class Silence(NamedTuple):
    """A time without any message on any topic; log times [s]."""

    begin: float
    duration: float


def silences(log_times: Times) -> tuple[Silence, ...]:
    """Times without a message, from the log times [ns] of all topics together, the longest first."""
    times = np.sort(log_times)
    steps = np.diff(times) / NS_PER_S
    if not len(steps):
        return ()
    places = np.flatnonzero((steps > _SILENCE_S) & (steps > _SILENCE * float(np.mean(steps))))
    places = places[np.argsort(-steps[places], kind="stable")]
    return tuple(Silence(float(times[i]) / NS_PER_S, float(steps[i])) for i in places.tolist())
