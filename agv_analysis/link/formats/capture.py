"""Captures of packets, pcap or pcapng: one with the sequence numbers of RTPS (DDS), or two, of both ends, matched.

One capture, taken where packets arrive: each writer of RTPS numbers its samples, and a number that was not captured was
lost on its way. Two captures (--received): of the flow of the first one of which most is in the second, each packet
that is not there was lost; the delay is the difference of the two time stamps. Packets are matched by writer and number
where they are RTPS, else by their bytes, the first of equal ones with the first.

Needs dpkt (`pip install 'agv_ncs[captures]'`). Source: OMG, DDS Interoperability Wire Protocol (DDSI-RTPS) 2.5, 9.4.5.
"""

from __future__ import annotations

import hashlib
import math
import socket
from collections import defaultdict
from collections.abc import Mapping
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from agv_analysis.link.formats.capture_packets import MAGICS, USER_WRITERS, Flow, Writer, packets_of, samples_of
from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.text_columns import Progress
from agv_analysis.link.large_arrays import (
    Column,
    column_of,
    is_increasing,
    parts,
    places_in_order,
    places_of,
    reordered_by,
    taken,
)
from agv_analysis.link.measurement import (
    LOST,
    RECEIVED,
    Malformed,
    Measurement,
    MeasurementError,
    PacketOutcomes,
)
from agv_analysis.link.packet_grid import PacketGrid
from agv_analysis.run import Floats
from agv_ros.counted import counted


def _matches(head: bytes, path: Path) -> bool:
    return head[:4] in MAGICS


def _read(path: Path, options: Options) -> Measurement:
    malformed = Malformed()
    if options.received is not None:
        return _of_two(path, options.received, malformed, options)
    return _of_one(path, malformed, options)


class _Buffered:
    """Numbers that come one by one, kept in a column."""

    def __init__(self, dtype: DTypeLike) -> None:
        self._column, self._newest = Column(dtype), list[Any]()

    def append(self, value: float) -> None:
        self._newest.append(value)
        if len(self._newest) == _TOGETHER:
            self._write()

    def _write(self) -> None:
        self._column.extend(np.array(self._newest, dtype=self._column.values.dtype))
        self._newest.clear()

    def __len__(self) -> int:
        return len(self._column) + len(self._newest)

    @property
    def values(self) -> NDArray[Any]:
        """All so far, shape (n,)."""
        self._write()
        return self._column.values


_TOGETHER = 4096
"""Numbers that are put into a column at once."""


def _of_one(path: Path, malformed: Malformed, options: Options) -> Measurement:
    numbers: dict[Writer, _Buffered] = defaultdict(lambda: _Buffered(np.int64))
    times: dict[Writer, _Buffered] = defaultdict(lambda: _Buffered(np.float64))
    begin: Decimal | None = None
    for packet in packets_of(path, malformed, options.progress):
        begin = packet.time if begin is None else begin
        for writer, number in samples_of(packet.payload):
            if writer[1][-1] in USER_WRITERS:
                numbers[writer].append(number)
                times[writer].append(float(packet.time - begin))
    if not numbers:
        raise MeasurementError(
            f"{path}: has no samples of RTPS, whose numbers would say what was lost: give the capture of the other end "
            "with --received"
        )
    writer = _chosen(numbers, options.topic, path)
    seq, arrived, packets = numbers[writer].values, times[writer].values, PacketGrid()
    for part in parts(len(seq), seq, arrived):
        packets.add(seq[part], (), arrived[part] - arrived[0])
    grid = packets.whole(options.interval or 1.0)
    others = len(numbers) - 1
    notes = [
        f"samples of the writer {_name(writer)}"
        + (f", one of {others + 1}: name another with --topic" if others else ""),
        "what was lost is what did not come to where the capture was taken, and times are those of arrival",
    ]
    if grid.duplicates:
        notes.append("samples that came again were sent again: a reliable writer's losses are more than these")
    return Measurement(
        source=str(path), format="capture", sent=grid.sent, uplink=PacketOutcomes(grid.outcome),
        duplicates=grid.duplicates, reordered=grid.reordered, malformed=malformed, notes=tuple(notes),
    )  # fmt: skip


def _name(writer: Writer) -> str:
    return f"{writer[0].hex()}.{writer[1].hex()}"


def _chosen(writers: Mapping[Writer, _Buffered], name: str, path: Path) -> Writer:
    """The writer of this name, or the one with most samples. Raises MeasurementError."""
    if not name:
        return max(writers, key=lambda writer: len(writers[writer]))
    for writer in writers:
        if _name(writer) == name:
            return writer
    known = ", ".join(f"{_name(writer)} ({len(found)})" for writer, found in writers.items())
    raise MeasurementError(f"{path}: has no samples of the writer {name}; it has those of {known}")


class _Keyed(NamedTuple):
    """The packets of a capture, in its order."""

    key: NDArray[np.uint64]
    """What a packet is known by at both ends: a digest of its samples, or of its bytes; shape (n,)."""
    time: Floats
    """[s] since `begin`."""
    flow: NDArray[np.int64]
    """Which of the flows it belongs to."""
    flows: list[Flow]
    begin: Decimal
    """From when on its times count [s]."""


def _keyed(path: Path, malformed: Malformed, progress: Progress | None, begin: Decimal | None = None) -> _Keyed:
    key, time, flow = _Buffered(np.uint64), _Buffered(np.float64), _Buffered(np.int64)
    flows: dict[Flow, int] = {}
    for packet in packets_of(path, malformed, progress):
        samples = tuple(samples_of(packet.payload))
        known_by = repr(samples).encode() if samples else packet.payload
        key.append(int.from_bytes(hashlib.blake2b(known_by, digest_size=8).digest(), "little"))
        begin = packet.time if begin is None else begin
        time.append(float(packet.time - begin))
        flow.append(flows.setdefault(packet.flow, len(flows)))
    return _Keyed(key.values, time.values, flow.values, list(flows), begin or Decimal())


def arrivals(sent: NDArray[np.uint64], arrived: NDArray[np.uint64]) -> NDArray[np.int64]:
    """For each key sent, shape (n,), the place of its arrival among those that arrived; -1: it did not come.

    Of equal keys the first one sent is the first one that arrived, and so on. Of many keys, those are matched together
    whose first bits are the same: they are digests, so that these are few.
    """
    bits = max(0, (len(sent) + len(arrived)) // _MATCHED).bit_length()
    if not bits:
        return _arrivals(sent, arrived)
    nothing = (np.full(part.stop - part.start, -1) for part in parts(len(sent)))
    found, shift = column_of(nothing, np.int64), np.uint64(64 - bits)
    for prefix in range(1 << bits):
        of_prefix = [places_of(keys, lambda part, p=prefix: part >> shift == p) for keys in (sent, arrived)]  # type: ignore[misc]
        place = _arrivals(taken(sent, of_prefix[0]), taken(arrived, of_prefix[1]))
        came = place >= 0
        places, of_arrived = of_prefix[0][came], of_prefix[1][place[came]]
        for part in parts(len(places), found):
            found[places[part]] = of_arrived[part]
    return found


_MATCHED = 1 << 21
"""Keys that are matched together, at most, if they are digests."""


def _arrivals(sent: NDArray[np.uint64], arrived: NDArray[np.uint64]) -> NDArray[np.int64]:
    order, order_of_arrived = np.argsort(sent, kind="stable"), np.argsort(arrived, kind="stable")
    keys, keys_of_arrived = sent[order], arrived[order_of_arrived]
    which = np.arange(len(keys)) - np.searchsorted(keys, keys)  # the how manieth with its key
    at = np.searchsorted(keys_of_arrived, keys) + which
    came = at < len(keys_of_arrived)
    came[came] = keys_of_arrived[at[came]] == keys[came]
    found = np.full(len(keys), -1, dtype=np.int64)
    found[order[came]] = order_of_arrived[at[came]]
    return found


def _of_two(path: Path, other: Path, malformed: Malformed, options: Options) -> Measurement:
    at_sender = _keyed(path, malformed, options.progress)
    at_receiver = _keyed(other, malformed, options.progress, at_sender.begin)
    place, flows = arrivals(at_sender.key, at_receiver.key), len(at_sender.flows)
    matched = np.zeros(flows, dtype=np.int64)
    for part in parts(len(place), place, at_sender.flow):
        matched += np.bincount(at_sender.flow[part][place[part] >= 0], minlength=flows)
    if not matched.any():
        raise MeasurementError(f"{path}: no packet of it is in {other}: are they of the same traffic?")
    chosen, others = _sent_here(at_sender, at_receiver, place, int(np.argmax(matched)))
    flow, of_flow = at_sender.flows[chosen], places_of(at_sender.flow, lambda part: part == chosen)
    sent, place = reordered_by(at_sender.time, of_flow), reordered_by(place, of_flow)
    if not is_increasing(sent):
        order = places_in_order(sent)
        sent, place = reordered_by(sent, order), reordered_by(place, order)
    codes, delays, times = Column(np.int8), Column(), Column()
    reordered, newest = 0, -np.inf
    for part in parts(len(sent), sent, place, at_receiver.time):
        came = place[part] >= 0
        got = np.where(came, at_receiver.time[np.maximum(place[part], 0)], np.nan)
        arrived = np.append(newest, got[came])
        reordered += int(np.count_nonzero(arrived < np.maximum.accumulate(arrived)))
        newest = arrived.max()
        codes.extend(np.where(came, RECEIVED, LOST))
        delays.extend(got - sent[part])
        times.extend(sent[part] - sent[0])
    notes = (
        f"the flow from {_address(flow[0], flow[1])} to {_address(flow[2], flow[3])}, {matched[chosen]} of "
        f"{counted(len(sent), 'packet')} matched; it is taken for the uplink, and delays are as good as the two "
        "clocks agree",
        *others,
    )
    return Measurement(
        source=str(path), format="capture", sent=times.values, uplink=PacketOutcomes(codes.values, delays.values),
        reordered=reordered, malformed=malformed, notes=notes,
    )  # fmt: skip


def _sent_here(
    at_sender: _Keyed, at_receiver: _Keyed, place: NDArray[np.int64], most: int
) -> tuple[int, tuple[str, ...]]:
    """Which of a flow and the one back is sent at the first capture's end, and a note if there are both.

    However the clocks differ, what is sent here comes later at the other end than what comes from there was sent.
    """
    source, port, destination, other_port = at_sender.flows[most]
    back = (destination, other_port, source, port)
    if back not in at_sender.flows:
        return most, ()
    both, later = (most, at_sender.flows.index(back)), [-math.inf, -math.inf]
    for i, flow in enumerate(both):
        of_flow = places_of(at_sender.flow, lambda part, flow=flow: part == flow)  # type: ignore[misc]
        matched = of_flow[place[of_flow] >= 0]
        if len(matched):
            later[i] = float(np.mean(at_receiver.time[place[matched]] - at_sender.time[matched]))
    chosen = both[int(np.argmax(later))]
    return chosen, ("the flow back is there, too: it is read with the two captures the other way round",)


def _address(address: bytes, port: int) -> str:
    family = socket.AF_INET if len(address) == 4 else socket.AF_INET6
    return f"{socket.inet_ntop(family, address)}:{port}"


FORMAT = Format("capture", "capture of packets, pcap or pcapng", 6, _matches, _read, ("received", "topic"))
