"""`bag info`: what is in a bag, from bags whose times were made up."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from mcap.writer import Writer

from agv_analysis.bags import read_bag
from agv_analysis.bags.bag_summary import describe
from agv_analysis.cli import main

STAMPED = b"builtin_interfaces/Time stamp\nuint8 value"


def write(path: Path, times: dict[str, list[tuple[int, int]]]) -> Path:
    """A bag of stamped messages: (log time, stamp) [ns] by topic."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("my_msgs/msg/Stamped", "ros2msg", STAMPED)
        for topic, pairs in times.items():
            channel = writer.register_channel(topic, "cdr", schema)
            for log_time, stamp in pairs:
                body = b"\0\1\0\0" + struct.pack("<iIB", stamp // 10**9, stamp % 10**9, 7)
                writer.add_message(channel, log_time, body, log_time)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def test_rate_period_jitter_and_gaps(tmp_path: Path) -> None:
    """100 Hz with +- 1 ms, from which 3 messages in a row and then one are missing."""
    draw = np.random.default_rng(1).choice([-(10**6), 10**6], 1000)
    times = [10**9 + 10**7 * k + int(draw[k]) for k in range(1000) if k not in (500, 501, 502, 700)]
    (topic,) = describe(read_bag(write(tmp_path / "a.mcap", {"/a": [(t, t) for t in times]}))).topics
    steps = np.diff(times) / 1e9
    assert (topic.messages, topic.gaps) == (996, 2)
    assert topic.rate == pytest.approx(995 / (steps.sum()))
    assert topic.period == pytest.approx(0.01, abs=0.002)
    assert topic.period_jitter == pytest.approx(np.std(steps[steps < 0.015]), rel=1e-9)
    assert topic.longest_gap == pytest.approx(steps.max())
    assert topic.longest_gap_at == pytest.approx(times[499] / 1e9)


def test_the_clock_of_the_stamps(tmp_path: Path) -> None:
    """Log times by a clock that is 3 s ahead and 50 ppm faster, messages under way for 0 to 2 ms."""
    stamps = [5 * 10**9 + 10**7 * k for k in range(2000)]
    delays = np.random.default_rng(2).uniform(0.0, 2e6, 2000)
    delays[::40] = 0.0
    pairs = [(int(t + 3 * 10**9 + 50e-6 * (t - stamps[0]) + delay), t) for t, delay in zip(stamps, delays, strict=True)]
    clock = describe(read_bag(write(tmp_path / "a.mcap", {"/a": pairs}))).topics[0].clock
    assert clock is not None
    assert clock.stamped == 2000
    assert clock.offset == pytest.approx(3.0 + 1.5e-3, abs=2e-4)
    assert clock.drift == pytest.approx(50e-6, abs=1e-8)
    assert clock.spread == pytest.approx(0.9 * 2e-3, rel=0.05)


def test_a_topic_of_which_no_message_can_be_read_has_no_times(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        text = b"float64[9] values"
        channel = writer.register_channel("/a", "cdr", writer.register_schema("my_msgs/msg/A", "ros2msg", text))
        writer.add_message(channel, 5, b"\0\1\0\0" + bytes(9), 5)
        writer.finish()  # type: ignore[no-untyped-call]
    (topic,) = describe(read_bag(path)).topics
    assert (topic.messages, topic.first, topic.not_finite) == (1, None, {})


def test_messages_without_a_stamp_have_no_clock(tmp_path: Path) -> None:
    pairs = [(10**9 + k, 0) for k in range(50)]
    assert describe(read_bag(write(tmp_path / "a.mcap", {"/a": pairs}))).topics[0].clock is None


def test_times_without_any_message(tmp_path: Path) -> None:
    times = [k * 10**8 for k in range(100)]
    path = write(tmp_path / "a.mcap", {"/a": [(t, t) for t in times], "/b": [(t + 70 * 10**9, t) for t in times]})
    found = describe(read_bag(path)).silences
    assert len(found) == 1
    assert tuple(found[0]) == pytest.approx((9.9, 60.1))
    result = CliRunner().invoke(main, ["bag", "info", str(path)])
    assert "no message at all for 60.100 s from 1970-01-01 00:00:09.900+00:00 on" in result.stdout


def test_counts_and_rates_never_touch(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", {"/a": [(k, k) for k in range(300)], "/b": [(5, 5)]})
    lines = CliRunner().invoke(main, ["bag", "info", str(path)]).stdout.splitlines()
    row = next(line for line in lines if line.startswith("  /a")).split()
    assert row[:4] == ["/a", "my_msgs/msg/Stamped", "300", "1000000000.00"]
    assert next(line for line in lines if line.startswith("  /b")).split() == ["/b", "my_msgs/msg/Stamped", "1"]


def test_attachments_services_and_missing_definitions(
    odd_bag: Callable[[str], Path], make_database: Callable[..., Path], tmp_path: Path
) -> None:
    out = tmp_path / "info.json"
    result = CliRunner().invoke(main, ["bag", "info", str(odd_bag("mcap, empty definitions")), "--json", str(out)])
    assert "attachment map.png (image/png): 54 bytes, of 1970-01-01 00:00:00.000+00:00" in result.stdout
    assert "definition missing: my_msgs/msg/Reading, of /reading" in result.stdout
    found = json.loads(out.read_text())
    attachment = {"name": "map.png", "media_type": "image/png", "size": 54, "log_time_ns": 2, "create_time_ns": 1}
    assert found["attachments"] == [attachment]
    assert {topic["name"]: topic["definition"] for topic in found["topics"]} == {
        "/point": "ROS 2 dashing to lyrical", "/reading": "",
    }  # fmt: skip
    undecoded = next(topic for topic in found["topics"] if topic["name"] == "/reading")
    assert undecoded["rate"] == pytest.approx(1e6)

    event = [("/add/_service_event", "my_srvs/srv/Add_Event", k, b"\0\1\0\0" + bytes(60)) for k in range(3)]
    result = CliRunner().invoke(main, ["bag", "info", str(make_database(tmp_path / "b.db3", part=event))])
    assert "service /add (my_srvs/srv/Add): 3 events" in result.stdout
    assert "definition missing: my_srvs/srv/Add_Event, of /add/_service_event" in result.stdout
    assert "recorded by ROS 2 humble" in result.stdout


def test_a_type_that_a_database_does_not_define_is_not_taken_for_one_without_members(
    make_database: Callable[..., Path], tmp_path: Path
) -> None:
    """Its first message is all zeros, as that of a type without members is."""
    counted = [("/mine", "my_msgs/msg/Count", k, b"\0\1\0\0" + k.to_bytes(4, "little")) for k in range(5)]
    result = CliRunner().invoke(main, ["bag", "info", str(make_database(tmp_path / "c.db3", part=counted))])
    assert "definition missing: my_msgs/msg/Count, of /mine" in result.stdout
