"""The UDP packets of a capture, pcap or pcapng, whatever is about them, and the samples of RTPS in one.

Source: OMG, DDS Interoperability Wire Protocol (DDSI-RTPS) 2.5, 9.4.5.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from agv_analysis.link.formats.text_columns import Progress, open_binary
from agv_analysis.link.measurement import Malformed, MeasurementError

MAGICS = (
    b"\xa1\xb2\xc3\xd4", b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\x3c\x4d", b"\x4d\x3c\xb2\xa1", b"\x0a\x0d\x0d\x0a",
)  # fmt: skip

_HEADER = 20
"""Bytes of RTPS' header: its name, versions, the prefix of the participant."""

_DATA, _DATA_FRAG = 0x15, 0x16

USER_WRITERS = (0x02, 0x03)
"""Last byte of the entity of a writer that is the application's; others are of DDS itself."""

Writer = tuple[bytes, bytes]
"""Prefix of the participant, entity of the writer."""

Flow = tuple[bytes, int, bytes, int]


class Packet(NamedTuple):
    """A UDP packet of a capture."""

    time: Decimal
    """[s] since 1970, as exact as the capture has it."""
    flow: Flow
    """Source, its port, destination, its port."""
    payload: bytes


def _dpkt() -> Any:
    try:
        import dpkt
    except ImportError:
        raise MeasurementError(
            "captures are read by dpkt, which is not installed: pip install 'agv_ncs[captures]'"
        ) from None
    return dpkt


def packets_of(path: Path, malformed: Malformed, progress: Progress | None) -> Iterator[Packet]:
    """The UDP packets of a capture, in its order. Raises MeasurementError if it is none."""
    dpkt = _dpkt()
    size = max(1, path.stat().st_size)
    _needs_one_kind_of_interface(path)
    with open_binary(path) as file:
        try:
            reader = dpkt.pcap.UniversalReader(watched := _Watched(file))
        except (ValueError, dpkt.Error, struct.error) as error:
            raise MeasurementError(f"{path}: is not a capture: {error}") from None
        if hasattr(reader, "_divisor"):  # else its stamps are floats, which are exact to 0.2 us
            reader._divisor = Decimal(reader._divisor)
        decode, number = _decoder(dpkt, reader.datalink(), path), 0
        try:
            for time, data in reader:
                if watched.is_short:
                    break
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
                    yield Packet(Decimal(time), (ip.src, udp.sport, ip.dst, udp.dport), bytes(udp.data))  # type: ignore[union-attr]
        except (dpkt.Error, struct.error, ValueError):
            watched.is_short = True
        if watched.is_short:
            malformed.add(number + 1, b"the capture ends within a packet")


class _Watched:
    """A file that knows whether it ended within what was asked of it."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.name = getattr(file, "name", "")
        self.is_short = False

    def read(self, count: int) -> bytes:
        data = self._file.read(count)
        self.is_short |= 0 < len(data) < count
        return data

    def seek(self, *place: int) -> int:
        return self._file.seek(*place)

    def tell(self) -> int:
        return self._file.tell()


def _needs_one_kind_of_interface(path: Path) -> None:
    """Raises MeasurementError for a pcapng with links or clocks of several kinds, of which dpkt knows the first."""
    kinds = set()
    with open_binary(path) as file:
        if file.read(4) != MAGICS[-1]:
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
