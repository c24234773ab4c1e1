"""Chunks: from a record in the file, sound or not, to the messages in it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from agv_analysis.bags.bag_errors import DamagedError
from agv_analysis.bags.checksum import crc32
from agv_analysis.bags.chunk_index import index_chunk
from agv_analysis.bags.compression import MAX_CHUNK, NAMES, compression_of, declared_size, inflate, inflate_start
from agv_analysis.bags.message_batch import Bytes, Ints, numbers_at
from agv_analysis.bags.records import MESSAGE, MESSAGE_HEAD, RECORD, Chunk, Index, Read, fields_end, is_known

_HEAD = 8 + 8 + 8 + 4
"""Bytes of a chunk record before the name of its compression."""


class Messages(NamedTuple):
    """Messages in a buffer, in the order in which they lie there."""

    starts: Ints
    """Where their records begin, shape (n,)."""
    lengths: Ints
    """Lengths of their records' contents, shape (n,)."""


class Definition(NamedTuple):
    """A record other than a message that lies among the messages."""

    opcode: int
    content: bytes


class Content(NamedTuple):
    """What is in a chunk."""

    messages: dict[int, Messages]
    """By channel."""
    definitions: list[Definition]
    lost: int
    """Bytes that are not a whole record."""


# -- from the record to its content -----------------------------------------------------------------------------------


def open_chunk(chunk: Chunk) -> bytes:
    """Content of a chunk, checked against its CRC where it has one.

    Where the CRC proves the content, it may have another compression or size than the record says. Raises DamagedError.
    """
    try:
        content = inflate(chunk.compression, chunk.content, chunk.size)
        if chunk.crc and crc32(content) != chunk.crc:
            raise DamagedError("its content does not match its CRC")
        if not chunk.crc and len(content) != chunk.size:
            raise DamagedError(f"it inflates to {len(content)} bytes where {chunk.size} are declared")
    except DamagedError:
        if not chunk.crc:
            raise
        compression = compression_of(chunk.content)
        size = declared_size(compression, chunk.content) if compression else len(chunk.content)
        content = inflate_start(compression, chunk.content, min(MAX_CHUNK, size or chunk.size))
        if crc32(content) != chunk.crc:
            raise
    return content


def largest_size(chunk: Chunk) -> int:
    """Most bytes that the chunk can inflate to, whichever of its declarations is true."""
    compression = compression_of(chunk.content)
    try:
        size = declared_size(compression, chunk.content) if compression else len(chunk.content)
    except DamagedError:
        size = None
    return min(MAX_CHUNK, max(chunk.size, size or 0))


def is_as_declared(chunk: Chunk, content: bytes) -> bool:
    """Does the record describe its content correctly?"""
    return chunk.size == len(content) and chunk.compression == compression_of(chunk.content)


def rescue_chunk(length: int, left: int, read: Read) -> tuple[Chunk, int] | None:
    """A chunk whose record's lengths contradict each other, and its true length; None if there is none.

    `length` is what the record says of its own length, `left` what the file holds from its content on, which `read`
    gives. A way to read the lengths counts if the CRC proves what comes out, or, where there is no CRC, if that fills
    the declared size and consists of whole records. The shortest is tried first: what is compressed knows its own end.
    """
    for head, begin, end in sorted(_readings(length, left, read), key=lambda reading: reading[2]):
        chunk = head._replace(content=read(begin, end - begin))
        try:
            inflated = open_chunk(chunk)
        except DamagedError:
            continue
        if chunk.crc or (inflated and not walk(inflated).lost):
            return chunk, end
    return None


def _readings(length: int, left: int, read: Read) -> Iterator[tuple[Chunk, int, int]]:
    """Ways to read a chunk's record without trusting one of its lengths: the chunk, where its content begins, ends."""
    fixed = read(0, _HEAD + 4)
    size, crc = int.from_bytes(fixed[16:24], "little"), int.from_bytes(fixed[24:28], "little")
    name_length = int.from_bytes(fixed[_HEAD:], "little")
    for name in NAMES:
        begin = _HEAD + 4 + len(name) + 8
        is_named = name != "" and read(_HEAD + 4, len(name)) == name.encode()
        if not (is_named or name_length == len(name)):
            continue
        inner = begin + int.from_bytes(read(begin - 8, 8), "little")
        for end in dict.fromkeys((inner, length)):
            if begin <= end <= min(left, MAX_CHUNK):
                yield Chunk(size, crc, name, b""), begin, end


def cut_chunk(length: int, left: int, read: Read) -> bytes | None:
    """What can be inflated of a chunk within which the file ends; None if this is no such chunk.

    The record's length and the one inside it must agree to go beyond the end: a flipped bit does not look like this.
    """
    fixed = read(0, _HEAD + 4)
    name_length = int.from_bytes(fixed[_HEAD:], "little")
    begin = _HEAD + 4 + name_length + 8
    if name_length > 4 or begin > left:
        return None
    name = read(_HEAD + 4, name_length).decode("latin-1")
    if name not in NAMES or begin + int.from_bytes(read(begin - 8, 8), "little") != length or length <= left:
        return None
    size = int.from_bytes(fixed[16:24], "little")
    try:
        return inflate_start(name, read(begin, MAX_CHUNK), min(size, MAX_CHUNK))
    except DamagedError:
        return b""


# -- from the content to its messages ---------------------------------------------------------------------------------


def sort_out(content: bytes, indexes: list[Index], is_large: bool) -> tuple[Content, bool]:
    """Messages of a chunk, and whether its message indexes name exactly these; `is_large`: compiled code pays."""
    if is_large and (found := index_chunk(content)) is not None:
        bounds = [0, *found.ends.tolist()]
        messages = {
            channel: Messages(found.starts[begin:end], found.lengths[begin:end])
            for channel, (begin, end) in enumerate(pairwise(bounds))
            if end > begin
        }
        return Content(messages, [], 0), _is_named(found.starts, indexes)
    content_by_index = find(content, [index.places for index in indexes])
    return content_by_index or walk(content), content_by_index is not None


def _is_named(starts: Ints, indexes: list[Index]) -> bool:
    """Do the message indexes name exactly these messages, which are given channel by channel?"""
    if sum(len(index.places) for index in indexes) != len(starts):
        return False
    places = np.concatenate([index.places for index in sorted(indexes, key=lambda index: index.channel)])
    return np.array_equal(places, starts) or np.array_equal(np.sort(places), np.sort(starts))


def find(content: bytes, places: list[Ints]) -> Content | None:
    """Messages of a chunk at the places that its message indexes name; None if these are not exactly its messages.

    The index is a hint and nothing more: its places must be those of message records, and together with records of
    other kinds they must fill the chunk without gap or overlap.
    """
    if not sum(map(len, places)):
        return None
    buffer = np.frombuffer(content, np.uint8)
    starts = np.sort(np.concatenate(places))
    if starts[0] < 0 or starts[-1] > len(content) - RECORD.size - MESSAGE_HEAD:
        return None
    messages = messages_at(buffer, starts)
    if not (buffer[starts] == MESSAGE).all() or messages.lengths.min() < MESSAGE_HEAD:
        return None
    begins = np.concatenate(([0], starts + RECORD.size + messages.lengths))
    ends = np.concatenate((starts, [len(content)]))
    definitions: list[Definition] = []
    for gap in np.flatnonzero(begins != ends).tolist():
        found = _definitions(content, int(begins[gap]), int(ends[gap]))
        if found is None:
            return None
        definitions += found
    return Content(by_channel(buffer, messages), definitions, 0)


def _definitions(content: bytes, position: int, end: int) -> list[Definition] | None:
    """Records from `position` to `end`; None if these are not a whole records, or if there is a message among them."""
    found = []
    while position + RECORD.size <= end:
        opcode, length = RECORD.unpack_from(content, position)
        if opcode == MESSAGE:
            break
        position += RECORD.size + length
        found.append(Definition(opcode, content[position - length : min(position, end)]))
    return found if position == end else None


def walk(content: bytes, is_cut: bool = False) -> Content:
    """Messages of a chunk without its index, from record to record; what is not a record is passed over.

    `is_cut`: the content ends anywhere, so that its last record need not be whole.
    """
    starts: list[int] = []
    definitions: list[Definition] = []
    position, lost = 0, 0
    while position < len(content):
        run, position = run_of_messages(content, position)
        starts += run
        if position == len(content):
            break
        definition = _definition(content, position, is_cut)
        if definition is not None:
            definitions.append(definition)
            position += RECORD.size + len(definition.content)
            continue
        suspect = run[-1] if run else None
        after = next_message(content, position if suspect is None else suspect)
        is_rest = is_cut and after == len(content)
        if suspect is not None and not is_rest and is_wrong_length(suspect, position, after):
            position = starts.pop()
        lost += after - position
        position = after
    buffer = np.frombuffer(content, np.uint8)
    return Content(by_channel(buffer, messages_at(buffer, np.array(starts, np.int64))), definitions, lost)


def run_of_messages(content: bytes, position: int) -> tuple[list[int], int]:
    """Where the messages from `position` on begin that follow each other without gap, and where the last one ends."""
    starts: list[int] = []
    end, unpack = len(content) - RECORD.size, RECORD.unpack_from
    while position <= end:
        opcode, length = unpack(content, position)
        after = position + RECORD.size + length
        if opcode != MESSAGE or length < MESSAGE_HEAD or after > len(content):
            break
        starts.append(position)
        position = after
    return starts, position


def _definition(content: bytes, position: int, is_cut: bool) -> Definition | None:
    """The record, other than a message, at `position`; None if there is no whole one.

    One of a kind that is not known, or with bytes after its last field, must be followed by another or by the end.
    """
    if position + RECORD.size > len(content):
        return None
    opcode, length = RECORD.unpack_from(content, position)
    begin = position + RECORD.size
    end = begin + length
    if opcode in (0, MESSAGE) or end > len(content):
        return None
    if is_known(opcode):
        fields = fields_end(opcode, length, lambda offset, count: content[begin + offset : begin + offset + count])
        if fields is None:
            return None
        if fields == length:
            return Definition(opcode, content[begin:end])
    return Definition(opcode, content[begin:end]) if _is_followed(content, end, is_cut) else None


def _is_followed(content: bytes, position: int, is_cut: bool) -> bool:
    """Is at `position` the end of a chunk, or what may be a record?"""
    if position == len(content):
        return True
    if position + RECORD.size > len(content):
        return is_cut
    opcode, length = RECORD.unpack_from(content, position)
    is_whole = position + RECORD.size + length <= len(content)
    return bool(opcode) and (is_whole or is_cut) and (opcode != MESSAGE or length >= MESSAGE_HEAD)


_MESSAGE_START = re.compile(rb"(?=\x05.{5}\x00{3})", re.DOTALL)


def next_message(content: bytes, position: int) -> int:
    """Where the next message after `position` begins that is followed by another or by the end; else the end."""
    for found in _MESSAGE_START.finditer(content, position + 1):
        if _is_message(content, found.start()):
            return found.start()
    return len(content)


def _is_message(content: bytes, position: int) -> bool:
    """Is there a whole message at `position` and behind it another one, or the end?"""
    for _ in range(2):
        if position == len(content):
            break
        if position + RECORD.size > len(content):
            return False
        opcode, length = RECORD.unpack_from(content, position)
        position += RECORD.size + length
        if opcode != MESSAGE or length < MESSAGE_HEAD or position > len(content):
            return False
    return True


def is_wrong_length(start: int, end: int, after: int) -> bool:
    """Is the message from `start` to `end`, behind which there is no record, probably longer or shorter than it says?

    `after` is where the next record was found: within the message, or at a place that one flipped bit of the message's
    length would lead to.
    """
    length = end - start - RECORD.size
    return after < end or bin(length ^ (after - start - RECORD.size)).count("1") == 1


def messages_at(buffer: Bytes, starts: Ints) -> Messages:
    """The messages whose records begin at `starts`."""
    return Messages(starts, numbers_at(buffer, starts + 1, "<i8") if len(starts) else starts)


def by_channel(buffer: Bytes, messages: Messages) -> dict[int, Messages]:
    """The messages of each channel."""
    if not len(messages.starts):
        return {}
    channels = numbers_at(buffer, messages.starts + RECORD.size, "<u2")
    order = np.argsort(channels, kind="stable")
    starts, lengths, channels = messages.starts[order], messages.lengths[order], channels[order]
    bounds = [0, *(np.flatnonzero(channels[1:] != channels[:-1]) + 1).tolist(), len(channels)]
    return {int(channels[begin]): Messages(starts[begin:end], lengths[begin:end]) for begin, end in pairwise(bounds)}
