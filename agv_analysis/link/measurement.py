"""A measured link: what became of each packet of a measurement, in each direction, and when.

Every file format is read into one of three values. A `Measurement` knows packet by packet; `LossRates` know how many
packets were lost in each interval, and no more; a `Setting` is no measurement but what somebody set an emulator to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats
from agv_plant.parameters import ChannelParameters
from agv_ros.errors import UserError

RECEIVED, LOST, UNKNOWN, NOT_SENT = 0, 1, 2, 3
"""What became of a packet. UNKNOWN: the file does not say; NOT_SENT: nothing was sent in this direction, since what it
would have answered was lost."""

Codes = NDArray[np.int8]

_SPARSE, _MOST_MISSING = 1000, 1_000_000
"""A series of numbered packets may lack so many for each that is there, and so many more."""

_SHOWN = 3
"""Malformed lines that are shown."""


class MeasurementError(UserError):
    """A file that is no measurement of a link, or cannot say what it is asked; the text names it and the reason."""


@dataclass
class Malformed:
    """Lines of a file that are no records of its format."""

    count: int = 0
    shown: list[str] = field(default_factory=list)
    """The first of them, each with its number."""

    def add(self, number: int, line: bytes) -> None:
        """Count a line; numbers begin with 1."""
        self.count += 1
        if len(self.shown) < _SHOWN:
            text = line[:80].decode("utf-8", "replace").strip()
            self.shown.append(f"line {number}: {text!r}")

    def sentences(self) -> tuple[str, ...]:
        """What to say of them, empty if there are none."""
        if not self.count:
            return ()
        more = f", and {self.count - len(self.shown)} more" if self.count > len(self.shown) else ""
        lines = "1 line was" if self.count == 1 else f"{self.count} lines were"
        return (f"{lines} not understood and left out ({'; '.join(self.shown)}{more})",)


@dataclass(frozen=True)
class PacketOutcomes:
    """One way of the packets: the uplink, the downlink, or there and back again."""

    outcome: Codes
    """RECEIVED, LOST, UNKNOWN or NOT_SENT of each packet, shape (N,)."""
    delay: Floats | None = None
    """Time under way [s], shape (N,), NaN where it is not known; None if the file has none."""

    @property
    def known(self) -> NDArray[np.bool_]:
        """Of which packets is the outcome known? Shape (N,)."""
        return np.asarray(self.outcome <= LOST)

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Which packets were lost for certain? Shape (N,)."""
        return np.asarray(self.outcome == LOST)

    @property
    def is_told(self) -> bool:
        """Does the file say what became of every packet that was sent in this direction, and was one sent?"""
        return bool(self.known.any()) and not bool((self.outcome == UNKNOWN).any())


@dataclass(frozen=True)
class Measurement:
    """N packets in the order in which they were sent."""

    source: str
    format: str
    sent: Floats
    """When each was sent, in seconds since the first, increasing, shape (N,)."""
    uplink: PacketOutcomes | None = None
    """None: the file does not tell this direction from the other."""
    downlink: PacketOutcomes | None = None
    round_trip: PacketOutcomes | None = None
    """None for a measurement of one direction."""
    duplicates: int = 0
    """Packets that came again; each counts once."""
    reordered: int = 0
    """Packets that came after one that was sent later."""
    malformed: Malformed = field(default_factory=Malformed)
    notes: tuple[str, ...] = ()
    """What was assumed, and what the file cannot say."""

    @property
    def packets(self) -> int:
        """N."""
        return len(self.sent)

    @property
    def span(self) -> float:
        """Time from the first packet sent to the last [s]."""
        return float(self.sent[-1] - self.sent[0])

    @property
    def interval(self) -> float:
        """Median time between packets sent [s]; 0 for a single one."""
        return float(np.median(np.diff(self.sent))) if self.packets > 1 else 0.0

    @property
    def whole(self) -> PacketOutcomes:
        """The round trip, or the one direction that was measured."""
        found = self.round_trip or self.uplink or self.downlink
        assert found is not None, "a measurement has a direction"
        return found


@dataclass(frozen=True)
class LossRates:
    """Packets and losses by interval: a loss rate, and no trace, since it is not known which packets were lost."""

    source: str
    format: str
    begin: Floats
    """Of each interval [s], shape (n,)."""
    end: Floats
    packets: NDArray[np.int64]
    lost: NDArray[np.int64]
    is_uplink: bool
    """Did the packets go from the client to the server?"""
    notes: tuple[str, ...] = ()

    @property
    def refusal(self) -> str:
        """Why there is no trace in it."""
        length = float(np.median(self.end - self.begin))
        return (
            f"{self.source}: {self.format} counts losses per interval of {length:g} s and does not say which packets "
            "were lost: a loss rate, but no trace to drive a loop with"
        )


@dataclass(frozen=True)
class Setting:
    """What an emulator was set to: a channel, and where ours is another."""

    source: str
    format: str
    line: str
    channel: ChannelParameters
    differences: tuple[str, ...] = ()
    """A sentence for each thing that the channel does not have as the line says it."""


Reading = Measurement | LossRates | Setting


@dataclass(frozen=True)
class Numbered:
    """Packets that came back, in the order in which the file has them."""

    seq: NDArray[np.int64]
    """Sequence numbers, shape (n,)."""
    delays: tuple[Floats, ...]
    """Delays [s] of the packets, NaN where unknown, each of shape (n,)."""
    sent: Floats | None = None
    """When they were sent [s], shape (n,), NaN where unknown; None: the file has no times."""


@dataclass(frozen=True)
class Grid:
    """Every packet of a numbered measurement, received or not."""

    sent: Floats
    outcome: Codes
    delays: tuple[Floats, ...]
    duplicates: int
    reordered: int


def on_grid(found: Numbered, first: int, last: int, interval: float) -> Grid:
    """All packets from number `first` to number `last`, those without a record as lost.

    Times that the file does not have are interpolated by number; without any, packets are `interval` [s] apart. Raises
    MeasurementError for numbers that can be none of a sequence.
    """
    count = last - first + 1
    if count > _SPARSE * len(found.seq) + _MOST_MISSING:
        raise MeasurementError(
            f"numbers go from {first} to {last}, and {len(found.seq)} packets have one: these are no sequence numbers, "
            "or one of them is broken"
        )
    rows = found.seq - first
    is_known = (rows >= 0) & (rows < count)
    record = np.full(count, -1, dtype=np.int64)
    known = np.flatnonzero(is_known)[::-1]
    record[rows[known]] = known  # the first record of each number counts: it is written last
    places = np.flatnonzero(record >= 0)
    at = record[places]
    outcome = np.where(record >= 0, RECEIVED, LOST).astype(np.int8)
    delays = []
    for given in found.delays:
        delay = np.full(count, np.nan)
        delay[places] = given[at]
        delays.append(delay)
    is_first = np.zeros(len(rows), dtype=np.bool_)
    is_first[at] = True
    seen = rows[is_first]
    return Grid(
        sent=_times(found.sent, at, places, count, interval),
        outcome=outcome,
        delays=tuple(delays),
        duplicates=len(known) - len(at),
        reordered=int(np.count_nonzero(seen < np.maximum.accumulate(seen))) if len(seen) else 0,
    )


def _times(
    sent: Floats | None, at: NDArray[np.int64], places: NDArray[np.int64], count: int, interval: float
) -> Floats:
    """When each packet was sent [s] since the first, shape (count,), increasing."""
    if sent is None:
        return np.arange(count, dtype=np.float64) * interval
    stamps = sent[at]
    known = ~np.isnan(stamps)
    x, y = places[known], stamps[known]
    if len(x) < 2:
        return np.arange(count, dtype=np.float64) * interval
    step = float(y[-1] - y[0]) / float(x[-1] - x[0])
    times = np.interp(np.arange(count, dtype=np.float64), x, y)
    first, last = int(x[0]), int(x[-1])
    times[:first] = y[0] + step * np.arange(-first, 0)
    times[last + 1 :] = y[-1] + step * np.arange(1, count - last)
    times -= times[0]
    # Time stamps are rounded, and a reply that is printed late dates its packet late: order is that of the numbers.
    return np.maximum.accumulate(times, out=times)


def unwrapped(seq: NDArray[np.int64], modulus: int = 65536) -> NDArray[np.int64]:
    """Numbers that begin anew after `modulus` - 1, made to count on; replies out of order stay out of order."""
    if len(seq) == 0 or int(seq.max()) >= modulus:
        return seq
    steps = np.diff(seq, prepend=seq[0])
    wraps = np.flatnonzero(np.abs(steps) > modulus // 2)
    steps[wraps] -= modulus * np.sign(steps[wraps])
    steps[0] = seq[0]
    return np.cumsum(steps, out=steps)


def needs_packets(count: int, source: str, what: str) -> None:
    """Raises MeasurementError for a file without a single packet."""
    if count < 1:
        raise MeasurementError(f"{source}: has no {what}")


def joined(parts: Sequence[Floats]) -> Floats:
    """Parts of a column, one after the other."""
    return np.concatenate(parts) if parts else np.zeros(0)
