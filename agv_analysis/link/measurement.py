"""A measured link: what became of each packet of a measurement, in each direction, and when.

Every file format is read into one of three values. A `Measurement` knows packet by packet; `LossRates` know how many
packets were lost in each interval, and no more; a `Setting` is not a measurement but what somebody set an emulator to.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.large_arrays import column_of, count_of, median_step, parts
from agv_analysis.run import Floats
from agv_plant.parameters import ChannelParameters
from agv_ros.counted import counted
from agv_ros.errors import UserError

RECEIVED, LOST, UNKNOWN, NOT_SENT = 0, 1, 2, 3
"""What became of a packet. UNKNOWN: the file does not say; NOT_SENT: nothing was sent in this direction, since what it
would have answered was lost."""

Codes = NDArray[np.int8]

_SHOWN = 3
"""Malformed lines that are shown."""


class MeasurementError(UserError):
    """A file that is not a measurement of a link, or cannot say what it is asked; the text names it and the reason."""


@dataclass
class Malformed:
    """Lines of a file that are not records of its format."""

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
        lines = counted(self.count, "line was", "lines were")
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
        return column_of((self.outcome[part] <= LOST for part in parts(len(self.outcome), self.outcome)), np.bool_)

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Which packets were lost for certain? Shape (N,)."""
        return column_of((self.outcome[part] == LOST for part in parts(len(self.outcome), self.outcome)), np.bool_)

    @property
    def is_told(self) -> bool:
        """Does the file say what became of every packet that was sent in this direction, and was one sent?"""
        is_silent = count_of(self.outcome, lambda part: part == UNKNOWN) > 0
        return not is_silent and count_of(self.outcome, lambda part: part <= LOST) > 0


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

    @cached_property
    def interval(self) -> float:
        """Median time between packets sent [s]; 0 for a single one."""
        return 0.0 if self.packets < 2 else median_step(self.sent)

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


def needs_memory(path: Path, bytes_: float) -> None:
    """Raises MeasurementError if so many bytes are more than this machine has left, as far as it says."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return
    left = next((1024.0 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")), bytes_)
    if bytes_ > left:
        raise MeasurementError(
            f"{path}: takes {bytes_ / 1e9:.3g} GB of memory at least, since it is read as a whole, and "
            f"{left / 1e9:.3g} GB are left: give a part of it"
        )


def of_one_way(outcome: Codes) -> Codes:
    """Outcomes of either way from those of round trips, shape (N,): of what was lost it is not known on which."""
    told = (np.where(outcome[part] == RECEIVED, RECEIVED, UNKNOWN) for part in parts(len(outcome), outcome))
    return column_of(told, np.int8)


def needs_packets(count: int, source: str, what: str, malformed: Malformed | None = None) -> None:
    """Raises MeasurementError for a file without a single packet, with the lines that were not understood."""
    if count < 1:
        why = "; ".join(() if malformed is None else malformed.sentences())
        raise MeasurementError(f"{source}: has no {what}" + (f": {why}" if why else ""))
