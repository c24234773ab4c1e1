"""What the formats look like in the wild: other tools, languages and clocks, spreadsheets; cut off, half filled."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.link.formats import format_of, read_link
from agv_analysis.link.formats.format import Options
from agv_analysis.link.link_figures import LinkFigures, setting_to_json
from agv_analysis.link.measurement import (
    LOST,
    NOT_SENT,
    RECEIVED,
    UNKNOWN,
    LossRates,
    Measurement,
    MeasurementError,
    Reading,
    Setting,
)
from agv_ros.errors import UserError

NAN = float("nan")


def to_json(found: Reading) -> dict[str, object]:
    assert not isinstance(found, LossRates)
    return setting_to_json(found) if isinstance(found, Setting) else LinkFigures(found).to_json()


def read(path: Path, text: str, options: Options | None = None) -> Measurement:
    path.write_text(text, encoding="utf-8")
    found = read_link(path, options)
    assert isinstance(found, Measurement)
    return found


def delays(found: Measurement) -> list[float]:
    assert found.whole.delay is not None
    return [float(value) for value in found.whole.delay]


def lost(found: Measurement) -> list[int]:
    return [int(i) for i in np.flatnonzero(found.whole.lost)]


def said(found: Measurement) -> str:
    return " ".join((*found.notes, *found.malformed.sentences()))


@pytest.mark.parametrize(
    ("options", "name", "flag"),
    [
        (Options(topic="/edge/pose"), "", "--topic"),
        (Options(columns={"time": "t"}), "ping", "--column"),
        (Options(delimiter=";"), "ping", "--delimiter"),
        (Options(received=Path("there.pcap")), "", "--received"),
    ],
)
def test_an_option_about_another_kind_of_file_is_refused(
    tmp_path: Path, options: Options, name: str, flag: str
) -> None:
    path = tmp_path / "log"
    path.write_text("64 bytes from 10.0.0.2: icmp_seq=1 ttl=64 time=1 ms\n")
    with pytest.raises(MeasurementError, match=rf"log: is not a .* \(output of ping\), and {flag} "):
        read_link(path, options, name)


# -- ping --------------------------------------------------------------------------------------------------------------


def test_ping_of_ipv6_on_linux_and_on_the_bsds(tmp_path: Path) -> None:
    linux = (
        "PING fe80::1%eth0(fe80::1%eth0) 56 data bytes\n"
        "64 bytes from fe80::1%eth0: icmp_seq=1 ttl=64 time=0.25 ms\n"
        "64 bytes from host (2001:db8::1): icmp_seq=3 ttl=57 time=12 ms\n"
    )
    found = read(tmp_path / "a", linux)
    assert (lost(found), found.malformed.count) == ([1], 0)
    assert delays(found) == pytest.approx([0.00025, NAN, 0.012], nan_ok=True)
    bsd = (
        "PING6(56=40+8+8 bytes) ::1 --> ::1\n16 bytes from ::1, icmp_seq=0 hlim=64 time=0.059 ms\n"
        "Request timeout for icmp_seq 1\n16 bytes from ::1, icmp_seq=2 hlim=64 time=0.061 ms\n\n"
        "--- ::1 ping6 statistics ---\n3 packets transmitted, 2 packets received, 33.3% packet loss\n"
        "round-trip min/avg/max/std-dev = 0.059/0.060/0.061/0.001 ms\n"
    )
    found = read(tmp_path / "b", bsd)
    assert (lost(found), found.malformed.count, found.packets) == ([1], 0, 3)
    assert delays(found)[0] == pytest.approx(59e-6)


def test_ping_with_decimal_commas_and_in_another_language(tmp_path: Path) -> None:
    found = read(
        tmp_path / "a",
        "PING x (1.2.3.4) 56(84) Bytes an Daten.\n[1700000000,500000] 64 Bytes von 1.2.3.4: icmp_seq=1 ttl=64 "
        "Zeit=1,25 ms\n[1700000001,500000] noch keine Antwort f\xfcr icmp_seq=2\n"
        "[1700000002,750000] 64 Bytes von 1.2.3.4: icmp_seq=3 ttl=64 Zeit=250 ms\n",
    )
    assert (lost(found), found.malformed.count) == ([1], 0)
    assert delays(found) == pytest.approx([0.00125, NAN, 0.25], nan_ok=True)
    assert found.span == pytest.approx(2.00125)  # stamps less the round trip


@pytest.mark.parametrize(
    "summary",
    [
        "5 Pakete übertragen, 3 empfangen, 40% Paketverlust, Zeit 80 ms",
        "5 paquets transmis, 3 reçus, 40% packet loss, time 80ms",
        "5 packets transmitted, 3 received, +1 errors, 40% packet loss, time 80ms",
        "5 packets transmitted, 3 received, 1 packets out of wait time, 40.0% packet loss, time 80ms",
        "送信パケット数 5, 受信パケット数 3, パケット損失 40%, 時間 80ミリ秒",
        "已发送 5 个包， 已接收 3 个包, 40% packet loss, time 80ms",
    ],
)
def test_the_summary_of_ping_counts_what_was_lost_last_in_any_language(tmp_path: Path, summary: str) -> None:
    lines = [f"64 Bytes von 1.1.1.1: icmp_seq={n} ttl=64 Zeit=0,5 ms" for n in (1, 2, 3)]
    text = "\n".join(
        ["PING 1.1.1.1 (1.1.1.1) 56(84) Bytes Daten.", *lines, "", "--- 1.1.1.1 ping-Statistik ---", summary]
    )
    found = read(tmp_path / "a", text + "\nrtt min/avg/max/mdev = 0,5/0,5/0,5/0,0 ms\n")
    assert (found.packets, lost(found), found.malformed.count) == (5, [3, 4], 0)
    assert found.interval == pytest.approx(0.02)
    assert "by its summary" not in said(found)
    found = read(tmp_path / "b", text.replace(f"{lines[1]}\n", ""))
    assert lost(found) == [1, 3, 4]
    assert "2 replies are in the log, and 3 by its summary" in said(found)


@pytest.mark.parametrize(
    "line",
    [
        "64 バイト応答 送信元 1.1.1.1: icmp_seq={} ttl=64 時間=121 ミリ秒",
        "64 バイト応答 送信元 1.1.1.1: icmp_seq={} ttl=64 時間=121ミリ秒",
        "64 字节，来自 1.1.1.1: icmp_seq={} ttl=64 时间=121 毫秒",
        "64 байт из 1.1.1.1: icmp_seq={} ttl=64 время=121 мс",
    ],
)
def test_ping_with_a_unit_in_other_letters(tmp_path: Path, line: str) -> None:
    found = read(tmp_path / "a", "\n".join(line.format(n) for n in (1, 3)) + "\n")
    assert delays(found) == pytest.approx([0.121, NAN, 0.121], nan_ok=True)


def test_ping_that_was_cut_at_its_beginning_and_in_a_number(tmp_path: Path) -> None:
    found = read(
        tmp_path / "a",
        " from 1.2.3.4: icmp_seq=40 ttl=64 time=1.0 ms\n64 bytes from 1.2.3.4: icmp_seq=41 ttl=64 time=1.0 ms\n"
        "64 bytes from 1.2.3.4: icmp_seq=42 ttl=64 time=1.0 ms\n64 bytes from 1.2.3.4: icmp_seq=4",
    )
    assert (found.packets, lost(found), found.malformed.count, found.duplicates) == (2, [], 2, 0)
    assert "line 1: 'from 1.2.3.4: icmp_seq=40" in said(found)
    assert "the beginning of the log is missing" in said(found)


def test_ping_with_all_that_may_be_on_its_lines(tmp_path: Path) -> None:
    found = read(
        tmp_path / "a",
        "PING x (1.2.3.4) 56(84) bytes of data.\n"
        "64 bytes from 1.2.3.4: icmp_seq=1 ttl=64 time<1 ms\n"
        "64 bytes from 1.2.3.4: icmp_seq=1 ttl=64 time=3.0 ms (DUP!)\n"
        "8 bytes from 1.2.3.4: icmp_seq=2 ttl=64 (truncated)\n"
        "From 10.0.0.1: icmp_seq=3 Redirect Host(New nexthop: 10.0.0.9)\n"
        "64 bytes from 1.2.3.4: icmp_seq=3 ttl=64 time=2.0 ms\n"
        "wrong data byte #16 should be 0x10 but was 0x11\n"
        "From 10.0.0.1 icmp_seq=4 Time to live exceeded\n"
        "ping: sendmsg: Network is unreachable\n"
        "64 bytes from 1.2.3.4: icmp_seq=6 ttl=64 time=2.0 ms\n"
        "something else\n",
    )
    assert (lost(found), found.duplicates, found.malformed.shown) == ([3, 4], 1, ["line 11: 'something else'"])
    assert delays(found) == pytest.approx([0.001, NAN, 0.002, NAN, NAN, 0.002], nan_ok=True)
    assert "1 replies took less than the time that is printed" in said(found)


@pytest.mark.parametrize("errors", ["", "+3 errors, "])
def test_a_summary_by_which_all_was_lost_is_enough(tmp_path: Path, errors: str) -> None:
    text = (
        "PING 10.0.0.2 (10.0.0.2) 56(84) bytes of data.\n\n--- 10.0.0.2 ping statistics ---\n"
        f"5 packets transmitted, 0 received, {errors}100% packet loss, time 800ms\n\n"
    )
    found = read(tmp_path / "a", text)
    assert (lost(found), found.whole.is_told) == ([0, 1, 2, 3, 4], True)
    assert found.interval == pytest.approx(0.2)
    assert delays(found) == pytest.approx([NAN] * 5, nan_ok=True)


def test_two_runs_of_ping_in_one_file_are_refused(tmp_path: Path) -> None:
    run = "PING x (1.2.3.4) 56(84) bytes of data.\n64 bytes from 1.2.3.4: icmp_seq=1 ttl=64 time=1.0 ms\n\n"
    with pytest.raises(MeasurementError, match=r"a:4: another run begins: give each run of ping its own file"):
        read(tmp_path / "a", run + run)


def test_numbers_of_ping_come_out_of_order_where_they_begin_anew(tmp_path: Path) -> None:
    numbers = [65533, 65535, 0, 65534, 1, 3]
    found = read(tmp_path / "a", "".join(f"64 bytes from 1.2.3.4: icmp_seq={n} ttl=64 time=1.0 ms\n" for n in numbers))
    assert (found.packets, lost(found), found.reordered, found.duplicates) == (7, [5], 1, 0)


# -- irtt --------------------------------------------------------------------------------------------------------------


def irtt(trips: list[object], tail: str = "]}", params: str = '"interval": 20000000') -> str:
    members = ", ".join(trip if isinstance(trip, str) else json.dumps(trip) for trip in trips)
    return f'{{"config": {{"params": {{{params}}}}}, "round_trips": [{members}{tail}'


def test_irtt_with_fields_that_are_missing(tmp_path: Path) -> None:
    trips: list[object] = [
        {"seqno": 0, "lost": "false", "delay": {"rtt": 5_000_000}},
        {"seqno": 1, "lost": "true_up"},
        {"seqno": 2, "lost": True, "delay": None, "timestamps": None},
        {"seqno": 3, "delay": {"rtt": 6_000_000, "send": None}},
        {"seqno": 4},
        {"seqno": 5, "lost": "TRUE_DOWN", "delay": {"send": 2_000_000}, "extra": [1, {"a": []}, '"]}, ["']},
        {"seqno": 6, "lost": None, "delay": {"rtt": 7_000_000}},
        {"seqno": 7, "lost": None},
    ]
    found = read(tmp_path / "a", irtt(trips))
    assert found.uplink is not None
    assert found.downlink is not None
    assert found.whole.outcome.tolist() == [RECEIVED, LOST, LOST, RECEIVED, UNKNOWN, LOST, RECEIVED, UNKNOWN]
    assert found.uplink.outcome.tolist()[:6] == [RECEIVED, LOST, UNKNOWN, RECEIVED, UNKNOWN, RECEIVED]
    assert found.downlink.outcome.tolist()[:6] == [RECEIVED, NOT_SENT, UNKNOWN, RECEIVED, UNKNOWN, LOST]
    assert found.sent.tolist() == pytest.approx([0.02 * i for i in range(8)])
    assert found.malformed.count == 0
    assert found.uplink.delay is not None
    assert found.uplink.delay[5] == pytest.approx(0.002)
    for sentence in ("of 1 lost packets irtt does not know on which way", "of 2 packets the file does not say",
                     "they are dated by their numbers"):  # fmt: skip
        assert sentence in said(found)


def test_irtt_text_with_what_it_prints_before_and_between(tmp_path: Path) -> None:
    found = read(
        tmp_path / "a",
        "[Connecting] connecting to 10.0.0.2\n[10.0.0.2:2112] [Connected] connection established\nseq=0 rtt=1.02ms\n"
        "[[fe80::1]:2112] [WaitForPackets] waiting 1s for final packets\nseq=2 rtt=900µs\nseq 3\n",
    )
    assert (lost(found), found.malformed.shown) == ([1], ["line 6: 'seq 3'"])
    assert "packets after the last reply are unknown" in said(found)


def test_the_table_below_irtt_text_says_how_many_packets_were_sent(tmp_path: Path) -> None:
    text = (
        "seq=0 rtt=1.02ms rd=0.5ms sd=0.52ms ipdv=n/a\nseq=2 rtt=900µs rd=400µs sd=500µs ipdv=4.2ms\n\n"
        "                duration: 1.01s (wait 139.9ms)\n   packets sent/received: 5/2 (60.00% loss)\n"
        " server packets received: 4/5 (20.00%/50.00% loss up/down)\n"
    )
    found = read(tmp_path / "a", text)
    assert (lost(found), found.packets, found.malformed.count) == ([1, 3, 4], 5, 0)
    assert "packets after" not in said(found)


def test_irtt_text_with_round_trips_of_minutes_and_hours(tmp_path: Path) -> None:
    text = "seq=0 rtt=1.5ms rd=1ms sd=500µs\nseq=1 rtt=1m2.5s rd=1m1s sd=1.5s\nseq=2 rtt=1h0m0.5s rd=1h0m0s sd=500ms\n"
    found = read(tmp_path / "a", text)
    assert found.round_trip is not None
    assert found.round_trip.delay is not None
    assert found.round_trip.delay.tolist() == pytest.approx([0.0015, 62.5, 3600.5])
    assert (lost(found), found.malformed.count) == ([], 0)


def test_irtt_states_what_came_twice_or_late(tmp_path: Path) -> None:
    trips: list[object] = [{"seqno": i, "lost": "false", "delay": {"rtt": 1_000_000 + i}} for i in range(6)]
    text = irtt(trips).replace('"round_trips"', '"stats": {"duplicates": 2, "late_packets": 3}, "round_trips"', 1)
    found = read(tmp_path / "a", text)
    assert (found.packets, found.duplicates, found.reordered) == (6, 2, 3)


def test_irtt_without_a_member_that_is_understood_says_why(tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match=r"has no round trips: 1 line was not understood .*perhaps"):
        read(tmp_path / "a", irtt([{"seqno": 0, "lost": "perhaps"}]))


def test_irtt_with_members_that_are_broken_keeps_the_others(tmp_path: Path) -> None:
    good = [{"seqno": i, "lost": "false", "delay": {"rtt": 1_000_000 + i}} for i in range(6)]
    trips: list[object] = [*good[:2], '{"seqno": 2, "lost": fal', good[3], {"seqno": "4"}, {"lost": "false"}, good[5]]
    found = read(tmp_path / "a", irtt(trips).replace("fal,", "fal},"))
    assert found.malformed.count == 3
    assert found.packets == 4
    assert "2 numbers are missing from the file" in said(found)
    assert delays(found) == pytest.approx([0.001, 0.001000001, 0.001000003, 0.001000005])


def test_irtt_reads_the_same_with_and_without_msgspec(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from agv_analysis.link.formats import irtt_json

    stamp = {"client": {"send": {"wall": 17 * 10**17, "monotonic": 10**9}, "receive": {}}, "server": {}}
    trips: list[object] = [
        {"seqno": i, "lost": ("false", "true", "true_up", "true_down")[i % 4], "timestamps": stamp,
         "delay": {"rtt": 5_000_000 + i, "send": 3_000_000, "receive": 2_000_000}}
        for i in range(500)
    ]  # fmt: skip
    pytest.importorskip("msgspec")
    fast = read(tmp_path / "a", irtt(trips))
    monkeypatch.setattr(irtt_json, "_decoder", lambda: irtt_json._decode_as_json)
    slow = read(tmp_path / "a", irtt(trips))
    assert fast.notes == slow.notes
    for one, other in zip(
        (fast.uplink, fast.downlink, fast.whole), (slow.uplink, slow.downlink, slow.whole), strict=True
    ):
        assert one is not None
        assert other is not None
        assert one.outcome.tolist() == other.outcome.tolist()
        np.testing.assert_array_equal(one.delay, other.delay)


@pytest.mark.parametrize("indent", [None, 4])
def test_irtt_that_is_written_alike_reads_as_the_json_module_reads_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, indent: int | None
) -> None:
    from agv_analysis.link.formats import irtt_json

    rng, trips = np.random.default_rng(1), []
    for i in range(3000):
        stamp = {"wall": 1_700_000_000_000_000_000 + 20_000_000 * i, "monotonic": 20_000_000 * i - 10**9}
        delay = {"receive": int(rng.integers(0, 10**8)), "rtt": int(rng.integers(0, 10**9)), "send": -int(i % 7)}
        trip: dict[str, object] = {
            "seqno": i, "lost": "false", "note": 'seqno 12: "7"', "timestamps": {"client": {"send": stamp}},
            "delay": delay, "ipdv": {"rtt": 3},
        }  # fmt: skip
        kind = int(rng.integers(0, 30))
        if kind < 4:
            trip = {"seqno": i, "lost": ("true_up", "true_down", "true", True)[kind], "timestamps": {}, "delay": {}}
        elif kind < 8:  # what has no shape, or another one each time
            odd = (1.5, 10**25, [1] * i, f"note {i}")[kind - 4]
            trip = {**trip, "delay": {**delay, "rtt": 5.5e6}} if kind == 4 else {**trip, "odd": odd}
        trips.append(trip)
    text = json.dumps({"config": {"params": {"interval": 20_000_000}}, "round_trips": trips}, indent=indent)
    text = text.replace('"seqno": 1500,', '"seqno": 01500,')  # which is not a number of JSON
    monkeypatch.setattr(irtt_json, "_decoder", lambda: irtt_json._decode_as_json)
    expected = read(tmp_path / "a", text)
    monkeypatch.setattr(irtt_json, "_MANY", 0)
    found = read(tmp_path / "a", text)
    assert expected.malformed.count == 1
    assert (found.packets, found.notes, found.malformed) == (2999, expected.notes, expected.malformed)
    np.testing.assert_array_equal(found.sent, expected.sent)
    for name in ("uplink", "downlink", "round_trip"):
        one, other = getattr(found, name), getattr(expected, name)
        np.testing.assert_array_equal(one.outcome, other.outcome)
        np.testing.assert_array_equal(one.delay, other.delay)


@pytest.mark.parametrize("reader", ["msgspec", "json", "alike"])
def test_irtt_that_stamps_by_the_wall_clock_alone_is_as_exact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: str
) -> None:
    from agv_analysis.link.formats import irtt_json

    if reader == "msgspec":
        pytest.importorskip("msgspec")
    else:
        monkeypatch.setattr(irtt_json, "_decoder", lambda: irtt_json._decode_as_json)
        monkeypatch.setattr(irtt_json, "_MANY", 0 if reader == "alike" else 1 << 21)
    begin, step = 1_700_000_000_999_123_457, 2_000_001  # ns
    trips: list[object] = [
        {"seqno": i, "lost": "true_up" if i == 7 else "false", "delay": {} if i == 7 else {"rtt": 5_000_000},
         "timestamps": {"client": {"send": {} if i == 9 else {"wall": begin + i * step}}}}
        for i in range(50)
    ]  # fmt: skip
    found = read(tmp_path / "a", irtt(trips))
    assert lost(found) == [7]
    assert found.sent == pytest.approx([1e-9 * step * i for i in range(50)], abs=1e-12)


@pytest.mark.parametrize("number", ["1" + "0" * 400, "1e400", "-1e30", "123456789012345678901234567890"])
@pytest.mark.parametrize("key", ["rtt", "wall", "monotonic", "seqno"])
def test_irtt_with_numbers_that_are_none_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: str, key: str
) -> None:
    from agv_analysis.link.formats import irtt_json

    def trip(i: int) -> str:
        values = {"seqno": i, "rtt": 5_000_000 + i, "wall": 17 * 10**17 + i, "monotonic": 10**9 + i}
        seqno, rtt, wall, monotonic = (number if (name, i) == (key, 2) else value for name, value in values.items())
        return (
            f'{{"seqno": {seqno}, "lost": "false", "delay": {{"rtt": {rtt}}}, '
            f'"timestamps": {{"client": {{"send": {{"wall": {wall}, "monotonic": {monotonic}}}}}}}}}'
        )

    text = irtt([trip(i) for i in range(5)])
    for decoder in (irtt_json._decoder(), irtt_json._decode_as_json):
        monkeypatch.setattr(irtt_json, "_decoder", lambda found=decoder: found)
        found = read(tmp_path / "a", text)
        assert (found.packets, lost(found), found.malformed.count) == ((4, [], 1) if key == "seqno" else (5, [], 0))
        assert len([late for late in delays(found) if late == late]) == (4 if key in ("rtt", "seqno") else 5)
        assert found.span == pytest.approx(4e-9)


@pytest.mark.parametrize("number", ["1" + "0" * 400, "1e400", "NaN", "1e30"])
def test_totals_that_none_can_be_are_none(tmp_path: Path, number: str) -> None:
    """Of iperf3 those rows are left out; of irtt, whose totals are integers, they are not there."""
    total = {"start": 0, "end": 1.0, "packets": 100, "lost_packets": 3}
    for key, value in total.items():
        text = json.dumps({"start": {"test_start": {"protocol": "UDP"}}, "end": {"sum": total}})
        (tmp_path / "a").write_text(text.replace(f'"{key}": {json.dumps(value)}', f'"{key}": {number}'))
        with pytest.raises(MeasurementError, match="has neither intervals nor sums"):
            read_link(tmp_path / "a")
    trips: list[object] = [{"seqno": i, "lost": "false", "delay": {"rtt": 5_000_000}} for i in range(3)]
    found = read(tmp_path / "b", irtt(trips, params=f'"interval": {number}, "duplicates": {number}'))
    assert (found.interval, found.duplicates) == (1.0, 0)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("number", ["1" + "0" * 400, "1e400", "inf", "99999999999999999999", "1e15"])
def test_numbers_that_nothing_can_be_are_named_or_left_out(tmp_path: Path, number: str) -> None:
    """Whatever is read of such a file is finite, as JSON must be, or it is refused by name."""
    header = "PING 1.1.1.1 (1.1.1.1) 56(84) bytes of data.\n"
    line = "64 bytes from 1.1.1.1: icmp_seq={} ttl=64 time={} ms"
    end = f"\n--- x ping statistics ---\n{number} packets transmitted, {{}} received, 0% packet loss, time {number}ms\n"
    texts = [
        header + line.format(1, 1) + end.format(1),
        header + end.format(0),
        header + "\n".join([line.format(1, 1), line.format(2, number), line.format(number, 1)]),
        f"seq,sent,received\n0,0,0.1\n{number},1,1.1\n2,2,{number}\n3,3,3.1\n",
        f"time,seq,rtt_ms\n0,0,5\n1,{number},5\n{number},2,5\n3,3,{number}\n4,4,5\n",
        f"0 5.0 2.0 3.0 NaN 0 0\n1 {number} 2.0 3.0 NaN 0 0\n{number} 5.0 2.0 3.0 NaN 0 0\n3 5 2 {number} NaN 0 0\n",
        f"seq=0 rtt=1ms\nseq=2 rtt={number}ms\n   packets sent/received: {number}/2 (3% loss)\n",
        f"1\n2\n{number}\n",
        f"delay {number}ms\n",
    ]
    for text in texts:
        path = tmp_path / "log"
        path.write_text(text)
        try:
            answer = json.dumps(to_json(read_link(path)), allow_nan=False)
        except UserError as refused:
            answer = str(refused)
        assert "\n" not in answer


def test_irtt_whose_members_are_longer_than_what_is_read_at_a_time(tmp_path: Path) -> None:
    trips: list[object] = [{"seqno": i, "lost": "false", "note": "x" * 100_000, "delay": {"rtt": i}} for i in range(5)]
    found = read(tmp_path / "a", irtt(trips))
    assert (found.packets, found.malformed.count) == (5, 0)


# -- owping ------------------------------------------------------------------------------------------------------------


def test_owping_without_a_time_to_live_and_out_of_order(tmp_path: Path) -> None:
    base, second = 3_900_000_000 << 32, 1 << 32
    rows = [(0, 0.0, 0.010), (2, 0.2, 0.215), (1, 0.1, 0.230), (3, 0.3, None), (2, 0.2, 0.240)]
    text = "".join(
        f"{n} {base + round(sent * second)} 1 1.2e-05 {0 if at is None else base + round(at * second)} 1 1.3e-05\n"
        for n, sent, at in rows
    )
    found = read(tmp_path / "a", text + "4 garbage\n")
    assert (lost(found), found.reordered, found.duplicates, found.malformed.count) == ([3], 1, 1, 1)
    assert delays(found) == pytest.approx([0.01, 0.13, 0.015, NAN], nan_ok=True, abs=1e-9)


# -- tables ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "Zeit;Time [s];RTT (ms);lost\nx;0,00;12,5;0\nx;0,02;;1\nx;0,04;7;0\n",
        "# made by hand\ntime_s\trtt in us\n0\t12500\n# a remark\n0.02\ttimeout\n0.04\t7000\n",
        'time,rtt/s\r\n"2024-05-01T12:00:00Z","0.0125"\r\n"2024-05-01T12:00:00.02Z",""\r\n"2024-05-01T12:00:00.040Z","7e-3"\r\n',
        "timestamp|RTT [msec]|verdict\n2024-05-01 23:59:59.98+02:00|12.5|delivered\n"
        "2024-05-01 22:00:00|*|lost\n2024-05-02T00:00:00.02+0200|7.0|delivered\n",
        "\ufeffdate;rtt_ms\n2024-02-29 23:59:59,98;12,5\n2024-03-01 00:00:00,00;nan\n2024-03-01 00:00:00,02;7,0\n",
    ],
)
def test_tables_of_spreadsheets_and_scripts(tmp_path: Path, text: str) -> None:
    found = read(tmp_path / "a", text)
    assert (found.format, found.malformed.count, lost(found)) == ("table", 0, [1])
    assert delays(found) == pytest.approx([0.0125, NAN, 0.007], nan_ok=True)
    assert found.sent.tolist() == pytest.approx([0.0, 0.02, 0.04], abs=1e-6)
    assert ("commas are taken for decimal marks" in said(found)) == (";" in text.splitlines()[0])


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("  time   lost  rtt_ms\n  0.0    0     5.0\n0.02\t1 \t nan\r\n 0.04  0  7.0  \n", Options()),
        ("when:gone:rtt_ms\n0.0:0:5.0\n0.02:1:\n0.04:0:7.0\n",
         Options(delimiter=":", columns={"time": "when", "lost": "gone"})),
        ("when gone rtt_ms\n0,0 0 5,0\n0,02 1 -\n0,04 0 7,0\n",
         Options(delimiter="space", columns={"time": "when", "lost": "gone"})),
        ("RTT [ms];a,b,c,d;t\n5.0;1,2,3,4;0\n;;0.02\n7.0;;0.04\n", Options(delimiter=";")),
    ],
)  # fmt: skip
def test_tables_with_any_separator(tmp_path: Path, text: str, options: Options) -> None:
    found = read(tmp_path / "a", text, options)
    assert (lost(found), found.malformed.count) == ([1], 0)
    assert found.sent.tolist() == pytest.approx([0.0, 0.02, 0.04])
    assert delays(found) == pytest.approx([0.005, NAN, 0.007], nan_ok=True)


@pytest.mark.parametrize("word", ["lost", "DROPPED", "timeout", "1", "yes", "True"])
def test_words_for_a_loss(tmp_path: Path, word: str) -> None:
    found = read(tmp_path / "a", f"time,lost\n0,0\n0.1,{word}\n0.2,ok\n")
    assert (lost(found), found.malformed.count) == ([1], 0)


def test_a_delimiter_is_one_character(tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match=r"--delimiter must be one character, .*got '::'"):
        read(tmp_path / "a", "time::lost\n0::1\n", Options(delimiter="::", columns={"lost": "lost"}))


def test_numbers_of_a_table_are_those_that_python_reads(tmp_path: Path) -> None:
    digits = ["0.0312345678901234567890", "9.012345678901234567e-03"]
    cells = [*digits, "2.5e-03", "-1.25E+2", "1e5", "5", ".5", "-0.0625", "1e-12", "7.e2"]
    rows = "".join(f"{cell},0\n" for cell in cells)
    found = read(tmp_path / "a", "time,lost\n" + rows + "1e5.,0\n1e,0\n.e1,0\n")
    expected = np.sort([float(cell) for cell in cells])
    assert found.sent == pytest.approx(expected - expected[0], rel=1e-15)
    assert found.malformed.count == 3
    assert delays(read(tmp_path / "b", "time,delay\n0,.\n1,2\n2,-\n")) == pytest.approx([NAN, 2.0, NAN], nan_ok=True)


def test_rows_of_a_table_that_are_none_are_named(tmp_path: Path) -> None:
    text = "time;rtt_ms\n0,0;1,5\n0,02;1.234,5\n2024-05-01T12:00:00;1\n0,04\n0,06;2,5\n0,08;x\n"
    found = read(tmp_path / "a", text)
    assert found.packets == 2
    assert found.malformed.shown == ["line 3: '0,02;1.234,5'", "line 4: '2024-05-01T12:00:00;1'", "line 5: '0,04'"]
    assert found.malformed.count == 4
    dates = "time,rtt\n2024-05-01T12:00:00,0.1\n2024-13-01T12:00:00,0.1\n5.0,0.1\n2024-05-01T12:00:01,0.1\n"
    found = read(tmp_path / "b", dates)
    assert (found.packets, found.span, found.malformed.count) == (2, 1.0, 2)


def test_a_table_without_a_row_that_is_understood_says_why(tmp_path: Path) -> None:
    with pytest.raises(
        MeasurementError, match=r"has no row below its header: 1 line was not .* \(line 2: 'May  1, 2024"
    ):
        read(tmp_path / "a", "frame.time_epoch\ticmp.resptime\nMay  1, 2024 12:00:00 CEST\t7.0\n")


def test_numbers_of_a_table_begin_anew_and_may_be_missing(tmp_path: Path) -> None:
    rows = [(n % 65536, 0.01 * n) for n in range(65530, 65545) if n not in (65533, 65537)]
    found = read(tmp_path / "a", "seq,time\n" + "".join(f"{n},{t:.2f}\n" for n, t in rows))
    assert (found.packets, lost(found)) == (15, [3, 7])
    assert found.interval == pytest.approx(0.01)
    far = read(tmp_path / "b", "seq,time\n5,0\n40000,399.95\n")  # an outage, and no new beginning
    assert (far.packets, int(far.whole.lost.sum())) == (39996, 39994)
    flags = read(tmp_path / "c", "seq,lost\n1,0\n2,1\n5,0\n")
    assert flags.packets == 3
    assert "numbers are missing in 1 place" in said(flags)


@pytest.mark.parametrize("columns", ["frame.time_epoch,icmp.seq", "icmp.seq,frame.time_epoch,icmp.type"])
def test_a_table_of_both_directions_under_one_number_says_that_it_hides_losses(tmp_path: Path, columns: str) -> None:
    names, rows = columns.split(","), []
    for k in range(20):
        for kind, late in [(8, 0.0)] if k in (5, 6) else [(8, 0.0), (0, 0.004)]:
            cells = {"frame.time_epoch": f"{0.02 * k + late:.6f}", "icmp.seq": str(k), "icmp.type": str(kind)}
            rows.append(",".join(cells[name] for name in names))
    found = read(tmp_path / "a", "\n".join([columns, *rows]) + "\n")
    assert "18 rows have the number of an earlier one" in said(found)
    once = [row for row in rows if float(row.split(",")[names.index("frame.time_epoch")]) * 50 % 1 > 0.1]
    found = read(tmp_path / "b", "\n".join([columns, *once, once[-1]]) + "\n")
    assert (lost(found), found.duplicates) == ([5, 6], 1)
    assert "rows have the number" not in said(found)


@pytest.mark.parametrize("head", ["seq,sent,received", "seq,time,received", "seq,received"])
def test_a_table_of_what_a_receiver_got_shows_losses_by_its_numbers(tmp_path: Path, head: str) -> None:
    rows = []
    for n in (0, 1, 4, 3, 3, 6):
        times = (100.0 + 0.02 * n, 100.004 + 0.02 * n)[-head.count(",") :]
        rows.append(",".join((str(n), *(f"{time:.7g}" for time in times))))
    found = read(tmp_path / "a", "\n".join((head, *rows, "")))
    assert (found.packets, lost(found), found.duplicates, found.reordered) == (7, [2, 5], 1, 1)
    assert found.interval == pytest.approx(0.02)
    assert found.uplink is not None
    if head == "seq,received":
        assert found.uplink.delay is None
        assert "times are those of arrival" in said(found)
    else:
        assert found.uplink.delay is not None
        assert np.nanmax(np.abs(found.uplink.delay - 0.004)) < 1e-4


def test_a_table_that_names_its_losses_says_nothing_of_numbers_that_are_missing(tmp_path: Path) -> None:
    found = read(tmp_path / "a", "seq,sent,received\n0,1.0,1.1\n1,2.0,\n4,5.0,5.1\n")
    assert (found.packets, lost(found)) == (3, [1])
    assert "numbers are missing in 1 place" in said(found)


def test_a_date_in_smaller_units_is_one_and_that_is_said(tmp_path: Path) -> None:
    for digits in (3, 6, 9):
        rows = "".join(f"{1_700_000_000 * 10**digits + i * 2 * 10 ** (digits - 2)},{i % 2}\n" for i in range(5))
        found = read(tmp_path / "a", "timestamp,lost\n" + rows)
        assert found.interval == pytest.approx(0.02, abs=1e-6)
        assert "it is taken for that" in said(found)
    assert read(tmp_path / "a", "t,lost\n1700000000,0\n1700000001,1\n").notes == (
        "one direction was measured, and is taken for the uplink",
    )


@pytest.mark.parametrize("form", ["ping", "table", "units", "dates", "late"])
def test_stamps_of_today_are_as_exact_as_they_are_written(tmp_path: Path, form: str) -> None:
    """A float of seconds since 1970 is only exact to 0.2 us: packets 2 ms apart, 123.457 us under way."""
    sent = [1_700_000_000_999_123_000 + 2_000_000 * k for k in range(50)]  # ns
    arrived = [at + 123_457 for at in sent]
    gone = {10, 11, 30}

    def seconds(at: int) -> str:
        return f"{at // 10**9}.{at % 10**9:09d}"

    def date(at: int) -> str:
        whole = at // 10**9 - 1_700_000_000  # since 22:13:20
        return f"2023-11-14T22:{13 + (20 + whole) // 60:02d}:{(20 + whole) % 60:02d}.{at % 10**9:09d}Z"

    every = [(k, a, b) for k, (a, b) in enumerate(zip(sent, arrived, strict=True))]
    rows = [row for row in every if row[0] not in gone]
    text = {
        "ping": "PING 10.0.0.2 (10.0.0.2) 56(84) bytes of data.\n" + "".join(
            f"[{seconds(b)}] 64 bytes from 10.0.0.2: icmp_seq={k + 1} ttl=64 time=0.123457 ms\n" for k, a, b in rows
        ),
        "table": "seq,sent,received\n" + "".join(f"{k},{seconds(a)},{seconds(b)}\n" for k, a, b in rows),
        "units": "seq,sent_ns,received_ms\n" + "".join(f"{k},{a},{b // 10**6}.{b % 10**6:06d}\n" for k, a, b in rows),
        "dates": "received;seq;sent\n" + "".join(f"{date(b)};{k};{date(a)}\n" for k, a, b in rows),
        "late": "sent,received\n" + "".join(
            f"{seconds(a)},{'' if k in gone else seconds(b)}\n" for k, a, b in every
        ),
    }[form]  # fmt: skip
    found = read(tmp_path / "log", text)
    assert lost(found) == sorted(gone)
    assert found.sent == pytest.approx([0.002 * k for k in range(50)], abs=1e-12)
    expected = [NAN if k in gone else 123.457e-6 for k in range(50)]
    assert delays(found) == pytest.approx(expected, abs=1e-12, nan_ok=True)


def test_times_of_arrival_in_whole_seconds_are_no_yes_and_no(tmp_path: Path) -> None:
    text = "seq,received\n" + "".join(f"{k},{1_700_000_000 + k // 5}\n" for k in range(10) if k != 3)
    found = read(tmp_path / "log", text)
    assert (found.packets, lost(found)) == (10, [3])
    flags = "time,received\n" + "".join(f"{1_700_000_000 + k}.25,{int(k != 3)}\n" for k in range(10))
    assert lost(read(tmp_path / "flags", flags)) == [3]
    swapped = "received,time\n" + "".join(f"{int(k != 3)},{1_700_000_000 + k}.25\n" for k in range(10))
    assert lost(read(tmp_path / "swapped", swapped)) == [3]


def test_stamps_that_are_coarser_than_packets_are_apart(tmp_path: Path) -> None:
    found = read(
        tmp_path / "a", "time,lost\n" + "".join(f"{1000 + i // 10},{int(i in (34, 35))}\n" for i in range(100))
    )
    assert found.sent == pytest.approx(0.1 * np.arange(100))
    assert "90 of 100 packets have the time of the one before" in said(found)


def test_times_that_are_none_are_said_to_be(tmp_path: Path) -> None:
    found = read(tmp_path / "a", "time,rtt_ms\n0,5\n0.02,-1\n0.04,inf\ninf,5\n0.06,7\n")
    assert (found.packets, lost(found), found.malformed.shown) == (4, [1, 2], ["line 5: 'inf,5'"])
    assert "2 round trips below 0, or infinite times, count as none" in said(found)
    delay = read(tmp_path / "b", "time,delay\n0,-0.001\n1,0.004\n")  # clocks may differ
    assert (lost(delay), delays(delay)) == ([], [-0.001, 0.004])
    same = read(tmp_path / "c", "time,lost\n" + "7,0\n" * 5, Options(interval=0.02))
    assert same.interval == pytest.approx(0.02)
    assert "all rows have the same time: 0.02 s between packets as --interval says" in said(same)


def test_separators_between_quotation_marks_separate_nothing(tmp_path: Path) -> None:
    text = 'time,"note, if any",lost\n0,"a, b",0\n0.02,"say ""x, y""",1\n0.04,,0\n0.06,"a,0\n'
    found = read(tmp_path / "a", text)
    assert (found.packets, lost(found), found.malformed.count) == (3, [1], 1)


# -- mahimahi, iperf3, what is none ------------------------------------------------------------------------------------


def test_mahimahi_with_several_opportunities_a_millisecond(tmp_path: Path) -> None:
    found = read(tmp_path / "a", "0\n0\n5\n5\n5\n30\n", Options(interval=0.01))
    assert found.format == "mahimahi"
    assert delays(found) == pytest.approx([0.0, 0.02, 0.01])


@pytest.mark.parametrize(
    "text", ["PING\n", "1,2,3\n4,5,6\n", '{"round_trips": 3}', "a;b\n1;2\n", "0\n", "\x00\x01\x02"]
)
def test_what_is_none_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "a").write_text(text)
    with pytest.raises(MeasurementError):
        read_link(tmp_path / "a")


def test_formats_are_told_apart(tmp_path: Path) -> None:
    for text, name in (
        ("16 bytes from ::1, icmp_seq=0 hlim=64 time=0.059 ms\n", "ping"), ("date;rtt_ms\n", "table"),
        ('{\n  "round_trips": [\n', "irtt"), ("0\n5\n9\n", "mahimahi"), ("loss random 5%\n", "netem"),
    ):  # fmt: skip
        (tmp_path / "a").write_text(text)
        assert format_of(tmp_path / "a").name == name


@pytest.mark.parametrize(
    ("line", "bytes_each"),
    [
        ("[{0:.3f}] 64 bytes from 10.0.0.2: icmp_seq={1} ttl=64 time=5.25 ms\n", 17.0),
        ("{1} 5.25 2.5 2.75 0.01 0 0\n", 34.0),
        ("{0:.3f},0,0.005\n", 17.0),
    ],
)
def test_of_a_packet_its_figures_are_kept_and_nothing_else(tmp_path: Path, line: str, bytes_each: float) -> None:
    """When it was sent, each delay, and a byte for each outcome; columns have an eighth more room at most."""
    path, count = tmp_path / "a", 60_000
    lines = (line.format(0.02 * i, i) for i in range(count) if i % 50)
    path.write_text(("time,lost,delay\n" if line.startswith("{0") else "") + "".join(lines))
    read_link(path)  # what is imported and kept once
    tracemalloc.start()
    found = read_link(path)
    kept = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert isinstance(found, Measurement)
    assert kept / count < 1.25 * bytes_each
