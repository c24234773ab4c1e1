"""Bags as other programs leave them behind, each with what an independent reader finds in it."""

from __future__ import annotations

import contextlib
import sqlite3
import struct
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

Payloads = dict[str, list[tuple[int, bytes]]]
"""(log time, payload) of each message by topic, sorted."""

STORE = get_typestore(Stores.ROS2_HUMBLE)
PRIVATE = "my_msgs/msg/Reading"
STORE.register(get_types_from_msg("float64[3] values\nstring unit", PRIVATE))
COUNT = 7


def definition(kind: str) -> bytes:
    return STORE.generate_msgdef(kind, ros_version=2)[0].encode()


def messages() -> list[tuple[str, str, int, bytes]]:
    """(topic, type, time [ns], payload)."""
    types, found = STORE.types, []
    for i in range(COUNT):
        ns = 10**9 + 1000 * i
        point = types["geometry_msgs/msg/Point"](float(i), 0.5, -1.0)
        reading = types[PRIVATE](np.array([1.0 * i, 2.0, 3.0]), "V" * i)
        for topic, message in (("/point", point), ("/reading", reading)):
            payload = bytes(STORE.serialize_cdr(message, message.__msgtype__))
            found.append((topic, message.__msgtype__, ns + len(topic), payload))
    return found


# -- sqlite3, as rosbag2 wrote it over the years ----------------------------------------------------------------------

TABLES = {
    2: "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
    " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);",
    3: "CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);"
    "INSERT INTO schema VALUES (3, 'humble');"
    "CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL);"
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
    " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);",
}
"""Foxy, and Humble: neither holds definitions."""

MESSAGES = (
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,"
    " data BLOB NOT NULL); CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
)


def write_database(
    path: Path, version: int = 3, part: list[tuple[str, str, int, bytes]] | None = None, form: str = "cdr"
) -> Path:
    """A bare .db3 file without definitions."""
    rows = messages() if part is None else part
    topics = {topic: (number, kind) for number, (topic, kind) in enumerate(sorted({row[:2] for row in rows}), 1)}
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.executescript("PRAGMA synchronous=OFF;" + TABLES[version] + MESSAGES)
        for topic, (number, kind) in topics.items():
            database.execute("INSERT INTO topics VALUES (?, ?, ?, ?, ?)", (number, topic, kind, form, "- depth: 1"))
        for topic, _, ns, payload in rows:
            insert = "INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)"
            database.execute(insert, (topics[topic][0], ns, payload))
        database.commit()
    return path


def metadata_yaml(files: list[str], counts: dict[str, tuple[str, int]], **other: Any) -> str:
    """A metadata.yaml as Humble writes it (which is YAML, as JSON is)."""
    import json

    about = {
        "version": 5, "storage_identifier": "sqlite3", "duration": {"nanoseconds": 6000},
        "starting_time": {"nanoseconds_since_epoch": 10**9}, "message_count": sum(n for _, n in counts.values()),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic, "type": kind, "serialization_format": "cdr", "offered_qos_profiles": "- depth: 1",
                },
                "message_count": count,
            }
            for topic, (kind, count) in counts.items()
        ],
        "compression_format": "", "compression_mode": "", "relative_file_paths": files, **other,
    }  # fmt: skip
    return json.dumps({"rosbag2_bagfile_information": about})


def humble_directory(path: Path, **other: Any) -> Path:
    path.mkdir()
    write_database(path / f"{path.name}_0.db3")
    counts = {"/point": ("geometry_msgs/msg/Point", COUNT), "/reading": (PRIVATE, COUNT)}
    (path / "metadata.yaml").write_text(metadata_yaml([f"{path.name}_0.db3"], counts, **other))
    return path


# -- MCAP -------------------------------------------------------------------------------------------------------------


def write_mcap(
    path: Path,
    schema: Callable[[str], tuple[str, bytes]] = lambda kind: ("ros2msg", definition(kind)),
    form: str = "cdr",
    **options: Any,
) -> Path:
    """An .mcap file; `schema` gives the encoding and the bytes of a type's definition."""
    with path.open("wb") as file:
        writer = Writer(file, **{"chunk_size": 300, "compression": CompressionType.ZSTD, **options})
        writer.start(profile="ros2", library="test")
        channels: dict[str, int] = {}
        for topic, kind, ns, payload in messages():
            if topic not in channels:
                encoding, data = schema(kind)
                number = writer.register_schema(kind, encoding, data) if encoding else 0
                channels[topic] = writer.register_channel(topic, form, number, {"id": topic})
            writer.add_message(channels[topic], ns, payload, ns - 1)
        writer.add_metadata("notes", {"a": "1"})
        writer.add_metadata("notes", {"a": "2"})
        writer.add_attachment(1, 2, "map.png", "image/png", b"\x89PNG" + bytes(50))
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def without_records(path: Path, opcode: int) -> Path:
    """Take all records of a kind out of an unchunked file without summary."""
    data, position = path.read_bytes(), 8
    parts = [data[:8]]
    while position < len(data) - 8:
        kind, length = struct.unpack_from("<BQ", data, position)
        if kind != opcode:
            parts.append(data[position : position + 9 + length])
        position += 9 + length
    path.write_bytes(b"".join([*parts, data[-8:]]))
    return path


PLAIN: dict[str, Any] = {
    "use_chunking": False, "repeat_channels": False, "repeat_schemas": False, "use_statistics": False,
    "use_summary_offsets": False, "enable_data_crcs": False,
}  # fmt: skip

BAGS: dict[str, Callable[[Path], Path]] = {
    "mcap": lambda folder: write_mcap(folder / "a.mcap"),
    "mcap, empty definitions": lambda folder: write_mcap(folder / "a.mcap", lambda kind: ("ros2msg", b"")),
    "mcap, no schemas": lambda folder: write_mcap(folder / "a.mcap", lambda kind: ("", b"")),
    "mcap, lost schemas": lambda folder: without_records(write_mcap(folder / "a.mcap", **PLAIN), 3),
    "mcap, binary schemas": lambda folder: write_mcap(folder / "a.mcap", lambda kind: ("protobuf", b"\xff\xfe\x00")),
    "mcap, wrong definitions": lambda folder: write_mcap(folder / "a.mcap", lambda kind: ("ros2msg", b"int8[99] x")),
    "mcap, another encoding": lambda folder: write_mcap(folder / "a.mcap", form="protobuf"),
    "sqlite3 of Foxy": lambda folder: write_database(folder / "a.db3", 2),
    "sqlite3 of Humble": lambda folder: write_database(folder / "a.db3", 3),
    "directory of Humble": lambda folder: humble_directory(folder / "bag"),
}
"""Each writes `messages` in another way to a folder."""


def split(folder: Path, numbers: list[int], packed: bool, metadata: bool) -> Path:
    """A split bag in sqlite3, its messages dealt out to files with these numbers."""
    folder.mkdir()
    rows = messages()
    names = []
    for place, number in enumerate(numbers):
        part = rows[place * len(rows) // len(numbers) : (place + 1) * len(rows) // len(numbers)]
        file = write_database(folder / f"x_{number}.db3", part=part)
        if packed:
            file.with_name(f"{file.name}.zstd").write_bytes(zstandard.compress(file.read_bytes()))
            file.unlink()
        names.append(f"x_{number}.db3{'.zstd' * packed}")
    if metadata:
        counts = {"/point": ("geometry_msgs/msg/Point", COUNT), "/reading": (PRIVATE, COUNT)}
        about = {"compression_mode": "FILE", "compression_format": "zstd"} if packed else {}
        (folder / "metadata.yaml").write_text(metadata_yaml(names, counts, **about))
    return folder


def changed(path: Path, old: str, new: str) -> Path:
    """Edit a metadata.yaml by hand."""
    text = (path / "metadata.yaml").read_text()
    assert old in text
    (path / "metadata.yaml").write_text(text.replace(old, new))
    return path


def renamed(path: Path, old: str, new: str) -> Path:
    (path / old).rename(path / new)
    return path


BAGS |= {
    "other QoS in metadata.yaml": lambda folder: changed(humble_directory(folder / "bag"), "depth: 1", "depth: 7"),
    "renamed topic in metadata.yaml": lambda folder: changed(humble_directory(folder / "bag"), "/point", "/position"),
    "renamed data file": lambda folder: renamed(humble_directory(folder / "bag"), "bag_0.db3", "monday.db3"),
    "renamed split": lambda folder: renamed(split(folder / "x", [0, 1], False, True), "x_1.db3", "y_1.db3"),
    "no storage identifier": lambda folder: humble_directory(folder / "bag", storage_identifier=""),
    "wrong storage identifier": lambda folder: humble_directory(folder / "bag", storage_identifier="mcap"),
    "no files in metadata.yaml": lambda folder: humble_directory(folder / "bag", relative_file_paths=[]),
    "a file twice in metadata.yaml": lambda folder: humble_directory(
        folder / "bag", relative_file_paths=["bag_0.db3", "bag/bag_0.db3"]
    ),
    "compressed by hand": lambda folder: renamed(
        split(folder / "x", [0, 1], True, True), "x_1.db3.zstd", "x_1.db3.zst"
    ),
    "compressed splits without metadata.yaml": lambda folder: split(folder / "x", [9, 10], True, False),
    "split with a hole": lambda folder: split(folder / "x", [0, 2], False, False),
    "path of metadata.yaml": lambda folder: humble_directory(folder / "bag") / "metadata.yaml",
    "path of a compressed file": lambda folder: split(folder / "x", [0], True, False) / "x_0.db3.zstd",
    "path of a file of a split": lambda folder: split(folder / "x", [0, 1], True, True) / "x_1.db3.zstd",
    "ending in capitals": lambda folder: renamed(humble_directory(folder / "bag"), "bag_0.db3", "bag_0.DB3"),
}  # fmt: skip


@pytest.fixture(params=BAGS)
def any_bag(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return BAGS[request.param](tmp_path)


@pytest.fixture
def odd_bag(tmp_path: Path) -> Callable[[str], Path]:
    return lambda name: BAGS[name](tmp_path)


# -- other readers ----------------------------------------------------------------------------------------------------


def read_with_others(path: Path) -> Payloads:
    """What a bag holds, by the library mcap or by sqlite3."""
    if (path.parent / "metadata.yaml").exists():
        path = path.parent
    files = [path] if path.is_file() else sorted(path.iterdir())
    found: Payloads = {}
    for file in files:
        if file.name == "metadata.yaml":
            continue
        for topic, ns, payload in _mcap_messages(file) if file.suffix == ".mcap" else _sqlite_messages(file):
            found.setdefault(topic, []).append((ns, payload))
    return {topic: sorted(messages) for topic, messages in found.items()}


def _mcap_messages(path: Path) -> Iterator[tuple[str, int, bytes]]:
    with path.open("rb") as file:
        topics: dict[int, str] = {}
        for found in StreamReader(file, validate_crcs=True).records:
            if isinstance(found, Channel):
                topics[found.id] = found.topic
            elif isinstance(found, Message):
                yield topics[found.channel_id], found.log_time, found.data


def _sqlite_messages(path: Path) -> list[tuple[str, int, bytes]]:
    data = path.read_bytes()
    with contextlib.closing(sqlite3.connect(":memory:")) as database, contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        (folder / "x").write_bytes(zstandard.decompress(data) if data.startswith(b"\x28\xb5\x2f\xfd") else data)
        database.execute("ATTACH ? AS bag", (str(folder / "x"),))
        return database.execute(
            "SELECT name, timestamp, data FROM messages JOIN topics ON topics.id = messages.topic_id"
        ).fetchall()


@pytest.fixture
def by_others() -> Callable[[Path], Payloads]:
    return read_with_others


@pytest.fixture
def make_record() -> Callable[[int, bytes], bytes]:
    return record


@pytest.fixture
def make_database() -> Callable[..., Path]:
    return write_database


@pytest.fixture
def make_mcap() -> Callable[..., Path]:
    return write_mcap


@pytest.fixture
def make_metadata() -> Callable[..., str]:
    return metadata_yaml
