"""Captures of packets, pcap or pcapng: one with the sequence numbers of RTPS (DDS), or two, of both ends, matched.

One capture, taken where packets arrive: each writer of RTPS numbers its samples, and a number that was not captured was
lost on its way. Two captures (--received): of the flow of the first one of which most is in the second, each packet
that is not there was lost; the delay is the difference of the two time stamps. Packets are matched by writer and number
where they are RTPS, else by their bytes, the first of equal ones with the first.

Needs dpkt (`pip install 'agv_ncs[captures]'`). Source: OMG, DDS Interoperability Wire Protocol (DDSI-RTPS) 2.5, 9.4.5.
"""

from __future__ import annotations

import hashlib
import socket
import struct
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.text_columns import Progress, open_binary
from agv_analysis.link.large_arrays import Column, parts
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

_MAGICS = (
    b"\xa1\xb2\xc3\xd4", b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\x3c\x4d", b"\x4d\x3c\xb2\xa1", b"\x0a\x0d\x0d\x0a",
)  # fmt: skip

_HEADER = 20
"""Bytes of RTPS' header: its name, versions, the prefix of the participant."""

_DATA, _DATA_FRAG = 0x15, 0x16

_USER_WRITERS = (0x02, 0x03)
"""Last byte of the entity of a writer that is the application's; others are of DDS itself."""

Writer = tuple[bytes, bytes]
"""Prefix of the participant, entity of the writer."""

Flow = tuple[bytes, int, bytes, int]


class _Packet(NamedTuple):
    """A UDP packet of a capture."""

    time: float
    flow: Flow
    """Source, its port, destination, its port."""
    payload: bytes


def _matches(head: bytes, path: Path) -> bool:
    return head[:4] in _MAGICS


def _read(path: Path, options: Options) -> Measurement:
    malformed = Malformed()
    if options.received is not None:
        return _of_two(path, options.received, malformed, options)
    return _of_one(path, malformed, options)


def _dpkt() -> Any:
    try:
        import dpkt
    except ImportError:
        raise MeasurementError(
            "captures are read by dpkt, which is not installed: pip install 'agv_ncs[captures]'"
        ) from None
    return dpkt


def _packets(path: Path, malformed: Malformed, progress: Progress | None) -> Iterator[_Packet]:
    """The UDP packets of a capture, in its order. Raises MeasurementError if it is none."""
    dpkt = _dpkt()
    size = max(1, path.stat().st_size)
    _needs_one_kind_of_interface(path)
    with open_binary(path) as file:
        try:
            reader = dpkt.pcap.UniversalReader(file)
        except (ValueError, dpkt.Error) as error:
            raise MeasurementError(f"{path}: is no capture: {error}") from None
        decode, number = _decoder(dpkt, reader.datalink(), path), 0
        try:
            for time, data in reader:
                number += 1
                if progress is not None and number % 10_000 == 0:
                    progress(min(1.0, file.tell() / size))
                try:
                    packet = decode(data)
                except (dpkt.Error, struct.error, IndexError):
                    malformed.add(number, f"packet {number} of {len(data)} byte".encode())
                    continue
                ip = packet if isinstance(packet, (dpkt.ip.IP, dpkt.ip6.IP6)) else getattr(packet, "data", None)
                udp = getattr(ip, "data", None)
                if isinstance(udp, dpkt.udp.UDP):
                    yield _Packet(float(time), (ip.src, udp.sport, ip.dst, udp.dport), bytes(udp.data))  # type: ignore[union-attr]
        except (dpkt.Error, struct.error, ValueError):
            malformed.add(number + 1, b"the capture ends within a packet")


def _needs_one_kind_of_interface(path: Path) -> None:
    """Raises MeasurementError for a pcapng with links or clocks of several kinds, of which dpkt knows the first."""
    kinds = set()
    with open_binary(path) as file:
        if file.read(4) != _MAGICS[-1]:
            return
        file.seek(8)
        order = "<" if file.read(4) == b"\x4d\x3c\x2b\x1a" else ">"
        file.seek(0)
        while len(head := file.read(8)) == 8:
            kind, length = struct.unpack(f"{order}II", head)
            if length < 12:
                break
            if kind == _INTERFACE:
                body = file.read(length - 8)
                kinds.add((body[:2], _resolution(body[8:-4], order)))
            else:
                file.seek(length - 8, 1)
    if len(kinds) > 1:
        raise MeasurementError(
            f"{path}: has packets of {len(kinds)} kinds of interfaces: write those of one to a file of their own, as "
            "with tshark -r FILE -Y 'frame.interface_id == 0' -w ONE"
        )


_INTERFACE, _RESOLUTION = 1, 9
"""Block that describes an interface, and its option that says in what unit times are."""


def _resolution(options: bytes, order: str) -> bytes:
    """What a description says of the unit of times; empty if it says nothing."""
    at = 0
    while at + 4 <= len(options):
        code, length = struct.unpack_from(f"{order}HH", options, at)
        if code == _RESOLUTION:
            return options[at + 4 : at + 4 + length].replace(b"\x06", b"")  # microseconds are meant where none is said
        if code == 0:
            break
        at += 4 + length + -length % 4
    return b""


def _ip(data: bytes) -> Any:
    """A packet of IP without a frame about it, of either version."""
    dpkt = _dpkt()
    return dpkt.ip6.IP6(data) if data[0] >> 4 == 6 else dpkt.ip.IP(data)


def _decoder(dpkt: Any, datalink: int, path: Path) -> Any:
    known = {
        dpkt.pcap.DLT_EN10MB: dpkt.ethernet.Ethernet, dpkt.pcap.DLT_NULL: dpkt.loopback.Loopback,
        108: dpkt.loopback.Loopback, dpkt.pcap.DLT_LINUX_SLL: dpkt.sll.SLL, 12: _ip, 101: _ip, 228: _ip, 229: _ip,
        276: dpkt.sll2.SLL2,
    }  # fmt: skip
    if datalink not in known:
        raise MeasurementError(
            f"{path}: was captured on a link of type {datalink}; known are {', '.join(map(str, known))}"
        )
    return known[datalink]


def samples_of(payload: bytes) -> Iterator[tuple[Writer, int]]:
    """Writer and number of each sample in a message of RTPS; none if it is another one."""
    if payload[:4] != b"RTPS" or len(payload) < _HEADER:
        return
    prefix, at = payload[8:20], _HEADER
    while at + 4 <= len(payload):
        kind, flags = payload[at], payload[at + 1]
        order = "<" if flags & 1 else ">"
        (length,) = struct.unpack_from(f"{order}H", payload, at + 2)
        if kind in (_DATA, _DATA_FRAG) and at + 24 <= len(payload):
            high, low = struct.unpack_from(f"{order}iI", payload, at + 16)
            yield (prefix, payload[at + 12 : at + 16]), (high << 32) + low
        if length == 0:
            return  # to the end of the message
        at += 4 + length


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
    for packet in _packets(path, malformed, options.progress):
        for writer, number in samples_of(packet.payload):
            if writer[1][-1] in _USER_WRITERS:
                numbers[writer].append(number)
                times[writer].append(packet.time)
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
    flow: NDArray[np.int64]
    """Which of the flows it belongs to."""
    flows: list[Flow]


def _keyed(path: Path, malformed: Malformed, progress: Progress | None) -> _Keyed:
    key, time, flow = _Buffered(np.uint64), _Buffered(np.float64), _Buffered(np.int64)
    flows: dict[Flow, int] = {}
    for packet in _packets(path, malformed, progress):
        samples = tuple(samples_of(packet.payload))
        known_by = repr(samples).encode() if samples else packet.payload
        key.append(int.from_bytes(hashlib.blake2b(known_by, digest_size=8).digest(), "little"))
        time.append(packet.time)
        flow.append(flows.setdefault(packet.flow, len(flows)))
    return _Keyed(key.values, time.values, flow.values, list(flows))


def arrivals(sent: NDArray[np.uint64], arrived: NDArray[np.uint64]) -> NDArray[np.int64]:
    """For each key sent, shape (n,), the place of its arrival among those that arrived; -1: it did not come.

    Of equal keys the first one sent is the first one that arrived, and so on.
    """
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
    at_sender, at_receiver = _keyed(path, malformed, options.progress), _keyed(other, malformed, options.progress)
    place = arrivals(at_sender.key, at_receiver.key)
    matched = np.bincount(at_sender.flow[place >= 0], minlength=len(at_sender.flows))
    if not matched.any():
        raise MeasurementError(f"{path}: no packet of it is in {other}: are they of the same traffic?")
    chosen = int(np.argmax(matched))
    flow, of_flow = at_sender.flows[chosen], np.flatnonzero(at_sender.flow == chosen)
    sent, place = at_sender.time[of_flow], place[of_flow]
    got = np.where(place >= 0, at_receiver.time[np.maximum(place, 0)], np.nan)
    order = np.argsort(sent, kind="stable")
    sent, got = sent[order], got[order]
    came = got[~np.isnan(got)]
    codes = np.where(np.isnan(got), LOST, RECEIVED).astype(np.int8)
    notes = (
        f"the flow from {_address(flow[0], flow[1])} to {_address(flow[2], flow[3])}, {matched[chosen]} of "
        f"{len(sent)} packets matched; it is taken for the uplink, and delays are as good as the two clocks agree",
    )
    return Measurement(
        source=str(path), format="capture", sent=sent - sent[0], uplink=PacketOutcomes(codes, got - sent),
        reordered=int(np.count_nonzero(came < np.maximum.accumulate(came))), malformed=malformed, notes=notes,
    )  # fmt: skip


def _address(address: bytes, port: int) -> str:
    family = socket.AF_INET if len(address) == 4 else socket.AF_INET6
    return f"{socket.inet_ntop(family, address)}:{port}"


FORMAT = Format("capture", "capture of packets, pcap or pcapng", 6, _matches, _read)
