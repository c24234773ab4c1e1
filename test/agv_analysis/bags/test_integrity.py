"""Damaged bags: whatever is cut off or flipped, what is whole comes back, what is lost is said, nothing is made up."""

from __future__ import annotations

import contextlib
import io
import random
import shutil
import sqlite3
import struct
import tracemalloc
import zlib
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
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from agv_analysis.bags import Bag, BagError, message_compression, packed_files, read_bag, storage
from agv_analysis.bags.chunk import sort_out, walk
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
    "zstd, compiled": {"compression": CompressionType.ZSTD},
    "none without CRC, compiled": {"compression": CompressionType.NONE, "enable_crcs": False},
}
"""Those that are `compiled` are read by the code that reads large files."""

PROVEN = ("zstd", "lz4", "none", "zstd, compiled")


def places_of(kind: str) -> int:
    """At how many random places a bag of this kind is damaged: the one that is recorded here is tried the hardest."""
    return 400 if kind == "zstd" else 80


@pytest.fixture(scope="module", params=OPTIONS)
def kind(request: pytest.FixtureRequest) -> Iterator[str]:
    with pytest.MonkeyPatch.context() as patch:
        if "compiled" in request.param:
            for limit in ("LARGE", "LARGE_ONCE_LOADED"):
                patch.setattr(storage, limit, 0)
        yield str(request.param)


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


@pytest.mark.no_cover
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
    with pytest.raises(BagError, match=r"damaged.mcap: is (empty|not an MCAP file)"):
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


@pytest.mark.no_cover
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


@pytest.mark.no_cover
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


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_decompression_bomb_is_left_alone(read: Callable[[bytes], Bag], compression: str) -> None:
    compress = zstandard.ZstdCompressor().compress if compression == "zstd" else lz4.frame.compress
    bomb, whole = compress(bytes(2**28)), HEAD + STRING + CHANNEL + message(1)
    for declared in (10, 2**20, 2**40, 2**64 - 1):
        packed = struct.pack("<QQQI", 0, 0, declared, 0) + text(compression) + struct.pack("<Q", len(bomb)) + bomb
        with little_memory(2**26):
            bag = read(whole + 5 * record(6, packed) + message(2) + END)
        assert bag["/text"]["log_time_ns"].tolist() == [1, 2]
        assert "damaged chunk, left out" in " ".join(bag.problems)
        assert not bag.is_complete


@contextlib.contextmanager
def little_memory(limit: int) -> Iterator[None]:
    """Hold the bytes that Python and numpy take in here, at their most, against a limit."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < limit
    finally:
        tracemalloc.stop()


def test_bombs_whose_checksums_are_right_are_inflated_one_by_one(tmp_path: Path) -> None:
    """They say that they are empty, but a CRC proves what they hold, so that it is read."""
    bomb = zstandard.ZstdCompressor().compress(bytes(2**24))
    head = struct.pack("<QQQI", 0, 0, 0, zlib.crc32(bytes(2**24)))
    packed = record(6, head + text("zstd") + struct.pack("<Q", len(bomb)) + bomb)
    (tmp_path / "a.mcap").write_bytes(HEAD + STRING + CHANNEL + 12 * packed + message(2) + END)
    with little_memory(2**27):
        bag = read_bag(tmp_path / "a.mcap")
    assert bag["/text"]["log_time_ns"].tolist() == [2]
    assert any("byte in a chunk that belongs to no whole record" in problem for problem in bag.problems)


def test_memory_goes_with_the_largest_chunks_not_with_the_file(tmp_path: Path) -> None:
    """64 chunks of 4 MiB, whose messages nobody asks for."""
    packed = chunk(message(1, "x" * 2**22), compression="zstd")
    (tmp_path / "a.mcap").write_bytes(HEAD + STRING + CHANNEL + 64 * packed + END)
    with little_memory(2**26):
        bag = read_bag(tmp_path / "a.mcap", topics=())
    assert bag.topics["/text"].count == 64


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


@pytest.mark.parametrize("large", [2**24, 0])
def test_a_message_index_is_not_believed(
    read: Callable[[bytes], Bag], monkeypatch: pytest.MonkeyPatch, large: int
) -> None:
    for limit in ("LARGE", "LARGE_ONCE_LOADED"):
        monkeypatch.setattr(storage, limit, large)
    content = message(1) + message(2) + message(3)
    size, useless = len(message(1)), "message index that does not fit its chunk, not used"
    for places in ([0, size, 2 * size], [2 * size, size, 0], [0, 2 * size], [0, size, 2 * size, 0], [0, size, 7],
                   [0, size, 2**63], []):  # fmt: skip
        entries = b"".join(struct.pack("<QQ", 0, place) for place in places)
        index = record(7, struct.pack("<HI", 1, len(entries)) + entries)
        bag = read(HEAD + STRING + CHANNEL + chunk(content) + index + END)
        assert bag["/text"]["log_time_ns"].tolist() == [1, 2, 3]
        assert any(useless in problem for problem in bag.problems) == (sorted(places) != [0, size, 2 * size])


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


@pytest.mark.parametrize(
    ("said", "is_found"),
    [("float64 x\nfloat64 y", False), ("float64 y\nfloat64 x", True), ("int64 x\nfloat64 y", True), ("", False)],
)
def test_a_schema_whose_lie_fits_the_bytes_has_another_hash(
    read: Callable[[bytes], Bag], said: str, is_found: bool
) -> None:
    """The hash is that of x before y, taken from rosbags' own types; without a hash nobody can know."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg("float64 x\nfloat64 y", "a/msg/A"))
    about = text("topic_type_hash") + text(store.hash_rihs01("a/msg/A") if said else "")
    schema = record(3, struct.pack("<H", 1) + text("a/msg/A") + text("ros2msg") + text(said or "float64 y\nfloat64 x"))
    channel = record(4, struct.pack("<HH", 1, 1) + text("/a") + text("cdr") + struct.pack("<I", len(about)) + about)
    sent = record(5, struct.pack("<HIQQ", 1, 0, 1, 1) + b"\0\1\0\0" + struct.pack("<dd", 1.0, 2.0))
    bag = read(HEAD + schema + channel + sent + END)
    assert any("does not match the recorded hash" in problem for problem in bag.problems) == is_found


def test_messages_without_a_channel_are_counted(read: Callable[[bytes], Bag]) -> None:
    bag = read(HEAD + STRING + CHANNEL + message(1) + message(2, channel=9) + message(3, channel=9) + END)
    assert bag["/text"]["log_time_ns"].tolist() == [1]
    assert "message of channel 9, which is not described, so that its topic is not known: 2" in bag.problems
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


def test_values_that_are_not_numbers_stay_what_they_are(read: Callable[[bytes], Bag]) -> None:
    """A stamp that is NaN, and two messages that only a NaN's bits tell apart, or nothing does."""
    schema = record(3, struct.pack("<H", 1) + text("a/msg/A") + text("ros2msg") + text("float64 stamp"))
    channel = record(4, struct.pack("<HH", 1, 1) + text("/a") + text("cdr") + struct.pack("<I", 0))
    quiet, other = 0x7FF8000000000000, 0x7FF8000000000001
    sent = [
        record(5, struct.pack("<HIQQ", 1, 0, 7, 7) + b"\0\1\0\0" + struct.pack("<Q", bits))
        for bits in (quiet, quiet, other)
    ]
    bag = read(HEAD + schema + channel + b"".join(sent) + END)
    assert bag["/a"]["stamp"].view(np.uint64).tolist() == [quiet, quiet, other]
    assert "/a: message that is there twice: 1" in bag.problems


def test_another_magic(read: Callable[[bytes], Bag]) -> None:
    """Before sound records it is said; before anything else the file is refused."""
    whole = write()
    for magic in (b"\x89MCAP1\r\n", b"#ROSBAG ", bytes(8)):
        bag = read(magic + whole[8:])
        assert rows_of(bag) == expected_rows()
        assert any("instead of 89 4d 43 41 50 30 0d 0a" in problem for problem in bag.problems)
    refusals = {
        b"#ROSBAG V2.0\n" + bytes(100): "is a ROS 1 bag; `pip install rosbags && rosbags-convert --src",
        b"SQLite format 3\0" + bytes(100): "sqlite3 cannot open it: file is not a database",
        whole[9:]: "is not an MCAP file: begins with",
    }
    for content, why in refusals.items():
        with pytest.raises(BagError, match=why):
            read(content)


# -- sqlite3 -----------------------------------------------------------------------------------------------------------


def database(path: Path, compression: CompressionMode = CompressionMode.NONE) -> Path:
    """The small loop as a rosbag2 directory with a sqlite3 database."""
    writer = Rosbag2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
    if compression != CompressionMode.NONE:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    fill(writer)
    return next(path.glob("*.db3"))


def fill(writer: Rosbag2Writer) -> None:
    """Write the small loop by rosbags."""
    connections: dict[str, Any] = {}
    with writer:
        for ns, topic, content in _messages():
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, content.__msgtype__, typestore=STORE)
            writer.write(connections[topic], ns, bytes(STORE.serialize_cdr(content, content.__msgtype__)))


def change(path: Path, *statements: str) -> None:
    """Change a database."""
    with contextlib.closing(sqlite3.connect(path)) as connection:
        for statement in statements:
            connection.execute(statement)
        connection.commit()


def test_a_database_that_was_cut_or_flipped_is_read_or_refused(tmp_path: Path) -> None:
    whole, damaged = database(tmp_path / "bag").read_bytes(), tmp_path / "damaged.db3"
    draw = random.Random(5)
    for number in range(300):
        data = bytearray(whole[: draw.randrange(len(whole))] if number % 3 == 0 else whole)
        for _ in range(number % 3 and draw.choice([1, 1, 30])):
            data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
        damaged.write_bytes(data)
        try:
            bag = read_bag(damaged)
        except BagError:
            continue
        assert "storage without checksums, whose content is not checked: 1" in bag.problems
        if bag.is_complete:
            assert sum(topic.count for topic in bag.topics.values()) == len(_messages()), number


def test_what_is_missing_in_a_database_is_said(tmp_path: Path) -> None:
    path = database(tmp_path / "bag")
    change(path, "DELETE FROM messages WHERE id IN (5, 6, 90)")
    bag = read_bag(path)
    assert f"{path.name}: message missing from the sequence of its numbers: 3" in bag.problems
    assert not bag.is_complete


def test_rows_of_a_database_that_are_no_messages_cost_themselves_alone(tmp_path: Path) -> None:
    path = tmp_path / "bag.db3"
    shutil.copy(database(tmp_path / "bag"), path)
    change(
        path,
        "CREATE TABLE free AS SELECT * FROM messages", "DROP TABLE messages", "ALTER TABLE free RENAME TO messages",
        "UPDATE messages SET data = NULL WHERE id = 4", "UPDATE messages SET timestamp = 'noon' WHERE id = 7",
        "UPDATE messages SET data = x'' WHERE id = 10",
    )  # fmt: skip
    bag = read_bag(path)
    assert not bag.is_complete
    assert len(bag["/agv/pose"]) == len(bag["/edge/slot"]) == STEPS
    assert len(bag["/clock"]) == STEPS - 3
    assert "/clock: row that is not a message, left out: 2" in bag.problems


@pytest.mark.parametrize(("mode", "log"), [("WAL", "-wal"), ("DELETE", "-journal")])
def test_a_database_that_was_still_being_written(tmp_path: Path, mode: str, log: str) -> None:
    """What was committed is read, what was not is not a message yet; the files stay as they were."""
    path = database(tmp_path / "bag")
    insert = "INSERT INTO messages (topic_id, timestamp, data) VALUES (1, 5, x'0001000001000000')"
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute(f"PRAGMA journal_mode={mode}")
        connection.execute("PRAGMA cache_size=1")
        connection.execute(insert)
        connection.execute("BEGIN")
        connection.execute("UPDATE messages SET timestamp = timestamp + 1")
        for file in (path, path.with_name(path.name + log)):
            shutil.copy(file, tmp_path)  # as a power cut leaves them
        connection.execute("ROLLBACK")
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir() if file.is_file()}
    bag = read_bag(tmp_path / path.name)
    assert any(f"{path.name}{log}, of a recording that was interrupted, read" in problem for problem in bag.problems)
    assert bag.topics["/clock"].count == STEPS + 1
    assert [row[:2] for row in bag["/agv/pose"][["log_time_ns", "pose.position.x"]].tolist()] == [
        (ns, message.pose.position.x) for ns, topic, message in _messages() if topic == "/agv/pose"
    ]
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir() if file.is_file()} == before


def test_a_bomb_among_messages_that_are_compressed_one_by_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(message_compression, "MAX_MESSAGE", 2**23)
    path = database(tmp_path / "bag", CompressionMode.MESSAGE)
    bombs = [zstandard.ZstdCompressor().compress(bytes(2**28))]
    stream = zstandard.ZstdCompressor().compressobj()  # does not say how much it is
    bombs.append(stream.compress(bytes(2**28)) + stream.flush())
    with contextlib.closing(sqlite3.connect(path)) as connection:
        for row, bomb in zip((1, 4), bombs, strict=True):
            connection.execute("UPDATE messages SET data = ? WHERE id = ?", (bomb, row))
        connection.commit()
    with little_memory(2**26):
        bag = read_bag(path.parent)
    assert len(bag["/clock"]) == STEPS - 2
    assert len(bag["/agv/pose"]) == len(bag["/edge/slot"]) == STEPS
    assert not bag.is_complete


# -- compressed as a whole --------------------------------------------------------------------------------------------


def packed(path: Path) -> Path:
    """The small loop as a rosbag2 directory whose MCAP file is compressed as a whole."""
    writer = Rosbag2Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    fill(writer)
    return next(path.glob("*.mcap.zstd"))


def test_a_file_that_was_compressed_and_cut_gives_what_is_whole_in_it(tmp_path: Path) -> None:
    file = packed(tmp_path / "bag")
    whole = rows_without_publish_times(read_bag(file.parent))
    assert len(whole) == len(_messages())
    stream, content = zstandard.ZstdCompressor().compressobj(), zstandard.decompress(file.read_bytes(), 2**20)
    blocks = [
        stream.compress(content[at : at + 1000]) + stream.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
        for at in range(0, len(content), 1000)
    ]
    for number in range(1, len(blocks)):
        file.write_bytes(b"".join(blocks[:number]))
        bag = read_bag(file.parent)
        expected = log_times_before(content, 1000 * number)
        assert rows_without_publish_times(bag) == {ns: whole[ns] for ns in expected}, number
        assert not bag.is_complete
    file.write_bytes(b"")
    with pytest.raises(BagError, match="is empty"):
        read_bag(file.parent)


def rows_without_publish_times(bag: Bag) -> dict[int, tuple[Any, ...]]:
    return {ns: (row[0], *row[3:]) for ns, row in rows_of(bag).items()}


def test_flipped_bits_in_a_compressed_file(tmp_path: Path) -> None:
    file = packed(tmp_path / "bag")
    whole, data, draw = rows_without_publish_times(read_bag(file.parent)), file.read_bytes(), random.Random(6)
    for _ in range(60):
        damaged = bytearray(data)
        damaged[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
        file.write_bytes(damaged)
        try:
            bag = read_bag(file.parent)
        except BagError:
            continue
        assert bag.problems or rows_without_publish_times(bag) == whole


def test_a_bomb_as_a_whole_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packed_files, "_ALWAYS_UNPACKED", 2**20)
    file = packed(tmp_path / "bag")
    assert len(rows_of(read_bag(file.parent))) == len(_messages())
    file.write_bytes(zstandard.ZstdCompressor().compress(bytes(2**28)))
    with little_memory(2**26), pytest.raises(BagError, match="inflates to more than 1000 times its size"):
        read_bag(file.parent)


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
        assert after.is_complete or any("message that is not of its type" in problem for problem in before.problems)
        assert {topic: rows.tolist() for topic, rows in after.arrays.items()} == {
            topic: rows.tolist() for topic, rows in before.arrays.items()
        }
        assert not recovery.is_complete
        assert set(recovery.problems) >= {problem for problem in before.problems if "chunk" in problem}


# -- at random --------------------------------------------------------------------------------------------------------


def _contents() -> st.SearchStrategy[bytes]:
    """Contents of chunks: messages of several channels, as a rule, and perhaps something else, or a byte changed."""
    sent = st.builds(message, st.integers(0, 2**64 - 1), st.text(max_size=5), st.sampled_from([1, 2, 300, 65535]))
    parts = st.lists(st.one_of(sent, sent, sent, st.sampled_from([STRING, CHANNEL, b"\5", bytes(40)])), max_size=12)

    def changed(parts: list[bytes], at: int, byte: int) -> bytes:
        data = bytearray(b"".join(parts))
        if at < len(data):
            data[at] = byte
        return bytes(data)

    return st.builds(changed, parts, st.integers(0, 1000), st.integers(0, 255))


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


@given(_contents())
@settings(max_examples=300, deadline=None, derandomize=True)
def test_the_compiled_index_is_the_walk_from_record_to_record(content: bytes) -> None:
    """Or leaves it to that, where there is anything else than messages."""
    found, is_named = sort_out(content, [], is_large=True)
    expected = walk(content)
    assert (found.lost, found.definitions, is_named) == (expected.lost, expected.definitions, False)
    assert found.messages.keys() == expected.messages.keys()
    for channel, messages in expected.messages.items():
        assert found.messages[channel].starts.tolist() == messages.starts.tolist()
        assert found.messages[channel].lengths.tolist() == messages.lengths.tolist()


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
