"""Bags that are not MCAP, read by the library rosbags: sqlite3, and what rosbag2 compressed as files or messages."""

from __future__ import annotations

import contextlib
import sqlite3
import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from agv_analysis.bags.bag_errors import BagError, DamagedError
from agv_analysis.bags.compression import declared_size, inflate_start
from agv_analysis.bags.findings import Findings
from agv_analysis.bags.message_batch import Batch
from agv_analysis.bags.records import TYPE_HASH, Attachment, Channel, Schema
from agv_analysis.bags.storage import IsWanted

MAX_MESSAGE = 2**28
"""Most bytes that one message may inflate to."""

_BATCH = 4096
_BATCH_BYTES = 2**24
"""Messages, and bytes of them, that are passed on together."""

_LEAD = struct.Struct("<qq")

_MOST_SAID = 10
"""Most error messages of sqlite3 that are passed on."""


class RosbagsFile:
    """Reads a rosbag2 directory or a .db3 file through rosbags; it knows one time of a message only."""

    def __init__(self, path: Path) -> None:
        """Open the bag. Raises BagError if rosbags is not installed or cannot open it."""
        self.path = path
        self.findings = Findings()
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: list[Attachment] = []
        self.counts: Counter[int] = Counter()
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.position = 0
        try:
            from rosbags.rosbag2 import Reader
        except ImportError:
            raise BagError(
                f"{path}: to read this kind of bag (sqlite3, or compressed as a whole), `pip install rosbags`"
            ) from None
        self._reader = Reader(path)
        try:
            self._reader.open()
            self._describe()
        except Exception as error:  # rosbags lets through what its libraries raise
            raise BagError(f"{path}: rosbags cannot open it: {error}{_remedy(path)}") from None
        self._inflates = _take_over_inflating(self._reader)
        self.findings.add("storage without checksums, whose content is not checked")
        for file in sorted(path.glob("*.db3")) if path.is_dir() else [path]:
            _check_database(file, self.findings)

    @property
    def size(self) -> int:
        """Messages that there are to read."""
        return int(self._reader.message_count)

    def close(self) -> None:
        """Close the bag."""
        self._reader.close()

    def expected(self, channel: int) -> int:
        """Messages that the channel is said to have."""
        return int(self._connections[channel].msgcount)

    def _describe(self) -> None:
        self._connections = {connection.id: connection for connection in self._reader.connections}
        for number, connection in self._connections.items():
            self.schemas[number] = Schema(number, connection.msgtype, "ros2msg", _definition(connection))
            about = {TYPE_HASH: str(connection.digest or "")}
            self.channels[number] = Channel(number, number, connection.topic, "cdr", about)

    def batches(self, is_wanted: IsWanted) -> Iterator[tuple[Channel, Batch]]:
        """The messages of all channels that are wanted, in the order of their times, in batches of one channel."""
        waiting: dict[int, list[bytes]] = {}
        try:
            for connection, time, data in self._reader.messages():
                self.position += 1
                lead_and_payload = self._message(connection.topic, time, data)
                if lead_and_payload is None:
                    continue
                self.counts[connection.id] += 1
                if is_wanted(self.channels[connection.id]):
                    messages = waiting.setdefault(connection.id, [])
                    messages.append(lead_and_payload)
                    if len(messages) == _BATCH or len(messages) * len(lead_and_payload) > _BATCH_BYTES:
                        yield self.channels[connection.id], _batch(waiting.pop(connection.id))
        except Exception as error:  # rosbags lets through what its libraries raise
            self.findings.add(f"end of what rosbags can read ({error})", is_loss=True)
        for number, messages in waiting.items():
            yield self.channels[number], _batch(messages)

    def _message(self, topic: str, time: object, data: object) -> bytes | None:
        """A message behind its lead; None if a damaged row holds anything else."""
        if not isinstance(time, int) or not isinstance(data, bytes):
            self.findings.add(f"{topic}: row that is no message, left out", is_loss=True)
            return None
        try:
            payload = _inflated(data) if self._inflates else data
        except DamagedError as error:
            self.findings.add(f"{topic}: message that cannot be inflated, left out ({error})", is_loss=True)
            return None
        return _LEAD.pack(time, time) + payload


def _inflated(data: bytes) -> bytes:
    """A message that was compressed alone. Raises DamagedError, for one of more than MAX_MESSAGE bytes, too."""
    size = declared_size("zstd", data)
    if size is not None and size > MAX_MESSAGE:
        raise DamagedError(f"{size} bytes are declared, at most {MAX_MESSAGE} are inflated")
    inflated = inflate_start("zstd", data, MAX_MESSAGE + 1)
    if len(inflated) > MAX_MESSAGE:
        raise DamagedError(f"it holds more than {MAX_MESSAGE} bytes")
    return inflated


def _take_over_inflating(reader: Any) -> bool:
    """Where each message is compressed, have rosbags hand them out as they are: it would inflate to any size."""
    metadata: Any = getattr(reader.storage, "metadata", None)
    if metadata is None or metadata.compression_mode != "message":
        return False
    reader.storage.metadata = metadata._replace(compression_mode=None)
    return True


def _remedy(path: Path) -> str:
    is_database = path.suffix == ".db3" or (path.is_dir() and any(path.glob("*.db3")))
    return "; `sqlite3 FILE .recover | sqlite3 NEW.db3` may recover what is intact" if is_database else ""


def _check_database(path: Path, findings: Findings) -> None:
    """What sqlite3 itself finds wrong with a file, and what is beside it and not in it."""
    for ending in ("-wal", "-journal"):
        log = path.with_name(path.name + ending)
        if log.exists() and log.stat().st_size:
            findings.add(
                f"{log.name}, a recording that was interrupted: its messages are not read; opened for writing once, "
                f"as by `sqlite3 {path.name} vacuum`, the database takes them over", is_loss=True,
            )  # fmt: skip
    try:
        with contextlib.closing(sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)) as database:
            found = [str(row[0]) for row in database.execute(f"PRAGMA integrity_check({_MOST_SAID})")]
            (gaps,) = database.execute("SELECT max(id) - min(id) + 1 - count(*) FROM messages").fetchone()
    except (sqlite3.Error, ValueError, OverflowError) as error:
        found, gaps = [str(error)], 0
    for text in found:
        if text != "ok":
            findings.add(f"{path.name}: database that is damaged ({' '.join(text.split())})", is_loss=True)
    if isinstance(gaps, int) and gaps > 0:
        findings.add(f"{path.name}: message missing from the sequence of its numbers", gaps, is_loss=True)


def _definition(connection: Any) -> str:
    """Definition of a topic's type: the bag's, or for older bags, which have none, that of ROS 2 Jazzy."""
    if connection.msgdef.format.name == "MSG" and connection.msgdef.data:
        return str(connection.msgdef.data)
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    if connection.msgtype not in store.types:
        return ""
    return str(store.generate_msgdef(connection.msgtype, ros_version=2)[0])


def _batch(messages: list[bytes]) -> Batch:
    sizes = np.array([len(message) for message in messages], np.int64)
    return Batch(np.frombuffer(b"".join(messages), np.uint8), np.cumsum(sizes) - sizes, sizes)
