"""Records of an MCAP file: bytes -> values, every length checked before it is used.

Source: https://mcap.dev/spec: a record is an opcode (1 byte), a length (8 bytes) and that many bytes; integers are
little-endian; strings, maps and arrays are preceded by their length in bytes (4).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from agv_analysis.bags.errors import DamagedError

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")
"""Opcode and length."""

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = 1, 2, 3, 4, 5, 6, 7, 8
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = 9, 10, 11, 12, 13, 14, 15

MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time, publish time; the payload follows."""

FOOTER_SIZE = RECORD.size + 20


class Cursor:
    """Reads the parts of a record one after the other; raises DamagedError where one would go past its end."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._position = 0

    def take(self, count: int) -> bytes:
        """The next `count` bytes."""
        begin, self._position = self._position, self._position + count
        if self._position > len(self._content):
            raise DamagedError(f"a length of {count} where {len(self._content) - begin} bytes are left")
        return self._content[begin : self._position]

    def number(self, size: int) -> int:
        """An unsigned integer of `size` bytes."""
        return int.from_bytes(self.take(size), "little")

    def text(self, size: int = 4) -> str:
        """A string after its length of `size` bytes."""
        content = self.take(self.number(size))
        try:
            return content.decode()
        except UnicodeDecodeError:
            raise DamagedError("a text that is not UTF-8") from None

    def block(self, size: int = 4) -> bytes:
        """Bytes after their length of `size` bytes."""
        return self.take(self.number(size))

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
        return self._position >= len(self._content)

    def end(self) -> None:
        """Raise DamagedError unless everything has been read."""
        if not self.is_at_end:
            raise DamagedError(f"{len(self._content) - self._position} bytes more than it should have")


@dataclass(frozen=True)
class Schema:
    """Definition of a type."""

    id: int
    name: str
    encoding: str
    text: str


@dataclass(frozen=True)
class Channel:
    """A topic, as one writer of it was recorded."""

    id: int
    schema_id: int
    topic: str
    encoding: str
    metadata: dict[str, str]


@dataclass(frozen=True)
class Statistics:
    """What the writer counted."""

    messages: int
    chunks: int
    by_channel: dict[int, int]


@dataclass(frozen=True)
class Footer:
    """Where the summary is, and its checksum (0: none)."""

    summary_start: int
    summary_crc: int


def parse_schema(content: bytes) -> Schema:
    """Schema record. Raises DamagedError."""
    cursor = Cursor(content)
    schema = Schema(cursor.number(2), cursor.text(), cursor.text(), cursor.text())
    cursor.end()
    return schema


def parse_channel(content: bytes) -> Channel:
    """Channel record. Raises DamagedError."""
    cursor = Cursor(content)
    channel = Channel(cursor.number(2), cursor.number(2), cursor.text(), cursor.text(), cursor.texts())
    cursor.end()
    return channel


def parse_metadata(content: bytes) -> tuple[str, dict[str, str]]:
    """Name and content of a Metadata record. Raises DamagedError."""
    cursor = Cursor(content)
    metadata = cursor.text(), cursor.texts()
    cursor.end()
    return metadata


def parse_statistics(content: bytes) -> Statistics:
    """Statistics record. Raises DamagedError."""
    cursor = Cursor(content)
    messages = cursor.number(8)
    cursor.take(2 + 4 + 4 + 4)
    chunks = cursor.number(4)
    cursor.take(8 + 8)
    counts = Cursor(cursor.block())
    cursor.end()
    by_channel = {}
    while not counts.is_at_end:
        channel = counts.number(2)
        by_channel[channel] = counts.number(8)
    return Statistics(messages, chunks, by_channel)


def parse_footer(content: bytes) -> Footer:
    """Footer record. Raises DamagedError."""
    cursor = Cursor(content)
    summary_start, _, crc = cursor.number(8), cursor.number(8), cursor.number(4)
    cursor.end()
    return Footer(summary_start, crc)
