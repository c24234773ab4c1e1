"""Captures, written here packet by packet, with known losses."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.link.formats import capture, read_link
from agv_analysis.link.formats.capture import arrivals
from agv_analysis.link.formats.capture_packets import samples_of
from agv_analysis.link.formats.format import Options
from agv_analysis.link.measurement import Measurement, MeasurementError

dpkt = pytest.importorskip("dpkt", reason="needs dpkt: pip install '.[captures]'")

LOST = {3, 4, 17}
N, INTERVAL, DELAY = 50, 0.005, 0.0021
POSE, OTHER, BUILTIN = b"\x00\x00\x12\x03", b"\x00\x00\x13\x03", b"\x00\x01\x00\xc2"


def rtps(number: int, entity: bytes = POSE, little: bool = True, lead: bytes = b"") -> bytes:
    """One DATA submessage, as of the wire protocol, behind a header of 20 byte and perhaps another submessage."""
    order = "<" if little else ">"
    body = (
        struct.pack(f"{order}HH", 0, 16)
        + b"\x00" * 4
        + entity
        + struct.pack(f"{order}iI", number >> 32, number & 0xFFFFFFFF)
    )
    data = bytes([0x15, 0x04 | little]) + struct.pack(f"{order}H", len(body) + 8) + body + b"\x00" * 8
    return b"RTPS\x02\x03\x01\x0f" + bytes(range(12)) + lead + data


def info_ts() -> bytes:
    return bytes([0x09, 1]) + struct.pack("<H", 8) + b"\x00" * 8


def frame(payload: bytes, port: int = 7411, back: bool = False) -> bytes:
    ends = [(b"\x0a\x00\x00\x01", 5000), (b"\x0a\x00\x00\x02", port)]
    (source, sport), (destination, dport) = ends[::-1] if back else ends
    udp = dpkt.udp.UDP(sport=sport, dport=dport, data=payload)
    udp.ulen = len(udp)
    ip = dpkt.ip.IP(src=source, dst=destination, p=dpkt.ip.IP_PROTO_UDP, data=udp)
    return bytes(dpkt.ethernet.Ethernet(src=b"\x01" * 6, dst=b"\x02" * 6, data=ip))


def write(path: Path, packets: Sequence[tuple[float, bytes]], new: bool = False) -> Path:
    with open(path, "wb") as file:
        writer = (dpkt.pcapng.Writer if new else dpkt.pcap.Writer)(file)
        for time, data in packets:
            writer.writepkt(data, time)
    return path


def measured(path: Path, options: Options | None = None) -> Measurement:
    found = read_link(path, options)
    assert isinstance(found, Measurement)
    return found


def test_samples_of_a_message() -> None:
    writer = bytes(range(12)), POSE
    assert list(samples_of(rtps(5))) == [(writer, 5)]
    assert list(samples_of(rtps((7 << 32) + 9, little=False, lead=info_ts()))) == [(writer, (7 << 32) + 9)]
    assert list(samples_of(b"something else")) == []
    assert list(samples_of(rtps(5)[:30])) == []


@pytest.mark.parametrize("new", [False, True])
def test_numbers_that_are_missing_where_samples_arrive_were_lost(tmp_path: Path, new: bool) -> None:
    packets = []
    for i in range(N):
        if i not in LOST:
            packets.append((100.0 + i * INTERVAL, frame(rtps(i + 1, lead=info_ts()))))
        if i % 10 == 0:
            packets += [(100.0 + i * INTERVAL, frame(rtps(i + 1, entity))) for entity in (OTHER, BUILTIN)]
    packets.append((100.0 + N * INTERVAL, frame(rtps(6))))  # again
    found = measured(write(tmp_path / "capture", packets, new))
    assert found.packets == N
    assert found.uplink is not None
    assert set(np.flatnonzero(found.uplink.lost).tolist()) == LOST
    assert found.duplicates == 1
    assert found.interval == pytest.approx(INTERVAL, abs=1e-5)
    assert "one of 2: name another with --topic" in found.notes[0]
    other = f"{bytes(range(12)).hex()}.{OTHER.hex()}"
    assert int(measured(tmp_path / "capture", Options(topic=other)).whole.lost.sum()) == 36  # 1, 11, 21, 31, 41


@pytest.mark.parametrize("is_rtps", [False, True])
def test_captures_of_both_ends_are_matched(tmp_path: Path, is_rtps: bool) -> None:
    payloads = [rtps(i + 1) if is_rtps else f"pose {i % 7}".encode() for i in range(N)]  # equal ones are told apart
    lost = LOST if is_rtps else {49}  # which of equal ones was lost cannot be told, but that of the last
    here = [(100.0 + i * INTERVAL, frame(payloads[i])) for i in range(N)]
    here += [(100.0, frame(b"elsewhere", 9)) for _ in range(100)]
    there = [(100.0 + i * INTERVAL + DELAY, frame(payloads[i])) for i in range(N) if i not in lost]
    found = measured(
        write(tmp_path / "sent.pcap", here), Options(received=write(tmp_path / "received.pcap", there))
    )  # fmt: skip
    assert found.packets == N
    assert found.uplink is not None
    assert set(np.flatnonzero(found.uplink.lost).tolist()) == lost
    delay = found.uplink.delay
    assert delay is not None
    assert delay[~found.uplink.lost] == pytest.approx(DELAY, abs=2e-6)
    assert "from 10.0.0.1:5000 to 10.0.0.2:7411" in found.notes[0]


def capture_of(path: Path, packets: Sequence[tuple[int, bytes]], kind: str) -> Path:
    """A capture with stamps [ns] since 1970 as pcap in ns or us, or as pcapng in ns."""
    if kind == "pcapng":

        def block(number: int, body: bytes) -> bytes:
            body += b"\x00" * (-len(body) % 4)
            length = struct.pack("<I", len(body) + 12)
            return struct.pack("<I", number) + length + body + length

        text = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
        text += block(1, struct.pack("<HHI", 1, 0, 65535) + struct.pack("<HHB3xHH", 9, 1, 9, 0, 0))
        for at, data in packets:
            text += block(6, struct.pack("<IIIII", 0, at >> 32, at & 0xFFFFFFFF, len(data), len(data)) + data)
    else:
        unit, magic = (1, 0xA1B23C4D) if kind == "ns" else (1000, 0xA1B2C3D4)
        text = struct.pack("<IHHIIII", magic, 2, 4, 0, 0, 65535, 1)
        for at, data in packets:
            text += struct.pack("<IIII", at // 10**9, at % 10**9 // unit, len(data), len(data)) + data
    path.write_bytes(text)
    return path


@pytest.mark.parametrize(("kind", "late"), [("us", 123_000), ("ns", 123_457), ("pcapng", 123_457)])
def test_stamps_of_a_capture_are_as_exact_as_it_has_them(tmp_path: Path, kind: str, late: int) -> None:
    """A float of seconds since 1970 is only exact to 0.2 us."""
    begin, step = 1_700_000_000_999_123_000, 2_000_000
    here = [(begin + i * step, frame(rtps(i + 1))) for i in range(N)]
    there = [(at + late, data) for i, (at, data) in enumerate(here) if i not in LOST]
    received = capture_of(tmp_path / "received", there, kind)
    found = measured(capture_of(tmp_path / "sent", here, kind), Options(received=received))
    expected = [1e-9 * late if i not in LOST else float("nan") for i in range(N)]
    assert found.whole.delay == pytest.approx(expected, abs=1e-12, nan_ok=True)
    assert found.sent == pytest.approx([0.002 * i for i in range(N)], abs=1e-12)
    assert measured(received).sent == pytest.approx([0.002 * i for i in range(N)], abs=1e-12)


def test_a_capture_whose_unit_of_time_has_no_byte_is_refused(tmp_path: Path) -> None:
    path = capture_of(tmp_path / "capture", [(10**18, frame(rtps(1)))], "pcapng")
    path.write_bytes(path.read_bytes().replace(struct.pack("<HHB3x", 9, 1, 9), struct.pack("<HHHH", 9, 0, 0, 0)))
    with pytest.raises(MeasurementError, match="capture: is not a capture: "):
        read_link(path)


def test_a_capture_that_says_nothing_of_losses_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "x.pcap", [(1.0, frame(b"no numbers"))])
    with pytest.raises(MeasurementError, match="has no samples of RTPS"):
        read_link(path)
    with pytest.raises(MeasurementError, match="no packet of it is in"):
        read_link(path, Options(received=write(tmp_path / "y.pcap", [(1.0, frame(b"other"))])))


def test_a_capture_that_was_cut_off_keeps_what_is_whole(tmp_path: Path) -> None:
    path = write(tmp_path / "x.pcap", [(1.0 + i, frame(rtps(i + 1))) for i in range(4)])
    path.write_bytes(path.read_bytes()[:-20])
    found = measured(path)
    assert (found.packets, found.malformed.count) == (3, 1)
    assert "the capture ends within a packet" in found.malformed.shown[0]


def test_of_both_directions_the_one_that_is_sent_here_is_the_link(tmp_path: Path) -> None:
    """Answers, of which none was lost, are not taken for it, whatever the clocks of the two ends say."""
    for offset in (0.0, -0.5, 0.5):
        here = [(100.0 + i * INTERVAL, frame(b"%d" % i)) for i in range(N)]
        there = [(t + DELAY + offset, data) for i, (t, data) in enumerate(here) if i not in LOST]
        answers = [(100.003 + i * INTERVAL, frame(b"a%d" % i, back=True)) for i in range(N)]
        here, there = sorted(here + answers), sorted(there + [(t - DELAY + offset, data) for t, data in answers])
        found = measured(
            write(tmp_path / "sent.pcap", here), Options(received=write(tmp_path / "received.pcap", there))
        )  # fmt: skip
        assert found.uplink is not None
        assert set(np.flatnonzero(found.uplink.lost).tolist()) == LOST
        assert found.uplink.delay is not None
        assert np.nanmedian(found.uplink.delay) == pytest.approx(DELAY + offset, abs=2e-6)
        assert "the flow back is there, too" in found.notes[1]


def test_many_keys_are_matched_as_few_are(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    sent = rng.integers(0, 2**64, 3000, dtype=np.uint64)
    sent[rng.integers(0, 3000, 500)] = sent[7]
    arrived = np.delete(sent, rng.integers(0, 3000, 300))
    few = arrivals(sent, arrived)
    assert np.count_nonzero(few < 0) == len(sent) - len(arrived)
    monkeypatch.setattr(capture, "_MATCHED", 100)
    np.testing.assert_array_equal(arrivals(sent, arrived), few)


def test_a_capture_of_the_other_end_goes_with_a_capture(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("time,lost\n1,0\n2,1\n")
    with pytest.raises(MeasurementError, match=r"is not a capture .* and --received is a capture of the other end"):
        read_link(path, Options(received=path))


def ip6(payload: bytes) -> bytes:
    udp = dpkt.udp.UDP(sport=5000, dport=7411, data=payload)
    udp.ulen = len(udp)
    address = b"\xfe\x80" + bytes(13)
    ip = dpkt.ip6.IP6(src=address + b"\x01", dst=address + b"\x02", nxt=dpkt.ip.IP_PROTO_UDP, data=udp)
    ip.plen = len(udp)
    return bytes(ip)


FRAMES: dict[str, tuple[int, Callable[[bytes], bytes]]] = {
    "vlan": (1, lambda payload: frame(payload)[:12] + b"\x81\x00\x00\x05" + frame(payload)[12:]),
    "ipv6": (1, lambda payload: frame(payload)[:12] + b"\x86\xdd" + ip6(payload)),
    "any device": (113, lambda payload: struct.pack(">HHH8sH", 0, 1, 6, b"\x01" * 8, 0x0800) + frame(payload)[14:]),
    "no frame": (101, lambda payload: frame(payload)[14:]),
    "no frame, ipv6": (101, ip6),
    "loopback": (108, lambda payload: struct.pack(">I", 2) + frame(payload)[14:]),
}


@pytest.mark.parametrize("kind", list(FRAMES))
def test_whatever_is_about_a_packet(tmp_path: Path, kind: str) -> None:
    """A pcap with times in nanoseconds and the other order of bytes, of each kind of link."""
    link, around = FRAMES[kind]
    head = struct.pack(">IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 65535, link)
    packets = [(i, around(rtps(i + 1))) for i in range(N) if i not in LOST]
    records = [struct.pack(">IIII", 100, 5_000_000 * i, len(data), len(data)) + data for i, data in packets]
    (tmp_path / "x.pcap").write_bytes(head + b"".join(records))
    found = measured(tmp_path / "x.pcap")
    assert set(np.flatnonzero(found.whole.lost).tolist()) == LOST
    assert found.sent[10] == pytest.approx(0.05, abs=1e-6)


def test_a_capture_of_several_kinds_of_interfaces_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "x.pcapng", [(1.0 + i, frame(rtps(i + 1))) for i in range(4)], new=True)
    content = path.read_bytes()
    begin = struct.unpack_from("<I", content, 4)[0]
    end = begin + struct.unpack_from("<I", content, begin + 4)[0]
    path.write_bytes(content[:end] + content[begin:end] + content[end:])  # the same interface twice does no harm
    assert measured(path).packets == 4
    other = content[begin : begin + 8] + struct.pack("<H", 101) + content[begin + 10 : end]
    path.write_bytes(content[:end] + other + content[end:])
    with pytest.raises(MeasurementError, match="has packets of 2 kinds of interfaces: write those of one to a file"):
        read_link(path)
