"""Records of an MCAP file: bytes -> values, every length checked before it is used.

Source: https://mcap.dev/spec: a record is an opcode (1 byte), a length (8 bytes) and that many bytes; integers are
little-endian; strings, maps and arrays are preceded by their length in bytes (4, or 8 for the content of chunks and
attachments).
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags.bag_errors import DamagedError

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")
"""Opcode and length."""

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = 1, 2, 3, 4, 5, 6, 7, 8
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = 9, 10, 11, 12, 13, 14, 15

DATA_KINDS = (SCHEMA, CHANNEL, ATTACHMENT, METADATA)
"""Opcodes of records other than messages and chunks that hold what is nowhere else."""

PRIVATE = 0x80
"""Opcodes from here on are left to applications."""

MESSAGE_HEAD = 22
"""Bytes of a message record before its payload: channel (2), sequence (4), log time (8), publish time (8)."""

FOOTER_SIZE = RECORD.size + 20
DATA_END_SIZE = RECORD.size + 4

TYPE_HASH = "topic_type_hash"
"""Key in a channel's metadata that holds the hash of its type."""

QOS = "offered_qos_profiles"
"""Key in a channel's metadata that holds the QoS of its publishers (YAML)."""

Read = Callable[[int, int], bytes]
"""Bytes from a place (first argument), as many as the second one says, or fewer at the end."""

_SHAPES = {
    HEADER: "bb", FOOTER: "884", SCHEMA: "2bbb", CHANNEL: "22bbb", CHUNK: "8884bB", MESSAGE_INDEX: "2b",
    CHUNK_INDEX: "8888b8b88", ATTACHMENT: "88bbB4", ATTACHMENT_INDEX: "88888bb", STATISTICS: "82444488b",
    METADATA: "bb", METADATA_INDEX: "88b", SUMMARY_OFFSET: "188", DATA_END: "4",
}  # fmt: skip
"""Parts of each kind of record: a number of bytes, or a block after its length of 4 (b) or 8 (B) bytes."""


def is_known(opcode: int) -> bool:
    """Is this the opcode of a record that is read here?"""
    return opcode == MESSAGE or opcode in _SHAPES


def has_shape(opcode: int, length: int, read: Read) -> bool:
    """Do the lengths inside a record of a known kind add up to its own? `read` counts from the record's content."""
    return fields_end(opcode, length, read) == length


def fields_end(opcode: int, length: int, read: Read) -> int | None:
    """Where the fields end that a record of a known kind has; None if that is beyond its length.

    What follows them, up to its length, are fields that a newer version of MCAP may add: to be ignored.
    """
    if opcode == MESSAGE:  # whatever follows its head is payload
        return length if length >= MESSAGE_HEAD else None
    position = 0
    for part in _SHAPES[opcode]:
        if part in "bB":
            size = 4 if part == "b" else 8
            position += size + int.from_bytes(read(position, size), "little")
        else:
            position += int(part)
        if position > length:
            return None
    return position


class Cursor:
    """Reads the parts of a record one after the other; raises DamagedError where one would go past its end."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self.position = 0

    def take(self, count: int) -> bytes:
        """The next `count` bytes."""
        begin, self.position = self.position, self.position + count
        if self.position > len(self._content):
            raise DamagedError(f"a length of {count} where {len(self._content) - begin} bytes are left")
        return self._content[begin : self.position]

    def number(self, size: int) -> int:
        """An unsigned integer of `size` bytes."""
        return int.from_bytes(self.take(size), "little")

    def block(self, size: int = 4) -> bytes:
        """Bytes after their length of `size` bytes."""
        return self.take(self.number(size))

    def text(self) -> str:
        """A string."""
        try:
            return self.block().decode()
        except UnicodeDecodeError:
            raise DamagedError("a text that is not UTF-8") from None

    def texts(self) -> dict[str, str]:
        """A map of strings."""
        inner = Cursor(self.block())
        found = {}
        while not inner.is_at_end:
            key = inner.text()
            found[key] = inner.text()
        return found

    @property
    def is_at_end(self) -> bool:
        """Has everything been read?"""
        return self.position >= len(self._content)


@dataclass(frozen=True)
class Schema:
    """Definition of a type."""

    id: int
    name: str
    encoding: str
    data: bytes
    """As it lies in the bag; some languages are not text."""

    def defined_by(self, encoding: str, data: bytes) -> Schema:
        """The same type with another definition."""
        return Schema(self.id, self.name, encoding, data)

    @property
    def text(self) -> str:
        """The definition to read; what is not UTF-8, as in comments written long ago, is replaced."""
        return self.data.decode("utf-8", "replace")


@dataclass(frozen=True)
class Channel:
    """A topic, as one writer of it was recorded."""

    id: int
    schema_id: int
    topic: str
    encoding: str
    metadata: dict[str, str]


class Chunk(NamedTuple):
    """Records packed together."""

    size: int
    """Bytes of its content when inflated."""
    crc: int
    """Of the inflated content; 0: none."""
    compression: str
    content: bytes


class Index(NamedTuple):
    """Where the messages of a channel begin in their chunk, as it is said."""

    channel: int
    places: NDArray[np.int64]


@dataclass(frozen=True)
class Statistics:
    """What the writer counted."""

    messages: int
    by_channel: dict[int, int]


class Footer(NamedTuple):
    """Where the summary is (0: there is none), and its CRC (0: none)."""

    summary_start: int
    crc: int


class Attachment(NamedTuple):
    """A file that was put into the recording."""

    name: str
    media_type: str
    log_time: int
    create_time: int
    size: int
    """Bytes of its content."""
    content: bytes


class Foreign(NamedTuple):
    """A record of a kind that is not known here: an application's own, or of a newer version of MCAP."""

    opcode: int
    content: bytes


def parse_schema(content: bytes) -> Schema:
    """Schema record. Raises DamagedError."""
    cursor = Cursor(content)
    return Schema(cursor.number(2), cursor.text(), cursor.text(), cursor.block())


def parse_channel(content: bytes) -> Channel:
    """Channel record. Raises DamagedError."""
    cursor = Cursor(content)
    return Channel(cursor.number(2), cursor.number(2), cursor.text(), cursor.text(), cursor.texts())


def parse_chunk(content: bytes) -> Chunk:
    """Chunk record. Raises DamagedError."""
    cursor = Cursor(content)
    cursor.take(8 + 8)
    return Chunk(cursor.number(8), cursor.number(4), cursor.text(), cursor.block(8))


def parse_index(content: bytes) -> Index:
    """MessageIndex record. Raises DamagedError."""
    cursor = Cursor(content)
    channel, entries = cursor.number(2), cursor.block()
    if len(entries) % 16:
        raise DamagedError(f"a message index of {len(entries)} bytes, which is not a whole number of entries")
    return Index(channel, np.frombuffer(entries, "<i8")[1::2])


def parse_metadata(content: bytes) -> tuple[str, dict[str, str]]:
    """Name and content of a Metadata record. Raises DamagedError."""
    cursor = Cursor(content)
    return cursor.text(), cursor.texts()


def parse_attachment(content: bytes) -> tuple[Attachment, int, int]:
    """Attachment record, its CRC (0: none), and how many bytes of the record that covers. Raises DamagedError."""
    cursor = Cursor(content)
    log_time, create_time = cursor.number(8), cursor.number(8)
    name, media_type, data = cursor.text(), cursor.text(), cursor.block(8)
    attachment = Attachment(name, media_type, log_time, create_time, len(data), data)
    covered = cursor.position
    return attachment, cursor.number(4), covered


def parse_statistics(content: bytes) -> Statistics:
    """Statistics record. Raises DamagedError."""
    cursor = Cursor(content)
    messages = cursor.number(8)
    cursor.take(2 + 4 + 4 + 4 + 4 + 8 + 8)
    counts = Cursor(cursor.block())
    by_channel = {}
    while not counts.is_at_end:
        channel = counts.number(2)
        by_channel[channel] = counts.number(8)
    return Statistics(messages, by_channel)


def parse_footer(content: bytes) -> Footer:
    """Footer record. Raises DamagedError."""
    cursor = Cursor(content)
    summary_start, _, crc = cursor.number(8), cursor.number(8), cursor.number(4)
    return Footer(summary_start, crc)
