"""An MCAP file with chunks, indexes and checksums, byte for byte as the library `mcap` writes it.

All records but the messages and their index are the library's. Those two are packed here, since a loop that is recorded
in its own process waits meanwhile: a message costs one struct instead of a dozen calls.

Source: the MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import zlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from itertools import chain
from struct import Struct, pack
from typing import Protocol

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from agv_analysis.bags.records import MAGIC

_MESSAGE = Struct("<BQHIQQ")
"""Opcode, length, channel, sequence number, log time, publish time; the payload follows."""

_INDEX = Struct("<BQHI")
"""Opcode, length, channel, size of the entries, which follow: log time and offset of each message."""

_FOOTER_HEAD = Struct("<BQQQ")
_FOOTER_LENGTH = 20

_MESSAGE_HEAD = _MESSAGE.size - 9
"""Bytes of a message's record between its length and its payload."""


class Stream(Protocol):
    """What is written to."""

    def write(self, data: bytes, /) -> int:
        """Write all of it. Raises OSError."""

    def tell(self) -> int:
        """Bytes so far."""

    def flush(self) -> None:
        """Give the system what has been written. Raises OSError."""


class McapWriter:
    """Writes to an open stream, which stays open. All methods raise OSError as the stream does."""

    def __init__(self, stream: Stream, chunk_size: int, library: str) -> None:
        """Begin a file of profile `ros2`. A chunk is written once it has more than `chunk_size` bytes."""
        self._stream = stream
        self._chunk_size = chunk_size
        self._compress = zstandard.ZstdCompressor().compress
        self._data_crc = 0
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: Counter[int] = Counter()
        """Messages by channel, in the order of their first messages."""
        self._first_ns, self._last_ns = 0, 0
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._parts: list[bytes] = []
        """The chunk in progress."""
        self._size = 0
        self._places: defaultdict[int, list[tuple[int, int]]] = defaultdict(list)
        """Log time and offset of each message of the chunk, by channel."""
        self._write(MAGIC)
        self._write(_record(Header("ros2", library)))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Describe a type; returns its number."""
        number = len(self._schemas) + 1
        self._schemas[number] = Schema(id=number, data=data, encoding=encoding, name=name)
        self._add(_record(self._schemas[number]))
        return number

    def register_channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Describe a topic, whose type is the schema of this number; returns its number."""
        number = len(self._channels) + 1
        self._channels[number] = Channel(
            id=number, topic=topic, message_encoding=encoding, schema_id=schema, metadata=dict(metadata)
        )
        self._add(_record(self._channels[number]))
        return number

    def add_message(self, channel: int, log_time_ns: int, data: bytes, publish_time_ns: int) -> None:
        """Add a message to a channel."""
        self._places[channel].append((log_time_ns, self._size))
        self._parts.append(
            _MESSAGE.pack(Opcode.MESSAGE, _MESSAGE_HEAD + len(data), channel, 0, log_time_ns, publish_time_ns)
        )
        self._add(data, _MESSAGE.size)

    def _add(self, record: bytes, before: int = 0) -> None:
        """Put a record into the chunk, of which `before` bytes are there already."""
        self._parts.append(record)
        self._size += before + len(record)
        if self._size > self._chunk_size:
            self._finish_chunk()

    def add_metadata(self, name: str, content: Mapping[str, str]) -> None:
        """Add a metadata record, outside of chunks."""
        record = _record(Metadata(name=name, metadata=dict(content)))
        self._metadata.append(MetadataIndex(offset=self._stream.tell(), length=len(record), name=name))
        self._write(record)

    def add_attachment(self, create_time_ns: int, log_time_ns: int, name: str, media_type: str, data: bytes) -> None:
        """Add a file, outside of chunks."""
        record = _record(
            Attachment(create_time=create_time_ns, log_time=log_time_ns, name=name, media_type=media_type, data=data)
        )
        self._attachments.append(
            AttachmentIndex(
                offset=self._stream.tell(), length=len(record), create_time=create_time_ns, log_time=log_time_ns,
                data_size=len(data), name=name, media_type=media_type,
            )
        )  # fmt: skip
        self._write(record)

    def flush(self) -> None:
        """Write the chunk in progress, if it has messages, and give the system what has been written."""
        self._finish_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """Write what is in progress, the summary and the end."""
        self._finish_chunk()
        self._write(_record(DataEnd(self._data_crc)))
        start = self._stream.tell()
        groups = [
            (Opcode.SCHEMA, _records(self._schemas.values())),
            (Opcode.CHANNEL, _records(self._channels.values())),
            (Opcode.STATISTICS, _record(self._statistics())),
            (Opcode.CHUNK_INDEX, _records(self._chunks)),
            (Opcode.ATTACHMENT_INDEX, _records(self._attachments)),
            (Opcode.METADATA_INDEX, _records(self._metadata)),
        ]
        summary, offsets = b"", b""
        for opcode, records in groups:
            where = SummaryOffset(group_opcode=opcode, group_start=start + len(summary), group_length=len(records))
            offsets += _record(where)
            summary += records
        offsets_at = start + len(summary)
        crc = zlib.crc32(summary + offsets + _FOOTER_HEAD.pack(Opcode.FOOTER, _FOOTER_LENGTH, start, offsets_at))
        footer = Footer(summary_start=start, summary_offset_start=offsets_at, summary_crc=crc)
        self._write(summary + offsets + _record(footer) + MAGIC)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments), channel_count=len(self._channels),
            channel_message_counts=dict(self._counts), chunk_count=len(self._chunks),
            message_count=self._counts.total(), metadata_count=len(self._metadata),
            message_start_time=self._first_ns, message_end_time=self._last_ns, schema_count=len(self._schemas),
        )  # fmt: skip

    def _write(self, data: bytes) -> None:
        self._data_crc = zlib.crc32(data, self._data_crc)
        self._stream.write(data)

    def _finish_chunk(self) -> None:
        if not self._places:
            return
        content = b"".join(self._parts)
        compressed = self._compress(content)
        times = [time_ns for places in self._places.values() for time_ns, _ in places]
        first_ns, last_ns = min(times), max(times)
        start = self._stream.tell()
        chunk = _record(
            Chunk(
                compression="zstd", data=compressed, message_start_time=first_ns, message_end_time=last_ns,
                uncompressed_crc=zlib.crc32(content), uncompressed_size=len(content),
            )
        )  # fmt: skip
        self._write(chunk)
        index, offsets = b"", {}
        for channel, places in self._places.items():
            offsets[channel] = start + len(chunk) + len(index)
            index += _message_index(channel, places)
            self._counts[channel] += len(places)
        self._write(index)
        self._chunks.append(
            ChunkIndex(
                message_start_time=first_ns, message_end_time=last_ns, chunk_start_offset=start,
                chunk_length=len(chunk), message_index_offsets=offsets, message_index_length=len(index),
                compression="zstd", compressed_size=len(compressed), uncompressed_size=len(content),
            )
        )  # fmt: skip
        self._first_ns = first_ns if len(self._chunks) == 1 else min(self._first_ns, first_ns)
        self._last_ns = max(self._last_ns, last_ns)
        self._parts, self._size = [], 0
        self._places.clear()


def _message_index(channel: int, places: list[tuple[int, int]]) -> bytes:
    size = 16 * len(places)
    head = _INDEX.pack(Opcode.MESSAGE_INDEX, _INDEX.size - 9 + size, channel, size)
    return head + pack(f"<{2 * len(places)}Q", *chain.from_iterable(places))


def _records(records: Iterable[McapRecord]) -> bytes:
    return b"".join(map(_record, records))


def _record(record: McapRecord) -> bytes:
    """A record as it stands in the file."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
