"""Chunks: from the record in the file to the messages in it."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags.batch import Bytes, Ints
from agv_analysis.bags.compression import inflate
from agv_analysis.bags.errors import DamagedError
from agv_analysis.bags.records import MESSAGE, MESSAGE_HEAD, RECORD, Cursor

_HEAD = struct.Struct("<QQQI")
"""First and last log time, inflated size, CRC of the inflated content."""


class Chunk(NamedTuple):
    """A chunk as it lies in the file."""

    size: int
    """Bytes of its content when inflated."""
    crc: int
    """Of the inflated content; 0: none."""
    compression: str
    content: bytes


class Messages(NamedTuple):
    """Messages in a buffer, in file order."""

    starts: Ints
    """Where their records begin, shape (n,)."""
    lengths: Ints
    """Lengths of their records' contents, shape (n,)."""
    channels: NDArray[np.uint16]
    """Their channels, shape (n,)."""


class Definition(NamedTuple):
    """A record other than a message that lies among the messages."""

    opcode: int
    content: bytes


def parse_chunk(content: bytes) -> Chunk:
    """Chunk record. Raises DamagedError."""
    cursor = Cursor(content)
    _, _, size, crc = _HEAD.unpack(cursor.take(_HEAD.size))
    chunk = Chunk(size, crc, cursor.text(), cursor.block(8))
    cursor.end()
    return chunk


def open_chunk(chunk: Chunk) -> bytes:
    """Content of a chunk, checked against its CRC where it has one. Raises DamagedError."""
    content = inflate(chunk.compression, chunk.content, chunk.size)
    if chunk.crc and zlib.crc32(content) != chunk.crc:
        raise DamagedError("its content does not match its CRC")
    if len(content) != chunk.size:
        raise DamagedError(f"it inflates to {len(content)} bytes where {chunk.size} are declared")
    return content


def find_messages(content: Bytes, index: list[Ints]) -> tuple[Messages, list[Definition]] | None:
    """The messages of a chunk at the places that its message indexes name; None if these are not exactly its messages.

    The index is a hint and nothing more: its places must be those of message records, and together with records of
    other kinds they must fill the chunk without gap or overlap.
    """
    if not index:
        return None
    starts = np.sort(np.concatenate(index))
    size = len(content)
    if not len(starts) or starts[0] < 0 or starts[-1] > size - MESSAGE_HEAD.size:
        return None
    messages = _at(content, starts)
    if not (content[starts] == MESSAGE).all() or messages.lengths.min() < MESSAGE_HEAD.size - RECORD.size:
        return None
    begins = np.concatenate(([0], starts + RECORD.size + messages.lengths))
    ends = np.concatenate((starts, [size]))
    definitions: list[Definition] = []
    for gap in np.flatnonzero(begins != ends).tolist():
        if begins[gap] > ends[gap]:
            return None
        found, end = _definitions(content[begins[gap] : ends[gap]].tobytes())
        if end != ends[gap] - begins[gap]:
            return None
        definitions += found
    return messages, definitions


def _definitions(content: bytes) -> tuple[list[Definition], int]:
    """Records other than messages, up to the first message or to what is no record; and where that begins."""
    found, position = [], 0
    while position + RECORD.size <= len(content):
        opcode, length = RECORD.unpack_from(content, position)
        end = position + RECORD.size + length
        if opcode == MESSAGE or opcode == 0 or end > len(content):
            break
        found.append(Definition(opcode, content[position + RECORD.size : end]))
        position = end
    return found, position


def walk_messages(content: bytes) -> tuple[Messages, list[Definition], int]:
    """As `find_messages` without an index: from record to record; and where the last whole record ends."""
    starts: list[int] = []
    definitions: list[Definition] = []
    position, end, unpack = 0, len(content), RECORD.unpack_from
    while position + RECORD.size <= end:
        opcode, length = unpack(content, position)
        after = position + RECORD.size + length
        if after > end or opcode == 0 or (opcode == MESSAGE and length < MESSAGE_HEAD.size - RECORD.size):
            break
        if opcode == MESSAGE:
            starts.append(position)
        else:
            definitions.append(Definition(opcode, content[position + RECORD.size : after]))
        position = after
    return _at(np.frombuffer(content, np.uint8), np.array(starts, np.int64)), definitions, position


def _at(content: Bytes, starts: Ints) -> Messages:
    lengths = numbers_at(content, starts + 1, "<i8")
    return Messages(starts, lengths, numbers_at(content, starts + RECORD.size, "<u2"))


def numbers_at(content: Bytes, starts: Ints, code: str) -> NDArray[Any]:
    """Numbers of numpy type `code` at any places of a buffer, shape of `starts`."""
    if not len(starts):
        return np.empty(0, code)
    windows: NDArray[Any] = np.ndarray((len(content) - np.dtype(code).itemsize + 1,), code, content, strides=(1,))
    return windows[starts]


def parse_index(content: bytes) -> Ints:
    """Places in its chunk that a MessageIndex record names. Raises DamagedError."""
    cursor = Cursor(content)
    cursor.take(2)
    entries = cursor.block()
    cursor.end()
    if len(entries) % 16:
        raise DamagedError("a message index whose entries have no whole length")
    return np.frombuffer(entries, "<i8")[1::2]


def by_channel(messages: Messages) -> Iterator[tuple[int, Messages]]:
    """The messages of each channel."""
    for channel in np.unique(messages.channels).tolist():
        mine = np.flatnonzero(messages.channels == channel)
        yield channel, Messages(messages.starts[mine], messages.lengths[mine], messages.channels[mine])
