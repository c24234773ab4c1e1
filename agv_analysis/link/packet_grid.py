"""Every packet of a numbered measurement, put in its place as the records of a file come in.

A packet takes the bytes of its figures, and no record is kept beside it: a file of any number of lines is read in the
memory that what it says takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.large_arrays import PART, Column, column_of, parts, release
from agv_analysis.link.measurement import LOST, RECEIVED, Codes, MeasurementError
from agv_analysis.run import Floats
from agv_ros.counted import counted

Ints = NDArray[np.int64]

_SPARSE, _MOST_MISSING = 1000, 1_000_000
"""A series of numbered packets may lack so many for each that is there, and so many more."""


class NumbersError(MeasurementError):
    """Numbers that can be none of a sequence; the text does not name the file."""


class Grid(NamedTuple):
    """Every packet of a numbered measurement, received or not; shapes (N,)."""

    sent: Floats
    """When each was sent [s] since the first."""
    outcome: Codes
    delays: tuple[Floats, ...]
    """[s], NaN where not known."""
    duplicates: int
    reordered: int


class PacketGrid:
    """The packets of a measurement, by their numbers, as their records come in. Of several records the first counts."""

    def __init__(self, delays: int = 0) -> None:
        """`delays`: how many delays a record has."""
        self._received = Column(np.bool_)
        self._delays = tuple(Column() for _ in range(delays))
        self._sent: Column | None = None
        self._origin: int | None = None
        self._newest = -(2**63)
        self.first, self.last = 2**63 - 1, -(2**63)
        """The smallest and the largest number that were mentioned."""
        self.records = self.dated = self.duplicates = self.reordered = 0
        """Numbers given; packets that say when they were sent, that came again, that came behind a later one."""

    def mention(self, seq: Ints) -> None:
        """Numbers of packets that were sent, received or not, shape (n,).

        Raises MeasurementError for numbers that can be none of a sequence.
        """
        if not len(seq):
            return
        self.first, self.last = min(self.first, int(seq.min())), max(self.last, int(seq.max()))
        self.records += len(seq)
        _check(self.first, self.last, self.records)
        if self._origin is None:
            self._origin = self.first
        elif self.first < self._origin:
            self._begin_at(self.first)
        for column in self._columns:
            column.reach(self.last + 1 - self._origin)

    def add(self, seq: Ints, delays: Sequence[Floats], sent: Floats | None = None) -> None:
        """Packets that came back, in the order in which the file has them: numbers, delays [s], when sent [s].

        All of shape (n,), NaN where unknown; `sent` None: none of these lines says it. Raises MeasurementError.
        """
        self.mention(seq)
        if not len(seq):
            return
        if sent is not None and self._sent is None:
            self._sent = Column()
            self._sent.reach(len(self._received))
            for part in parts(len(self._received), self._sent.values):
                self._sent.values[part] = np.nan
        rows = self._rows(seq)
        fresh = np.flatnonzero(~self._received.values[rows])
        if np.any(np.diff(rows) <= 0):  # twice in this very part, or out of order
            fresh = fresh[np.sort(np.unique(rows[fresh], return_index=True)[1])]
        self.duplicates += len(rows) - len(fresh)
        rows, numbers = rows[fresh], seq[fresh]
        newest = np.maximum.accumulate(np.append(self._newest, numbers))
        self.reordered += int(np.count_nonzero(numbers < newest[1:]))
        self._newest = int(newest[-1])
        self._received.values[rows] = True
        for column, values in zip(self._delays, delays, strict=True):
            column.values[rows] = values[fresh]
        if self._sent is not None:
            stamps = np.full(len(rows), np.nan) if sent is None else sent[fresh]
            self._sent.values[rows] = stamps
            self.dated += int(np.count_nonzero(~np.isnan(stamps)))
        release(*(column.values for column in self._columns))

    def whole(self, interval: float, first: int | None = None, last: int | None = None) -> Grid:
        """All packets from number `first` to number `last`, by default those mentioned; without a record they are lost.

        Times that the file does not have are interpolated by number; without any, packets are `interval` [s] apart.
        Raises MeasurementError as `mention`.
        """
        first, last = self.first if first is None else first, self.last if last is None else last
        _check(first, last, self.records)
        self._origin = first if self._origin is None else self._origin
        if first < self._origin:
            self._begin_at(first)
        rows = slice(first - self._origin, last + 1 - self._origin)
        for column in self._columns:
            column.reach(rows.stop)
        received = self._received.values[rows]
        count, delays = len(received), tuple(column.values[rows] for column in self._delays)
        is_dated = self._sent is not None and self.dated >= 2
        dated = (self._sent.values[rows],) if self._sent is not None and is_dated else ()
        for column in (*delays, *dated):
            for part in parts(count, column, received):
                np.copyto(column[part], np.nan, where=~received[part])
        if dated:
            (sent,) = dated
            interpolate(sent)
        else:
            sent = column_of((interval * np.arange(part.start, part.stop) for part in parts(count)), np.float64)
        outcomes = (np.where(received[part], RECEIVED, LOST) for part in parts(count, received))
        return Grid(sent, column_of(outcomes, np.int8), delays, self.duplicates, self.reordered)

    @property
    def _columns(self) -> tuple[Column, ...]:
        return (self._received, *self._delays, *(() if self._sent is None else (self._sent,)))

    def _rows(self, seq: Ints) -> Ints:
        assert self._origin is not None, "numbers were mentioned"
        return seq - self._origin

    def _begin_at(self, first: int) -> None:
        """Make room for numbers before the first one so far."""
        assert self._origin is not None, "numbers were mentioned"
        more, self._origin = self._origin - first, first
        for column in self._columns:
            count = len(column)
            column.reach(count + more)
            values = column.values
            for part in reversed(list(parts(count))):
                values[part.start + more : part.stop + more] = values[part]  # numpy minds the overlap
                release(values)
            for part in parts(more, values):
                values[part] = 0


def _check(first: int, last: int, records: int) -> None:
    if last - first + 1 > _SPARSE * records + _MOST_MISSING:
        raise NumbersError(
            f"numbers go from {first} to {last}, and {counted(records, 'packet has', 'packets have')} one: these "
            "are not sequence numbers, or one "
            "of them is broken"
        )


def interpolate(times: Floats) -> None:
    """In place: times [s] since the first, shape (N,), increasing, those that are NaN by their number.

    Before the first that is known, and behind the last, packets are as far apart as on average.
    """
    begin, end = next_known(times, 0), len(times) - 1 - next_known(times[::-1], 0)
    step, first, last = (times[end] - times[begin]) / (end - begin), times[begin], times[end]
    for part in parts(begin, times):
        times[part] = first + step * np.arange(part.start - begin, part.stop - begin)
    for part in parts(len(times) - end - 1, times):
        times[end + 1 + part.start : end + 1 + part.stop] = last + step * np.arange(part.start + 1, part.stop + 1)
    while begin < end:
        until = next_known(times, min(begin + PART, end))
        between = times[begin : until + 1]
        unknown = np.isnan(between)
        if unknown.any():
            at, known = np.flatnonzero(unknown), np.flatnonzero(~unknown)
            between[at] = np.interp(at, known, between[known])
        begin = until
        release(times)
    count_on(times)


def count_on(times: Floats) -> None:
    """In place: times [s] since the first, none before the one before it.

    Time stamps are rounded, and a reply that is printed late dates its packet late: order is that of the numbers.
    """
    newest, origin = -np.inf, times[0]
    for part in parts(len(times), times):
        times[part] -= origin
        times[part.start] = max(times[part.start], newest)
        np.maximum.accumulate(times[part], out=times[part])
        newest = times[part.stop - 1]


def spread_equal(times: Floats) -> int:
    """In place: of equal times [s], which increase from the first to the last, those behind the first one are spread.

    They are put evenly before the next time; returns how many they are.
    """
    count, before = 0, np.full(1, np.nan)
    for part in parts(len(times), times):
        now = np.append(before, times[part])
        is_equal = np.diff(now) == 0.0
        before, count = now[-1:], count + int(np.count_nonzero(is_equal))
        times[part][is_equal] = np.nan
    interpolate(times)
    return count


def next_known(times: Floats, first: int) -> int:
    """The first place from `first` on that has a number; there must be one."""
    for part in parts(len(times) - first, times):
        known = np.flatnonzero(~np.isnan(times[first + part.start : first + part.stop]))
        if len(known):
            return int(first + part.start + known[0])
    raise ValueError("no time is known")


class CountedOn:
    """Numbers that begin anew after `modulus` - 1, made to count on, part by part; out of order they stay so."""

    def __init__(self, modulus: int = 65536, may_be_before: bool = True) -> None:
        """`may_be_before`: the first numbers may be followed by some from before a new beginning."""
        self._modulus, self._both = modulus, may_be_before
        self._last: int | None = None
        self._shift = 0
        self._is_larger = False

    def take(self, seq: Ints) -> Ints:
        """The next part of the numbers, shape (n,)."""
        if self._is_larger or not len(seq):
            return seq
        if int(seq.max()) >= self._modulus:  # these numbers have more bits, and go on by themselves
            self._is_larger = True
            return seq
        before = int(seq[0]) if self._last is None else self._last
        steps = np.diff(seq, prepend=before)
        turns = np.zeros(len(seq), dtype=np.int64)
        turns[steps < -(self._modulus // 2)] = 1
        self._both |= bool(turns.any())
        if self._both:
            turns[steps > self._modulus // 2] = -1
        shifts = self._shift + self._modulus * np.cumsum(turns)
        self._last, self._shift = int(seq[-1]), int(shifts[-1])
        return np.asarray(seq + shifts)
