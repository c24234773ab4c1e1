"""Damaged bags: whatever is cut off or flipped, what is whole comes back, what is lost is said, nothing is made up."""

from __future__ import annotations

import io
import random
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from agv_analysis.bags import Bag, BagError, read_bag
from agv_analysis.bags.recover import recover

STORE = get_typestore(Stores.ROS2_JAZZY)
STEPS = 60


class Truth(NamedTuple):
    """A bag that was written by the mcap library, and what was written."""

    data: bytes
    rows: dict[int, tuple[Any, ...]]
    """Topic and values of each message by its log time, which is unique."""
    problems: tuple[str, ...]
    """What is said of the bag when it is whole."""


def _messages() -> list[tuple[int, str, Any]]:
    """(log time, topic, message) of a small loop."""
    random_numbers = np.random.default_rng(3)
    stamp, header = STORE.types["builtin_interfaces/msg/Time"], STORE.types["std_msgs/msg/Header"]
    pose, reference = STORE.types["geometry_msgs/msg/PoseStamped"], STORE.types["sensor_msgs/msg/TimeReference"]
    point, quaternion = STORE.types["geometry_msgs/msg/Point"], STORE.types["geometry_msgs/msg/Quaternion"]
    inner = STORE.types["geometry_msgs/msg/Pose"]
    found: list[tuple[int, str, Any]] = []
    for k in range(STEPS):
        ns = 10**9 + 5_000_000 * k
        time = stamp(1, 5_000_000 * k)
        x, y, angle = random_numbers.normal(size=3)
        at = inner(point(x, y, 0.0), quaternion(0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)))
        found.append((ns + 1, "/clock", STORE.types["rosgraph_msgs/msg/Clock"](time)))
        found.append((ns + 2, "/agv/pose", pose(header(time, "map"), at)))
        found.append((ns + 3, "/edge/slot", reference(header(time, ""), time, "lost" if k % 7 == 1 else "delivered")))
    return found


def write(**options: Any) -> bytes:
    file = io.BytesIO()
    writer = Writer(file, chunk_size=1500, **options)
    writer.start(profile="ros2", library="test")
    channels: dict[str, int] = {}
    for ns, topic, message in _messages():
        if topic not in channels:
            text = STORE.generate_msgdef(message.__msgtype__, ros_version=2)[0]
            schema = writer.register_schema(message.__msgtype__, "ros2msg", text.encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        payload = STORE.serialize_cdr(message, message.__msgtype__)
        writer.add_message(channels[topic], ns, bytes(payload), ns - 1)
    writer.add_metadata("agv_ncs", {"version": "1", "seed": "7", "params": "x: 1"})
    writer.finish()  # type: ignore[no-untyped-call]
    return file.getvalue()


def rows_of(bag: Bag) -> dict[int, tuple[Any, ...]]:
    """Topic and values of each row by log time."""
    found: dict[int, tuple[Any, ...]] = {}
    for topic, rows in bag.arrays.items():
        for row in rows.tolist():
            assert row[0] not in found, "a message is there twice"
            found[row[0]] = (topic, *row)
    return found


def expected_rows() -> dict[int, tuple[Any, ...]]:
    """What `rows_of` should give, from the messages that were written."""
    found: dict[int, tuple[Any, ...]] = {}
    for ns, topic, m in _messages():
        if topic == "/clock":
            values: tuple[Any, ...] = (m.clock.sec, m.clock.nanosec)
        elif topic == "/agv/pose":
            p, q = m.pose.position, m.pose.orientation
            values = (m.header.stamp.sec, m.header.stamp.nanosec, b"map", p.x, p.y, p.z, q.x, q.y, q.z, q.w)
        else:
            stamp, time = m.header.stamp, m.time_ref
            values = (stamp.sec, stamp.nanosec, b"", time.sec, time.nanosec, m.source.encode())
        found[ns] = (topic, ns, ns - 1, *values)
    return found


OPTIONS: dict[str, dict[str, Any]] = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "none": {"compression": CompressionType.NONE},
    "zstd without CRC": {"compression": CompressionType.ZSTD, "enable_crcs": False},
    "none without CRC": {"compression": CompressionType.NONE, "enable_crcs": False},
    "unchunked": {"use_chunking": False},
    "unchunked with CRC": {"use_chunking": False, "enable_data_crcs": True},
}
PROVEN = ("zstd", "lz4", "none")


def places_of(kind: str) -> int:
    """At how many random places a bag of this kind is damaged: the one that is recorded here is tried the hardest."""
    return 1000 if kind == "zstd" else 150


@pytest.fixture(scope="module", params=OPTIONS)
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def truth(kind: str, tmp_path_factory: pytest.TempPathFactory) -> Truth:
    path = tmp_path_factory.mktemp("truth") / "whole.mcap"
    path.write_bytes(write(**OPTIONS[kind]))
    bag = read_bag(path)
    assert bag.is_complete
    assert rows_of(bag) == expected_rows()
    return Truth(path.read_bytes(), expected_rows(), bag.problems)


@pytest.fixture
def read(tmp_path: Path) -> Callable[[bytes], Bag]:
    """Read a bag with this content."""
    path = tmp_path / "damaged.mcap"

    def read_content(data: bytes) -> Bag:
        path.write_bytes(data)
        return read_bag(path)

    return read_content


# -- an MCAP reader of the simplest kind, to know the truth -----------------------------------------------------------


def records(data: bytes, position: int = 8) -> list[tuple[int, int, bytes]]:
    """(position, opcode, content) of the records that are whole."""
    found = []
    while position + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, position)
        if position + 9 + length > len(data):
            break
        found.append((position, opcode, data[position + 9 : position + 9 + length]))
        position += 9 + length
    return found


def log_times(content: bytes) -> set[int]:
    """Log times of the whole messages among the records of a chunk."""
    return {struct.unpack_from("<Q", record, 6)[0] for _, opcode, record in records(content, 0) if opcode == 5}


def log_times_before(data: bytes, cut: int) -> set[int]:
    """Log times of the messages that are whole in the first `cut` bytes."""
    found: set[int] = set()
    for position, opcode, record in records(data):
        if opcode == 5 and position + 9 + len(record) <= cut:
            found.add(struct.unpack_from("<Q", record, 6)[0])
        elif opcode == 6:
            found |= log_times(_start(record, max(0, cut - position - 9)))
    return found


def _start(chunk_record: bytes, count: int | None = None) -> bytes:
    """As much of the content of a chunk as can be inflated if the file has `count` bytes of its record."""
    (size,), (name_length,) = struct.unpack_from("<Q", chunk_record, 16), struct.unpack_from("<I", chunk_record, 28)
    part = chunk_record[32 + name_length + 8 : count]
    if chunk_record[32:36] == b"zstd":
        return zstandard.ZstdDecompressor().decompressobj().decompress(part) if part else b""
    if chunk_record[32:35] == b"lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(part, size)) if part else b""
    return part


# -- cut --------------------------------------------------------------------------------------------------------------


def test_a_cut_anywhere_leaves_exactly_the_whole_messages(
    truth: Truth, kind: str, read: Callable[[bytes], Bag]
) -> None:
    borders = [position for position, _, _ in records(truth.data)]
    draw = random.Random(2)
    places = {*borders, *(draw.randrange(8, len(truth.data)) for _ in range(places_of(kind)))}
    for cut in sorted(places):
        bag = read(truth.data[:cut])
        expected = log_times_before(truth.data, cut)
        assert rows_of(bag) == {ns: truth.rows[ns] for ns in expected}, f"{kind}, cut at {cut}"
        assert not bag.is_complete
        assert "file was cut" in " ".join(bag.problems)


@pytest.mark.parametrize("cut", range(8))
def test_a_file_without_even_its_magic_is_refused(read: Callable[[bytes], Bag], cut: int) -> None:
    with pytest.raises(BagError, match=r"damaged.mcap: is (empty|no MCAP file)"):
        read(write()[:cut])


def test_eight_bytes_short_loses_nothing(read: Callable[[bytes], Bag]) -> None:
    bag = read(write()[:-8])
    assert rows_of(bag) == expected_rows()


# -- flipped ----------------------------------------------------------------------------------------------------------


def _chunk_sizes(data: bytes) -> list[int]:
    """Number of messages in each chunk."""
    return [len(log_times(_start(record))) for _, opcode, record in records(data) if opcode == 6]


def _flips(truth: Truth, kind: str) -> Iterator[tuple[int, bytes]]:
    """The bag with one bit flipped, drawn at random, many times."""
    draw = random.Random(1)
    for bit in (draw.randrange(8 * len(truth.data)) for _ in range(places_of(kind))):
        data = bytearray(truth.data)
        data[bit // 8] ^= 1 << bit % 8
        yield bit, bytes(data)


def test_a_flipped_bit_is_never_a_wrong_number_in_silence(
    truth: Truth, kind: str, read: Callable[[bytes], Bag]
) -> None:
    chunks = _chunk_sizes(truth.data)
    for bit, data in _flips(truth, kind):
        bag = read(data)
        where = f"{kind}, bit {bit}: {bag.problems}"
        if kind in PROVEN:
            found = rows_of(bag)
            assert found.items() <= truth.rows.items(), where
            assert len(truth.rows) - len(found) in (0, *chunks), where
            assert len(found) == len(truth.rows) or not bag.is_complete, where
        elif kind == "unchunked with CRC":
            assert bag.problems != truth.problems, where
        else:
            assert "which no CRC covers" in where or "not checked" in where


@pytest.mark.parametrize("name", PROVEN)
def test_every_bit_of_a_chunk_record_head(name: str, read: Callable[[bytes], Bag]) -> None:
    data = write(**OPTIONS[name])
    position, record = next((position, record) for position, opcode, record in records(data) if opcode == 6)
    (name_length,) = struct.unpack_from("<I", record, 28)
    crc = range(position + 9 + 24, position + 9 + 28)
    for byte in range(position, position + 9 + 40 + name_length):
        for bit in range(8):
            damaged = bytearray(data)
            damaged[byte] ^= 1 << bit
            found = rows_of(read(bytes(damaged)))
            if byte in crc:
                assert len(found) == len(expected_rows()) - _chunk_sizes(data)[0]
            else:
                assert found == expected_rows(), f"byte {byte - position} of the chunk, bit {bit}"


# -- built by hand ----------------------------------------------------------------------------------------------------


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def text(content: str) -> bytes:
    return struct.pack("<I", len(content.encode())) + content.encode()


MAGIC = b"\x89MCAP0\r\n"
HEAD = MAGIC + record(1, text("ros2") + text("by hand"))
STRING = record(3, struct.pack("<H", 1) + text("std_msgs/msg/String") + text("ros2msg") + text("string data"))
CHANNEL = record(4, struct.pack("<HH", 1, 1) + text("/text") + text("cdr") + struct.pack("<I", 0))
END = record(15, bytes(4)) + record(2, bytes(20)) + MAGIC


def message(ns: int, content: str = "x", channel: int = 1) -> bytes:
    body = b"\0\1\0\0" + struct.pack("<I", len(content) + 1) + content.encode() + b"\0"
    return record(5, struct.pack("<HIQQ", channel, 0, ns, ns) + body)


def chunk(content: bytes, size: int | None = None, crc: int = 0, compression: str = "") -> bytes:
    packed = content if not compression else zstandard.ZstdCompressor().compress(content)
    head = struct.pack("<QQQI", 0, 0, len(content) if size is None else size, crc)
    return record(6, head + text(compression) + struct.pack("<Q", len(packed)) + packed)


def test_a_file_by_hand_is_read(read: Callable[[bytes], Bag]) -> None:
    bag = read(HEAD + STRING + CHANNEL + message(1, "one") + chunk(message(2, "two")) + message(3, "three") + END)
    assert bag["/text"]["data"].tolist() == [b"one", b"two", b"three"]
    assert bag.topics["/text"].count == 3
    assert bag.is_complete


def test_a_decompression_bomb_is_left_alone(read: Callable[[bytes], Bag]) -> None:
    bomb = zstandard.ZstdCompressor().compress(bytes(2**28))
    for declared in (10, 2**20, 2**40, 2**64 - 1):
        packed = struct.pack("<QQQI", 0, 0, declared, 0) + text("zstd") + struct.pack("<Q", len(bomb)) + bomb
        bag = read(HEAD + STRING + CHANNEL + message(1) + record(6, packed) + message(2) + END)
        assert bag["/text"]["log_time_ns"].tolist() == [1, 2]
        assert "damaged chunk, left out" in " ".join(bag.problems)
        assert not bag.is_complete


@pytest.mark.parametrize("length", [2**63, 2**64 - 1, 2**40, 10**6])
@pytest.mark.parametrize("opcode", range(1, 16))
def test_a_hostile_length_is_passed_over(read: Callable[[bytes], Bag], opcode: int, length: int) -> None:
    hostile = struct.pack("<BQ", opcode, length) + bytes(50)
    bag = read(HEAD + STRING + CHANNEL + message(1) + message(2) + hostile + message(3) + message(4) + message(5) + END)
    assert bag["/text"]["log_time_ns"].tolist() == [1, 2, 3, 4, 5]
    assert not bag.is_complete


def test_hostile_lengths_inside_records(read: Callable[[bytes], Bag]) -> None:
    huge = struct.pack("<I", 2**32 - 1)
    for hostile in (
        record(3, struct.pack("<H", 2) + huge),
        record(4, struct.pack("<HH", 2, 1) + text("/other") + huge),
        record(12, text("name") + huge),
        record(6, bytes(28) + text("") + struct.pack("<Q", 2**62)),
        record(7, struct.pack("<H", 1) + huge),
        record(9, bytes(16) + huge),
    ):
        bag = read(HEAD + STRING + CHANNEL + message(1) + hostile + message(2) + message(3) + END)
        assert bag["/text"]["log_time_ns"].tolist() == [1, 2, 3]
        assert not bag.is_complete


def test_a_message_index_is_not_believed(read: Callable[[bytes], Bag]) -> None:
    content = message(1) + message(2) + message(3)
    size = len(message(1))
    for places in ([0, 2 * size], [0, size, 2 * size, 0], [0, size, 7], [0, size, 2**63], [], [2 * size, size, 0]):
        entries = b"".join(struct.pack("<QQ", 0, place) for place in places)
        index = record(7, struct.pack("<HI", 1, len(entries)) + entries)
        bag = read(HEAD + STRING + CHANNEL + chunk(content) + index + END)
        assert bag["/text"]["log_time_ns"].tolist() == [1, 2, 3]


def test_a_damaged_message_in_an_unchecked_chunk_costs_itself_alone(read: Callable[[bytes], Bag]) -> None:
    content = b"".join(message(ns) for ns in range(1, 10))
    size = len(message(1))
    for bit in range(64):
        damaged = bytearray(content)
        damaged[3 * size + 1 + bit // 8] ^= 1 << bit % 8
        found = read(HEAD + STRING + CHANNEL + chunk(bytes(damaged)) + END)["/text"]["log_time_ns"].tolist()
        assert [ns for ns in found if ns != 4] == [1, 2, 3, 5, 6, 7, 8, 9], f"bit {bit} of a length"


def test_a_schema_that_lies(read: Callable[[bytes], Bag]) -> None:
    lie = record(3, struct.pack("<H", 1) + text("std_msgs/msg/String") + text("ros2msg") + text("float64[12] data"))
    bag = read(HEAD + lie + CHANNEL + b"".join(message(ns) for ns in range(200)) + END)
    with pytest.raises(BagError, match=r"/text: cannot be decoded: its messages are not of its type"):
        bag["/text"]
    assert len(bag.payloads("/text")) == 200
    few = read(HEAD + lie + CHANNEL + message(1) + END)
    assert len(few["/text"]) == 0
    assert not few.is_complete


def test_messages_without_a_channel_are_counted(read: Callable[[bytes], Bag]) -> None:
    bag = read(HEAD + STRING + CHANNEL + message(1) + message(2, channel=9) + message(3, channel=9) + END)
    assert bag["/text"]["log_time_ns"].tolist() == [1]
    assert "message of channel 9, which is not described, left out: 2" in bag.problems
    assert not bag.is_complete


def test_times_that_cannot_be(read: Callable[[bytes], Bag]) -> None:
    bag = read(HEAD + STRING + CHANNEL + message(5) + message(3) + message(3) + message(2**63 + 1) + message(9) + END)
    problems = " ".join(bag.problems)
    assert "/text: message logged before the one that it follows: 2" in problems
    assert "/text: message that is there twice: 1" in problems
    assert "/text: message with a log or publish time after the year 2262: 1" in problems
    assert len(bag["/text"]) == 5


def test_a_topic_that_is_defined_in_two_ways(read: Callable[[bytes], Bag]) -> None:
    other = record(4, struct.pack("<HH", 1, 1) + text("/other") + text("cdr") + struct.pack("<I", 0))
    bag = read(HEAD + STRING + CHANNEL + message(1) + other + message(2) + END)
    assert bag.topics["/text"].count == 2
    assert "channel 1 defined in two ways, the first is used: 1" in bag.problems


# -- recovered --------------------------------------------------------------------------------------------------------


def test_a_recovered_bag_is_clean_and_holds_what_could_be_read(truth: Truth, tmp_path: Path) -> None:
    draw = random.Random(4)
    for number in range(8):
        data = bytearray(truth.data[: draw.randrange(len(truth.data) // 2, len(truth.data))])
        data[draw.randrange(100, len(data))] ^= 1 << draw.randrange(8)
        damaged, clean = tmp_path / f"{number}.mcap", tmp_path / f"clean_{number}.mcap"
        damaged.write_bytes(data)
        recovery = recover(damaged, clean)
        before, after = read_bag(damaged), read_bag(clean)
        assert after.is_complete
        assert {topic: rows.tolist() for topic, rows in after.arrays.items()} == {
            topic: rows.tolist() for topic, rows in before.arrays.items()
        }
        assert not recovery.is_complete
        assert set(recovery.problems) >= {problem for problem in before.problems if "chunk" in problem}


# -- at random --------------------------------------------------------------------------------------------------------


def _mutations() -> st.SearchStrategy[bytes]:
    """Bags to which something was done: bytes replaced, taken out, put in, repeated."""
    bases = [write(**options)[:3000] + write(**options)[-1500:] for options in OPTIONS.values()]
    place = st.integers(0, 4400)
    edit = st.tuples(st.sampled_from(["replace", "remove", "insert", "repeat"]), place, st.binary(max_size=12))

    def apply(base: bytes, edits: list[tuple[str, int, bytes]]) -> bytes:
        data = bytearray(base)
        for what, at, content in edits:
            if what == "replace":
                data[at : at + len(content)] = content
            elif what == "remove":
                del data[at : at + 3 * len(content)]
            elif what == "insert":
                data[at:at] = content
            else:
                data[at:at] = data[max(0, at - 40 * len(content)) : at]
        return bytes(data)

    return st.builds(apply, st.sampled_from(bases), st.lists(edit, max_size=6))


@given(_mutations())
@settings(max_examples=250, deadline=None, derandomize=True)
def test_whatever_is_in_a_file_it_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "mutated.mcap"
    path.write_bytes(data)
    try:
        bag = read_bag(path)
    except BagError:
        return
    for topic in bag.topics:
        assert bag.topics[topic].count >= len(bag.arrays.get(topic, ()))


@given(
    st.lists(st.one_of(st.binary(max_size=60), st.sampled_from([STRING, CHANNEL, message(1), chunk(message(2)), END])))
)
@settings(max_examples=250, deadline=None, derandomize=True)
def test_any_sequence_of_records_and_rubbish(tmp_path_factory: pytest.TempPathFactory, parts: list[bytes]) -> None:
    path = tmp_path_factory.getbasetemp() / "parts.mcap"
    path.write_bytes(HEAD + b"".join(parts))
    bag = read_bag(path)
    assert all(isinstance(problem, str) for problem in bag.problems)
