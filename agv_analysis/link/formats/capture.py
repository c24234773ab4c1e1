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
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.text_columns import Progress, open_binary
from agv_analysis.link.measurement import (
    LOST,
    RECEIVED,
    Malformed,
    Measurement,
    MeasurementError,
    PacketOutcomes,
)
from agv_analysis.link.packet_grid import PacketGrid

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


def _of_one(path: Path, malformed: Malformed, options: Options) -> Measurement:
    numbers: dict[Writer, list[int]] = defaultdict(list)
    times: dict[Writer, list[float]] = defaultdict(list)
    for packet in _packets(path, malformed, options.progress):
        for writer, number in samples_of(packet.payload):
            numbers[writer].append(number)
            times[writer].append(packet.time)
    of_user = {writer: found for writer, found in numbers.items() if writer[1][-1] in _USER_WRITERS}
    if not of_user:
        raise MeasurementError(
            f"{path}: has no samples of RTPS, whose numbers would say what was lost: give the capture of the other end "
            "with --received"
        )
    writer = _chosen(of_user, options.topic, path)
    seq, arrived = np.array(of_user[writer], dtype=np.int64), np.array(times[writer])
    packets = PacketGrid()
    packets.add(seq, (), arrived - arrived[0])
    grid = packets.whole(options.interval or 1.0)
    others = len(of_user) - 1
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


def _chosen(writers: dict[Writer, list[int]], name: str, path: Path) -> Writer:
    """The writer of this name, or the one with most samples. Raises MeasurementError."""
    if not name:
        return max(writers, key=lambda writer: len(writers[writer]))
    for writer in writers:
        if _name(writer) == name:
            return writer
    known = ", ".join(f"{_name(writer)} ({len(found)})" for writer, found in writers.items())
    raise MeasurementError(f"{path}: has no samples of the writer {name}; it has those of {known}")


Key = tuple[Any, int]
"""What a packet is known by at both ends, and the how manieth with it."""


def _keyed(path: Path, malformed: Malformed, progress: Progress | None) -> Iterator[tuple[Flow, Key, float]]:
    """Flow, key and time of each packet."""
    seen: Counter[Any] = Counter()
    for packet in _packets(path, malformed, progress):
        samples = tuple(samples_of(packet.payload))
        key = samples or hashlib.blake2b(packet.payload, digest_size=16).digest()
        seen[key] += 1
        yield packet.flow, (key, seen[key]), packet.time


def _of_two(path: Path, other: Path, malformed: Malformed, options: Options) -> Measurement:
    arrived = {key: time for _, key, time in _keyed(other, malformed, None)}
    flows: dict[Flow, list[tuple[Key, float]]] = defaultdict(list)
    for flow, key, time in _keyed(path, malformed, options.progress):
        flows[flow].append((key, time))
    matched = {flow: sum(key in arrived for key, _ in found) for flow, found in flows.items()}
    if not any(matched.values()):
        raise MeasurementError(f"{path}: no packet of it is in {other}: are they of the same traffic?")
    flow = max(matched, key=lambda one: matched[one])
    packets = flows[flow]
    sent = np.array([time for _, time in packets])
    got = np.array([arrived.get(key, np.nan) for key, _ in packets])
    order = np.argsort(sent, kind="stable")
    sent, got = sent[order], got[order]
    came = got[~np.isnan(got)]
    codes = np.where(np.isnan(got), LOST, RECEIVED).astype(np.int8)
    notes = (
        f"the flow from {_address(flow[0], flow[1])} to {_address(flow[2], flow[3])}, {matched[flow]} of "
        f"{len(packets)} packets matched; it is taken for the uplink, and delays are as good as the two clocks agree",
    )
    return Measurement(
        source=str(path), format="capture", sent=sent - sent[0], uplink=PacketOutcomes(codes, got - sent),
        reordered=int(np.count_nonzero(came < np.maximum.accumulate(came))), malformed=malformed, notes=notes,
    )  # fmt: skip


def _address(address: bytes, port: int) -> str:
    family = socket.AF_INET if len(address) == 4 else socket.AF_INET6
    return f"{socket.inet_ntop(family, address)}:{port}"


FORMAT = Format("capture", "capture of packets, pcap or pcapng", 6, _matches, _read)
