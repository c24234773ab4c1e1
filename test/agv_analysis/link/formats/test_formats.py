"""Files of every format, written here after its description with known losses and delays, give exactly those."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard

from agv_analysis.link.formats import FORMATS, format_of, read_link
from agv_analysis.link.formats.format import Options
from agv_analysis.link.link_figures import LinkFigures, rate_of, rates_to_json
from agv_analysis.link.measurement import LossRates, Measurement, MeasurementError

N, INTERVAL, BEGIN = 200, 0.02, 1_700_000_000.0
LOST_UP = {7, 8, 9, 50, 120}
LOST_DOWN = {30, 31, 160}
LOST = LOST_UP | LOST_DOWN
UP = [0.004 + 0.0001 * (i % 7) for i in range(N)]
DOWN = [0.003 + 0.0001 * (i % 5) for i in range(N)]
RTT = [round(up + down, 6) for up, down in zip(UP, DOWN, strict=True)]


def sent(i: int) -> float:
    return BEGIN + i * INTERVAL


def reply(i: int, stamp: bool = True, number: int | None = None) -> str:
    at = f"[{sent(i) + RTT[i]:.6f}] " if stamp else ""
    return (
        f"{at}64 bytes from 10.0.0.2: icmp_seq={i + 1 if number is None else number} ttl=64 time={1e3 * RTT[i]:.3g} ms"
    )


def ping(path: Path, stamp: bool = True, verbose: bool = False, summary: bool = True) -> Path:
    lines = ["PING 10.0.0.2 (10.0.0.2) 56(84) bytes of data."]
    for i in range(N):
        if i not in LOST:
            lines.append(reply(i, stamp))
        elif verbose:
            lines.append((f"[{sent(i + 1):.6f}] " if stamp else "") + f"no answer yet for icmp_seq={i + 1}")
    if summary:
        got = N - len(LOST)
        lines += ["", "--- 10.0.0.2 ping statistics ---"]
        lines += [f"{N} packets transmitted, {got} received, 4% packet loss, time {round(1e3 * INTERVAL * (N - 1))}ms"]
        lines += ["rtt min/avg/max/mdev = 7.000/7.400/8.000/0.200 ms"]
    path.write_text("\n".join(lines) + "\n")
    return path


def busybox(path: Path) -> Path:
    lines = ["PING 10.0.0.2 (10.0.0.2): 56 data bytes"]
    lines += [f"64 bytes from 10.0.0.2: seq={i} ttl=64 time={1e3 * RTT[i]:.3f} ms" for i in range(N) if i not in LOST]
    lines += ["", "--- 10.0.0.2 ping statistics ---"]
    lines += [f"{N} packets transmitted, {N - len(LOST)} packets received, 4% packet loss"]
    lines += ["round-trip min/avg/max = 7.000/7.400/8.000 ms"]
    path.write_text("\n".join(lines) + "\n")
    return path


def round_trip(i: int, told: bool = True) -> dict[str, object]:
    wall = round(1e9 * sent(i))
    if i in LOST:
        word: object = ("true_up" if i in LOST_UP else "true_down") if told else True
        client = {"receive": {}, "send": {"wall": wall, "monotonic": wall - 10**9}}
        server: dict[str, object] = {"receive": {}, "send": {}}
        return {"seqno": i, "lost": word, "timestamps": {"client": client, "server": server}, "delay": {}, "ipdv": {}}
    stamps = {"client": {"receive": {"wall": wall + 1}, "send": {"wall": wall, "monotonic": wall - 10**9}}}
    delay = {"receive": round(1e9 * DOWN[i]), "rtt": round(1e9 * RTT[i]), "send": round(1e9 * UP[i])}
    return {"seqno": i, "lost": "false" if told else False, "timestamps": stamps, "delay": delay, "ipdv": {"rtt": 1}}


def irtt(path: Path, told: bool = True, indent: int | None = 4) -> Path:
    content = {
        "version": {"irtt": "0.9.1"}, "system_info": {"os": "linux"},
        "config": {"open_timeouts": "1s", "params": {"interval": round(1e9 * INTERVAL), "received_stats": "both"}},
        "stats": {"packets_sent": N}, "round_trips": [round_trip(i, told) for i in range(N)],
    }  # fmt: skip
    text = json.dumps(content, indent=indent).encode()
    path.write_bytes(gzip.compress(text) if path.suffix == ".gz" else text)
    return path


def irtt_raw(path: Path) -> Path:
    lines = []
    for i in range(N):
        if i not in LOST:
            lines.append(f"{i} {1e3 * RTT[i]:f} {1e3 * DOWN[i]:f} {1e3 * UP[i]:f} NaN 0 0")
        if i == 20:
            lines.append(f"{i} NaN NaN NaN NaN 1 NaN")
    path.write_text("\n".join(lines) + "\n")
    return path


def irtt_text(path: Path) -> Path:
    lines = ["[Connecting] connecting to 10.0.0.2", "[Connected] connected to 10.0.0.2:2112"]
    for i in range(N):
        if i not in LOST:
            rtt, rd, sd = f"{1e3 * RTT[i]:.4f}ms", f"{1e6 * DOWN[i]:.1f}µs", f"{UP[i]:.7f}s"
            lines.append(f"seq={i} rtt={rtt} rd={rd} sd={sd} ipdv=n/a" + (" (LATE)" if i == 12 else ""))
        if i == 20:
            lines.append(f"DUP! seq={i}")
    lines += ["", "                         Min     Mean   Median", "                duration: 4s (wait 3s)"]
    path.write_text("\n".join(lines) + "\n")
    return path


def owping(path: Path) -> Path:
    """Seconds since 1900 as whole numbers of 2^-32 s; lost packets come last, with no time of arrival."""

    def ntp(t: float) -> int:
        return round(t * 2**32) + (3_900_000_000 << 32)

    at = [i * INTERVAL for i in range(N)]
    rows = [f"{i} {ntp(at[i])} 1 0.000106 {ntp(at[i] + UP[i])} 1 0.00011 254" for i in range(N) if i not in LOST_UP]
    rows += [f"{i} {ntp(at[i])} 1 0.000106 0 0 0 255" for i in sorted(LOST_UP)]
    path.write_text("\n".join(rows) + "\n")
    return path


def by_number(i: int) -> str:
    return f"{i},{sent(i):.6f}," + ("" if i in LOST_UP else f"{sent(i) + UP[i]:.7f}")


def flags(i: int) -> str:
    return f"{sent(i):.6f};{int(i in LOST_UP)};" + ("nan" if i in LOST_UP else f"{1e3 * UP[i]:.6f}")


def words(i: int) -> str:
    return "\t".join((f"{sent(i):.6f}", *(("lost", "") if i in LOST_UP else ("delivered", f"{UP[i]:.7e}"))))


def quoted(i: int) -> str:
    cells = (f"{sent(i):.6f}", "false" if i in LOST_UP else "true", f"{1e6 * UP[i]:.2f}")
    return ",".join(f'"{cell}"' for cell in cells)


def other_names(i: int) -> str:
    return f"{sent(i):.6f},{int(i in LOST_UP)},{UP[i]:.7f}"


ROLES = {"time": "when", "lost": "gone", "delay": "took"}


def tables(folder: Path) -> list[tuple[Path, Options]]:
    rows = {
        "by_number.csv": ("seq,sent,received", by_number, Options()),
        "flags.csv": ("time;lost;delay_ms", flags, Options()),
        "words.tsv": ("time\tverdict\tdelay", words, Options()),
        "quoted.csv": ('"time","received","delay_us"', quoted, Options()),
        "named.csv": ("when,gone,took", other_names, Options(columns=ROLES)),
    }
    found = []
    for name, (header, row, options) in rows.items():
        (folder / name).write_text("\n".join([header, *map(row, range(N))]) + "\n")
        found.append((folder / name, options))
    return found


def measured(path: Path, options: Options | None = None) -> Measurement:
    found = read_link(path, options)
    assert isinstance(found, Measurement)
    return found


def check(
    found: Measurement, of: set[int], delays: list[float], which: str = "round_trip", tolerance: float = 1e-9
) -> None:
    packets = getattr(found, which)
    assert found.packets == N
    assert set(np.flatnonzero(packets.lost).tolist()) == of
    kept = [i for i in range(N) if i not in of]
    assert packets.delay[kept] == pytest.approx([delays[i] for i in kept], abs=tolerance)
    assert found.malformed.count == 0


@pytest.mark.parametrize("verbose", [False, True])
@pytest.mark.parametrize("stamp", [False, True])
def test_ping(tmp_path: Path, stamp: bool, verbose: bool) -> None:
    found = measured(ping(tmp_path / "log", stamp, verbose))
    assert found.format == "ping"
    check(found, LOST, RTT, tolerance=6e-6)  # three digits
    assert found.interval == pytest.approx(INTERVAL, abs=1e-5)
    assert found.span == pytest.approx((N - 1) * INTERVAL, abs=1e-4)
    assert (found.duplicates, found.reordered) == (0, 0)
    assert found.uplink is None
    if stamp:
        assert found.sent[100] == pytest.approx(100 * INTERVAL, abs=1e-5)


def test_ping_of_busybox(tmp_path: Path) -> None:
    found = measured(busybox(tmp_path / "log"))
    check(found, LOST, RTT, tolerance=1e-6)
    assert found.interval == 1.0
    assert "usual 1 s is assumed" in " ".join(found.notes)
    assert measured(tmp_path / "log", Options(interval=0.5)).interval == 0.5


def test_ping_out_of_order_twice_late_and_cut_off(tmp_path: Path) -> None:
    log = tmp_path / "log"
    numbers = [1, 2, 4, 3, 3, 6, 5, 8]  # 3 twice, 3 and 5 late, 7 lost; -O asked for 5 before it came
    lines = [reply(i, number=n) for i, n in enumerate(numbers)]
    lines.insert(5, "[1700000000.100000] no answer yet for icmp_seq=5")
    lines[4] += " (DUP!)"
    log.write_text("PING x (1.2.3.4) 56(84) bytes of data.\n" + "\n".join(lines) + "\n64 bytes from 1.2.3.4: icmp_s\n")
    found = measured(log)
    assert (found.packets, found.duplicates, found.reordered) == (8, 1, 2)
    assert np.flatnonzero(found.whole.lost).tolist() == [6]
    assert found.malformed.count == 1
    assert "line 11: '64 bytes from 1.2.3.4: icmp_s'" in found.malformed.shown
    assert "the summary is missing" in " ".join(found.notes)


def test_ping_whose_first_and_last_packets_were_lost(tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.write_text(
        "PING x (1.2.3.4) 56(84) bytes of data.\nFrom 10.0.0.1 icmp_seq=2 Destination Host Unreachable\n"
        + "".join(f"64 bytes from x (1.2.3.4): icmp_seq={n} ttl=3 time=1.5 ms\n" for n in (3, 4))
        + "\n--- x ping statistics ---\n7 packets transmitted, 2 received, +1 errors, 71% packet loss, time 1200ms\n"
    )
    found = measured(log)
    assert found.whole.lost.tolist() == [True, True, False, False, True, True, True]
    assert found.interval == pytest.approx(0.2)


def test_numbers_of_ping_begin_anew_after_16_bits(tmp_path: Path) -> None:
    log = tmp_path / "log"
    numbers = [n for n in range(1, 70_001) if n % 1000]
    log.write_text("".join(f"64 bytes from 1.2.3.4: icmp_seq={n % 65536} ttl=64 time=1.0 ms\n" for n in numbers))
    found = measured(log)
    assert (found.packets, int(found.whole.lost.sum()), found.duplicates) == (69_999, 69, 0)


def test_a_summary_alone_is_no_measurement(tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.write_text("PING x (1.2.3.4) 56(84) bytes of data.\n\n--- x ping statistics ---\n"
                   "7 packets transmitted, 2 received, 71% packet loss, time 1200ms\n")  # fmt: skip
    with pytest.raises(MeasurementError, match="has the summary alone; run ping without -q"):
        read_link(log)


@pytest.mark.parametrize(("name", "indent"), [("a.json", 4), ("b.json", None), ("c.json.gz", 4)])
def test_irtt(tmp_path: Path, name: str, indent: int | None) -> None:
    found = measured(irtt(tmp_path / name, indent=indent))
    check(found, LOST, RTT)
    assert found.uplink is not None
    assert found.downlink is not None
    assert set(np.flatnonzero(found.uplink.lost).tolist()) == LOST_UP
    assert set(np.flatnonzero(found.downlink.lost).tolist()) == LOST_DOWN
    assert found.interval == pytest.approx(INTERVAL)
    figures = LinkFigures(found).to_json()
    assert figures["uplink"]["loss_rate"]["value"] == len(LOST_UP) / N
    assert figures["downlink"]["loss_rate"]["value"] == len(LOST_DOWN) / (N - len(LOST_UP))  # what was sent at all
    assert figures["outage_max_s"] == pytest.approx(3 * INTERVAL)
    assert figures["uplink"]["outage_max_s"] == pytest.approx(3 * INTERVAL)
    assert figures["downlink"]["outage_max_s"] == pytest.approx(2 * INTERVAL)
    assert figures["uplink"]["delay"]["max_s"] == pytest.approx(max(UP))


def test_irtt_that_does_not_know_the_way_says_so(tmp_path: Path) -> None:
    figures = LinkFigures(measured(irtt(tmp_path / "a.json", told=False))).to_json()
    assert figures["uplink"]["loss_rate"] is None
    assert figures["downlink"]["loss_rate"] is None
    assert figures["round_trip"]["loss_rate"]["value"] == len(LOST) / N
    assert figures["uplink"]["delay"]["p50_s"] == pytest.approx(0.0043)
    assert f"of {len(LOST)} lost packets irtt does not know on which way" in figures["notes"][0]


def test_irtt_that_was_cut_off_keeps_what_is_whole(tmp_path: Path) -> None:
    path = irtt(tmp_path / "a.json")
    text = path.read_text()
    path.write_text(text[: text.index('"seqno": 100,') + 40])
    found = measured(path)
    assert found.packets == 100
    assert found.malformed.count == 1


def test_irtt_raw(tmp_path: Path) -> None:
    found = measured(irtt_raw(tmp_path / "raw.txt"), Options(interval=INTERVAL))
    assert (found.format, found.duplicates) == ("irtt -r", 1)
    assert found.interval == pytest.approx(INTERVAL)
    check(found, LOST, RTT)
    figures = LinkFigures(found).to_json()
    assert figures["uplink"]["loss_rate"] is None
    assert figures["uplink"]["delay"]["max_s"] == pytest.approx(max(UP))


def test_irtt_text(tmp_path: Path) -> None:
    found = measured(irtt_text(tmp_path / "irtt.txt"), Options(interval=INTERVAL))
    assert (found.duplicates, found.reordered) == (1, 0)
    check(found, LOST, RTT)
    assert found.uplink is not None
    assert found.uplink.delay is not None
    assert np.nanmax(found.uplink.delay) == pytest.approx(max(UP))


def test_ping_in_another_language(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_text("PING x (1.2.3.4) 56(84) Bytes an Daten.\n64 Bytes von 1.2.3.4: icmp_seq=1 ttl=64 Zeit=1.5 ms\n"
                    "64 Bytes von 1.2.3.4: icmp_seq=3 ttl=64 Zeit=2 ms\n")  # fmt: skip
    found = measured(path)
    assert found.whole.lost.tolist() == [False, True, False]
    assert found.whole.delay is not None
    assert found.whole.delay[[0, 2]] == pytest.approx([0.0015, 0.002])


def test_owping(tmp_path: Path) -> None:
    found = measured(owping(tmp_path / "ow.txt"))
    check(found, LOST_UP, UP, "uplink")
    assert found.round_trip is None
    assert found.interval == pytest.approx(INTERVAL)
    assert LinkFigures(found).to_json()["downlink"]["loss_rate"] is None


def test_tables(tmp_path: Path) -> None:
    for path, options in tables(tmp_path):
        found = measured(path, options)
        assert found.format == "table", path
        check(found, LOST_UP, UP, "uplink", 3e-7)  # seconds since 1970 as a float
        assert found.interval == pytest.approx(INTERVAL, abs=1e-6)


def test_a_table_of_what_was_received(tmp_path: Path) -> None:
    """As tshark exports a capture: numbers without a row were lost."""
    path = tmp_path / "tshark.csv"
    rows = [f"{sent(i):.9f},{i},{1e3 * RTT[i]:.4f}" for i in range(N) if i not in LOST]
    path.write_text("frame.time_epoch,icmp.seq,icmp.resptime\n" + "\n".join(rows) + "\n")
    check(measured(path), LOST, RTT, tolerance=1e-6)


def test_lines_that_are_no_rows_are_named_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("time,lost\n0.0,0\n0.1\n0.2,1\nnow,0\n0.4,perhaps\n0.5,0\n")
    found = measured(path)
    assert found.whole.lost.tolist() == [False, True, False]
    assert found.malformed.shown == ["line 3: '0.1'", "line 5: 'now,0'", "line 6: '0.4,perhaps'"]


def test_mahimahi(tmp_path: Path) -> None:
    """Opportunities each millisecond but for 50 ms: a packet waits until the next one."""
    path = tmp_path / "up.trace"
    path.write_text("\n".join(str(ms) for ms in [*range(1, 101), *range(150, 201)]) + "\n")
    found = measured(path, Options(interval=0.01))
    assert found.format == "mahimahi"
    assert found.packets == 20
    assert not found.whole.lost.any()
    delay = found.whole.delay
    assert delay is not None
    assert delay[[0, 5, 10, 11, 14, 15]] == pytest.approx([0.001, 0.0, 0.0, 0.04, 0.01, 0.0])


def iperf3(protocol: str = "UDP") -> dict[str, object]:
    sums = [
        {"start": float(s), "end": s + 1.0, "packets": 1000, "lost_packets": lost, "lost_percent": lost / 10.0}
        for s, lost in enumerate((0, 5, 0, 0, 45, 0, 0, 0, 0, 0))
    ]
    start = {"version": "iperf 3.16", "test_start": {"protocol": protocol, "reverse": 0}}
    return {"start": start, "intervals": [{"sum": one} for one in sums], "end": {}}


def test_iperf3_is_a_loss_rate_and_no_trace(tmp_path: Path) -> None:
    path = tmp_path / "iperf.json"
    path.write_text(json.dumps(iperf3()))
    found = read_link(path)
    assert isinstance(found, LossRates)
    rate = rate_of(found)
    assert rate.value == pytest.approx(0.005)
    assert rate.high > 0.01  # as bursty as it is: binomial would be 0.0066
    figures = rates_to_json(found)
    assert figures["uplink"]["loss_rate"]["value"] == pytest.approx(0.005)
    assert figures["downlink"]["loss_rate"] is None
    assert "counts losses per interval of 1 s and does not say which packets were lost" in found.refusal
    assert "\n" not in found.refusal
    path.write_text(json.dumps(iperf3("TCP")))
    with pytest.raises(MeasurementError, match="over TCP, which sends again what is lost"):
        read_link(path)


WRITERS: dict[str, Callable[[Path], Path]] = {
    "irtt-text": irtt_text,
    "ping": ping, "irtt": irtt, "irtt-raw": irtt_raw, "owping": owping, "table": lambda path: tables(path.parent)[0][0],
}  # fmt: skip


def test_what_is_read_as_a_whole_is_refused_where_it_does_not_fit(tmp_path: Path) -> None:
    path = tmp_path / "iperf3.json"
    path.write_text('{"test_start": {}}')
    with path.open("r+b") as file:
        file.truncate(1 << 43)  # takes no space where nothing is written
    with pytest.raises(MeasurementError, match=r"takes 3\.52e\+04 GB of memory at least, since it is read as a whole"):
        read_link(path)


def test_formats_are_found_by_content_whatever_the_name(tmp_path: Path) -> None:
    for name, write in WRITERS.items():
        path = write(tmp_path / "file.dat")
        assert format_of(path).name == name


def test_what_is_no_measurement_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "letter.txt"
    path.write_text("Dear Sir,\nthe link is fine.\n")
    with pytest.raises(MeasurementError, match="unknown format, known are: "):
        read_link(path)
    with pytest.raises(MeasurementError, match=f"no format is called 'pong': use one of {', '.join(FORMATS)}"):
        read_link(path, name="pong")
    with pytest.raises(MeasurementError, match="no such file"):
        read_link(tmp_path / "none")
    (tmp_path / "empty").touch()
    with pytest.raises(MeasurementError, match="is empty"):
        read_link(tmp_path / "empty")
    for name in FORMATS:
        with pytest.raises(MeasurementError):
            read_link(path, name=name)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("64 bytes from x: icmp_seq=1 ttl=1 time=1 ms\n64 bytes from x: icmp_seq=9000000000 ttl=1 time=1 ms\n",
         "numbers go from 1 to 9000000000, and 2 packets have one"),
        ("1\n2\n999999999999\n", "too long for a packet every 0.005 s"),
        ('{"start": {"version": "iperf 3"}, "intervals": [{"sum": {"packets": 5, "lost_packets": 1}}]}',
         "has neither intervals nor sums"),
        ('{"start": {"version": "iperf 3"', "is not a whole JSON file"),
        ('{"system_info": {}, "open_timeouts": "1s", "round_trips": [', "has no round trips"),
        ("seq,time,rtt\n,,\n", "has no row with a number"),
    ],
)  # fmt: skip
def test_broken_files_are_refused_with_a_reason(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "file"
    path.write_text(text)
    with pytest.raises(MeasurementError, match=complaint):
        read_link(path)


def test_the_page_of_links_has_a_row_for_every_format() -> None:
    page = (Path(__file__).parents[4] / "docs/links.md").read_text()
    assert [name for name in FORMATS if f"`{name}`" not in page] == []


def test_a_topic_of_a_bag_is_a_link() -> None:
    """The sample's poses at the edge against its own slots."""
    sample = Path(__file__).parents[4] / "bags/sample"
    of_slots, of_topic = measured(sample), measured(sample, Options(topic="edge/pose"))
    assert of_slots.uplink is not None
    assert of_topic.uplink is not None
    last = of_topic.packets  # what was lost after the last pose leaves no trace in the topic
    assert of_topic.uplink.lost.tolist() == of_slots.uplink.lost[:last].tolist()
    assert of_slots.uplink.lost[last:].all()
    with pytest.raises(MeasurementError, match="has no topic nowhere; it has"):
        read_link(sample, Options(topic="nowhere"))


@pytest.mark.parametrize("name", ["a.mcap.zst", "folder"])
def test_a_bag_is_one_however_it_was_compressed(tmp_path: Path, name: str) -> None:
    sample = Path(__file__).parents[4] / "bags/sample"
    packed = zstandard.compress((sample / "sample_0.mcap").read_bytes())
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "a.mcap.zst", tmp_path / "folder" / "a_0.mcap.zstd"):
        path.write_bytes(packed)
    found, plain = measured(tmp_path / name).uplink, measured(sample).uplink
    assert found is not None
    assert plain is not None
    assert found.lost.tolist() == plain.lost.tolist()
