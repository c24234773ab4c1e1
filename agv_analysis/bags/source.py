"""The bytes of an MCAP file, and where in them the next record is when the last one does not say so."""

from __future__ import annotations

import os
import re
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from agv_analysis.bags.bag_errors import BagError, DamagedError
from agv_analysis.bags.compression import MAX_CHUNK
from agv_analysis.bags.records import (
    DATA_END,
    FOOTER,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    RECORD,
    SUMMARY_OFFSET,
    Index,
    fields_end,
    is_known,
)

_AHEAD = 2**18
"""Bytes that are read at least: a chunk with its message indexes, as a rule."""

_WINDOW = 2**22
_MAX_CANDIDATES = 200_000
"""Most places of a file at which a record is searched for; only a malicious file has more."""

_INDEX_HEAD = struct.Struct("<BQHI")
"""Opcode, length, channel and bytes of entries of a message index, the commonest record outside of chunks."""

_MOST_EXTRA = 1024
"""Bytes after its last field that a record may have when it is searched for."""

_OF_FIXED_LENGTH = (FOOTER, SUMMARY_OFFSET, DATA_END)

_RECORD_START = re.compile(rb"(?=[\x01-\x0f].{5}\x00{3})", re.DOTALL)
"""A known opcode, and a length below 2^40."""


class Record(NamedTuple):
    """A record as it lies in the file."""

    position: int
    opcode: int
    content: bytes
    extra: int = 0
    """How many of its bytes follow the last field that is known here."""

    @property
    def end(self) -> int:
        """Where the next record should begin."""
        return self.position + RECORD.size + len(self.content)


class Source:
    """An MCAP file that is open for reading.

    It is read, not mapped: a bad sector, or a file that shrinks, is an error then and not the end of the process.
    """

    def __init__(self, path: Path) -> None:
        """Open the file. Raises BagError if it cannot be read."""
        self.path = path
        self._candidates = 0
        self._ahead = b""
        self._ahead_at = 0
        try:
            self._file = path.open("rb", buffering=0)
            self.size = path.stat().st_size
        except OSError as error:
            raise BagError(f"{path}: cannot be read: {error.strerror}") from None

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self, position: int, count: int) -> bytes:
        """Up to `count` bytes from `position` on, fewer at the end of the file. Raises BagError."""
        begin = position - self._ahead_at
        if begin < 0 or begin + count > len(self._ahead):
            self._ahead, self._ahead_at, begin = self._fetch(position, max(count, _AHEAD)), position, 0
        return self._ahead[begin : begin + count]

    def _fetch(self, position: int, count: int) -> bytes:
        left, parts = max(0, min(count, self.size - position)), []
        try:
            while left and (part := os.pread(self._file.fileno(), left, position)):
                parts.append(part)
                position += len(part)
                left -= len(part)
        except OSError as error:
            raise BagError(f"{self.path}: cannot be read at byte {position}: {error.strerror}") from None
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def head(self, position: int) -> tuple[int, int]:
        """Opcode and length of the record at `position`. Raises DamagedError if the file does not hold all of it."""
        head = self.read(position, RECORD.size)
        if len(head) < RECORD.size:
            raise DamagedError(f"{len(head)} bytes, too few for a record")
        opcode, length = RECORD.unpack(head)
        left = self.size - position - RECORD.size
        if length > left:
            raise DamagedError(f"a record of {length} bytes where {left} are left")
        return opcode, length

    def record(self, position: int) -> Record:
        """The record at `position`. Raises DamagedError if there is none whose inner lengths fit."""
        opcode, length = self.head(position)
        if opcode == 0:
            raise DamagedError("a record of kind 0, which there is not")
        if length > MAX_CHUNK + _WINDOW:
            raise DamagedError(f"a record of {length} bytes, too long to be read")
        begin = position + RECORD.size
        content = self.read(begin, length)
        if is_known(opcode):
            end = fields_end(opcode, length, lambda at, count: content[at : at + count])
            if end is None or (end < length and not self._is_extended(begin + end, begin + length)):
                raise DamagedError("a record whose lengths contradict each other")
            return Record(position, opcode, content, length - end)
        return Record(position, opcode, content)

    def index(self, position: int) -> tuple[Index, int] | None:
        """The message index at `position`, and where it ends; None if there is anything else, or a damaged one."""
        head = self.read(position, _INDEX_HEAD.size)
        if len(head) < _INDEX_HEAD.size:
            return None
        opcode, length, channel, size = _INDEX_HEAD.unpack(head)
        begin = position + _INDEX_HEAD.size
        if opcode != MESSAGE_INDEX or length != 6 + size or size % 16 or begin + size > self.size:
            return None
        return Index(channel, np.frombuffer(self.read(begin, size), "<i8")[1::2]), begin + size

    def is_record(self, position: int, depth: int = 3, is_search: bool = True) -> bool:
        """Is there a record of a known kind at `position`? A message must be followed by another one, or by the end.

        `is_search`: nothing says that a record should be there, so that one with many bytes after its last field, or of
        a kind without fields of variable length, does not count.
        """
        try:
            opcode, length = self.head(position)
        except DamagedError:
            return False
        begin = position + RECORD.size
        if not is_known(opcode):
            return False
        end = fields_end(opcode, length, lambda at, count: self.read(begin + at, count))
        if end is None:
            return False
        if is_search and end < length and (length - end > _MOST_EXTRA or opcode in _OF_FIXED_LENGTH):
            return False
        if depth == 0 or (end == length and opcode != MESSAGE):
            return True
        if opcode == MESSAGE:
            return self.is_followed(begin + length, depth - 1)
        return self._is_extended(begin + end, begin + length, depth - 1)

    def is_followed(self, position: int, depth: int = 3) -> bool:
        """Is at `position` what may follow a record: the end, or another one, of a kind that is not known, too?"""
        if self.is_end(position) or self.is_record(position, depth, is_search=False):
            return True
        try:
            opcode, length = self.head(position)
        except DamagedError:
            return False
        is_new = opcode != 0 and not is_known(opcode)
        return is_new and (depth == 0 or self.is_followed(position + RECORD.size + length, depth - 1))

    def _is_extended(self, fields_end: int, end: int, depth: int = 3) -> bool:
        """Is what lies between a record's last field and its end something that a newer version has added?

        Another record must follow; what lies there must not be records that a wrong length has swallowed.
        """
        if not self.is_followed(end, depth):
            return False
        while fields_end < end and self.is_record(fields_end, depth=0):
            fields_end += RECORD.size + self.head(fields_end)[1]
        return fields_end != end

    def is_end(self, position: int) -> bool:
        """Is this the end of the file's records?"""
        return position == self.size or (position == self.size - len(MAGIC) and self.read(position, 8) == MAGIC)

    @property
    def has_given_up(self) -> bool:
        """Has the search for records ended before the file did?"""
        return self._candidates > _MAX_CANDIDATES

    def next_record(self, position: int) -> int | None:
        """Where the next record after `position` begins, None if there is none to be found."""
        position += 1
        while position < self.size:
            window = self.read(position, _WINDOW)
            for found in _RECORD_START.finditer(window):
                self._candidates += 1
                if self.has_given_up:
                    return None
                if self.is_record(position + found.start()):
                    return position + found.start()
            if len(window) < _WINDOW:
                break
            position += _WINDOW - RECORD.size + 1
        return None
