"""Recordings of the loop with values and times in them that cannot be: said, counted as missing, never in a result."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from agv_analysis.recordings.recording import read_run
from agv_analysis.run import Run
from agv_analysis.stability.analysis import analyse
from agv_ros.errors import UserError

SAMPLE = Path(__file__).parents[3] / "bags/sample"
STEPS = 400

Change = Callable[[int, str, bytes], list[bytes]]
"""What becomes of a message of step k, with its topic and its bytes."""


def written(path: Path, change: Change) -> Path:
    """The first steps of the sample, changed; times and all else as they are."""
    with next(SAMPLE.glob("*.mcap")).open("rb") as source, path.open("xb") as target:
        reader, writer = make_reader(source), Writer(target, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile="ros2", library="test")
        channels: dict[int, int] = {}
        for schema, channel, sent in reader.iter_messages(log_time_order=False):
            k = (sent.log_time - 1_000_000_000) // 5_000_000
            if schema is None or k >= STEPS:
                continue
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, channel.metadata
                )
            for data in change(k, channel.topic, sent.data):
                writer.add_message(channels[channel.id], sent.log_time, data, sent.publish_time)
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def with_number(topic: str, place: int, value: float) -> Change:
    """A double of each 50th message of a topic replaced."""

    def change(k: int, name: str, data: bytes) -> list[bytes]:
        is_hit = name == topic and k % 50 == 25
        return [data[:place] + struct.pack("<d", value) + data[place + 8 :] if is_hit else data]

    return change


def with_stamp(topic: str, sec: int, nanosec: int) -> Change:
    """The stamp of each 50th message of a topic replaced."""
    stamp = struct.pack("<iI", sec, nanosec)
    return lambda k, name, data: [data[:4] + stamp + data[12:] if name == topic and k % 50 == 25 else data]


def _with_frame(data: bytes, length: int) -> bytes:
    """A PoseStamped in frame `map` with a frame of another length."""
    return data[:12] + struct.pack("<I", length) + b"a" * (length - 1) + b"\0" + data[20:]


class Damage(NamedTuple):
    """What was done, and how it is said; `missing`: messages of the topic that then count as missing."""

    change: Change
    note: str
    topic: str = "agv/pose"
    missing: int = STEPS // 50


X, W = 20, 68
"""Where x, and w of the quaternion, are in a PoseStamped of frame `map`."""

NO_NUMBER = "with numbers that no node takes, they are left out"
OFF_GRID = "/agv/pose: 8 messages are not at a sampling instant: left out"
COMMAND_V, ERROR_X = 28, 44
"""Where v is in a TwistStamped of frame `base_link`, and x_e in an Odometry of `base_link` and `reference`."""

DAMAGES = {
    "x is NaN": Damage(with_number("/agv/pose", X, math.nan), f"/agv/pose: 8 messages {NO_NUMBER}"),
    "x is infinite": Damage(with_number("/agv/pose", X, -math.inf), f"/agv/pose: 8 messages {NO_NUMBER}"),
    "w is NaN": Damage(with_number("/agv/pose", W, math.nan), f"/agv/pose: 8 messages {NO_NUMBER}"),
    "w is huge": Damage(with_number("/agv/pose", W, 1e300), f"/agv/pose: 8 messages {NO_NUMBER}"),
    "a command is NaN": Damage(
        with_number("/edge/cmd_vel", COMMAND_V, math.nan), f"/edge/cmd_vel: 8 messages {NO_NUMBER}", "edge/cmd_vel"
    ),
    "an error is NaN": Damage(
        with_number("/edge/error", ERROR_X, math.nan), f"/edge/error: 8 messages {NO_NUMBER}", "edge/error"
    ),
    "before all time": Damage(with_stamp("/agv/pose", -5, 0), OFF_GRID),
    "nanoseconds of seconds": Damage(
        with_stamp("/agv/pose", 0, 4_000_000_001), "/agv/pose: header.stamp.nanosec of a second or more: 8"
    ),
    "the end of time": Damage(with_stamp("/agv/pose", 2**31 - 1, 1), OFF_GRID),
    "twice": Damage(
        lambda k, topic, data: [data] * (1 + (topic == "/agv/pose" and k % 50 == 25)),
        "/agv/pose: 8 messages repeat a step, the first of each counts", missing=0,
    ),
    "two million steps ahead": Damage(
        with_stamp("/agv/pose", 10_001, 0), "/agv/pose: 8 messages have stamps far from all others, they are left out"
    ),
    "a name of a megabyte": Damage(
        lambda k, topic, data: [_with_frame(data, 10**6 + 4) if topic == "/agv/pose" and k == 100 else data],
        "/agv/pose: message of more than 76 bytes, far longer than the others, left out: 1", missing=1,
    ),
    "cut": Damage(
        lambda k, topic, data: [data[:-9] if topic == "/agv/pose" and k % 50 == 25 else data],
        "/agv/pose: message that is not of its type, left out",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Run:
    run = read_run(written(tmp_path_factory.mktemp("whole") / "whole.mcap", lambda k, topic, data: [data]))
    assert (run.notes, dict(run.unexplained), len(run)) == ((), {}, STEPS)
    return run


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_what_cannot_be_is_said_and_in_no_result(tmp_path: Path, whole: Run, damage: Damage) -> None:
    run = read_run(written(tmp_path / "damaged.mcap", damage.change))
    assert any(damage.note in note for note in run.notes), run.notes
    assert run.unexplained.get(damage.topic, 0) == damage.missing
    same = np.isin(whole.k, run.k)
    assert np.count_nonzero(~same) == (damage.missing if damage.topic == "agv/pose" else 0)
    assert np.array_equal(run.pose, whole.pose[same])
    for found, expected in ((run.command, whole.command[same]), (run.error, whole.error[same])):
        there = np.isfinite(found).all(axis=1)
        assert np.count_nonzero(~there) == (damage.missing if found.shape == damage_shape(damage) else 0)
        assert np.array_equal(found[there], expected[there])
    plain = analyse(run).to_json()
    assert plain["unexplained"] == dict(run.unexplained)


def damage_shape(damage: Damage) -> tuple[int, int]:
    """Shape of the run's array that loses messages, if it is not the poses."""
    return {"edge/cmd_vel": (STEPS, 2), "edge/error": (STEPS, 3)}.get(damage.topic, (0, 0))


@pytest.mark.parametrize("far", [1e9, 1e160, 1e308])
def test_a_pose_beyond_all_reason_is_judged_all_the_same(tmp_path: Path, far: float) -> None:
    """As of a loop that diverges: its numbers leave the range of a double, the analysis does not break."""
    run = read_run(written(tmp_path / "far.mcap", with_number("/agv/pose", X, far)))
    assert len(run) == STEPS
    assert any("do not fit the track" in note for note in run.notes)
    analyse(run).to_json()


def test_messages_in_any_order_are_the_same_run(tmp_path: Path, whole: Run) -> None:
    """Each pair of messages of a topic changed places: steps come from stamps."""
    held: dict[str, bytes] = {}

    def change(k: int, topic: str, data: bytes) -> list[bytes]:
        if topic not in ("/agv/pose", "/edge/slot", "/edge/cmd_vel"):
            return [data]
        earlier = held.pop(topic, None)
        if earlier is None:
            held[topic] = data
            return []
        return [data, earlier]

    run = read_run(written(tmp_path / "mixed.mcap", change))
    assert len(run) == STEPS
    for name in ("k", "pose", "command", "n_ul", "lost"):
        assert np.array_equal(getattr(run, name), getattr(whole, name)), name


def test_a_topic_of_another_type_under_a_name_of_ours(tmp_path: Path, whole: Run) -> None:
    def retyped(path: Path, topic: str) -> Path:
        """The sample with the messages of a topic as another type that has a header, too."""
        with next(SAMPLE.glob("*.mcap")).open("rb") as source, path.open("xb") as target:
            writer, channels = Writer(target), {}
            writer.start(profile="ros2")
            for schema, channel, sent in make_reader(source).iter_messages(log_time_order=False):
                if schema is None or sent.log_time > 2 * 10**9:
                    continue
                if channel.id not in channels:
                    is_other = channel.topic == topic
                    about = ("my_msgs/msg/Text", b"string text") if is_other else (schema.name, schema.data)
                    number = writer.register_schema(about[0], schema.encoding, about[1])
                    channels[channel.id] = writer.register_channel(channel.topic, "cdr", number)
                data = b"\0\1\0\0\5\0\0\0text\0" if channel.topic == topic else sent.data
                writer.add_message(channels[channel.id], sent.log_time, data, sent.publish_time)
            writer.finish()  # type: ignore[no-untyped-call]
        return path

    config = Path(__file__).parents[3] / "config/outages.yaml"
    with pytest.raises(UserError, match=r"/agv/pose has the type my_msgs/msg/Text, not geometry_msgs/msg/PoseStamped"):
        read_run(retyped(tmp_path / "pose.mcap", "/agv/pose"), config)
    for topic in ("/agv/slot", "/diagnostics"):
        run = read_run(retyped(tmp_path / f"{topic[1:3]}.mcap", topic), config)
        assert len(run) == 201
        assert any("/agv/slot has the type my_msgs/msg/Text" in note for note in run.notes) == (topic == "/agv/slot")


def test_a_definition_that_was_damaged_in_the_summary_is_taken_from_the_chunk(tmp_path: Path) -> None:
    """A bit that makes of y another x: the CRC of the data section does not cover the summary."""
    source = next(SAMPLE.glob("*.mcap"))
    content = bytearray(source.read_bytes())
    content[content.rindex(b"float64 x\nfloat64 y") + len(b"float64 x\nfloat64 ")] ^= 1
    (tmp_path / "flipped.mcap").write_bytes(content)
    run, whole = read_run(tmp_path / "flipped.mcap"), read_run(source)
    np.testing.assert_array_equal(run.command, whole.command)
    assert any("defined in two ways, the one that a CRC covers is used" in note for note in run.notes)
