"""CDR messages of one type -> where each value lies, so that numpy can gather thousands of them at once.

Theory of operation. In CDR the place of a member depends on the lengths of the strings and sequences before it and on
nothing else. So one message of a type is walked member by member (`trace`); that gives its layout: the offsets of
all values, and as guards the offsets and values of all length words on the way. Every other message of the same size
in which the guards hold has exactly the same layout, which is tested for all of them in a few numpy calls. Messages in
which they do not hold are traced in their turn. A topic has as many layouts as there are combinations of lengths in
it: one for poses in frame `map`, two for slots that are `delivered` or `lost`.

Source: OMG DDS-RTPS 2.5, 10.2 (encapsulation, padding to 4 bytes at the end); CORBA 3.4 part 2, 9.3 (CDR, aligned from
the end of the encapsulation header).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags.bag_errors import UndecodableError
from agv_analysis.bags.schema import STRING, WSTRING, Member, Struct, is_wstring

LEAD = 16
"""Bytes before a message: log time and publish time [ns], little-endian, as in MCAP's message records."""

BODY = LEAD + 4
"""Where the first member begins, after the encapsulation header of 4 bytes."""

_END_PADDING = 3

_RESERVED_CHARACTER = 4
"""Bytes that rmw_serialize reserves for each character of a wstring, and for a final zero that it does not write."""

LOG_TIME, PUBLISH_TIME = "log_time_ns", "publish_time_ns"

Index = tuple[int, ...]


@dataclass
class Leaf:
    """All values that go to one column: same path, same code."""

    path: str
    code: str
    """numpy's code with byte order, as it lies on the wire; S<n> for a string of n bytes."""
    block: int | None
    """Values side by side that belong to the last dimension of the column, None for a single value."""
    offsets: list[int] = field(default_factory=list)
    """Where the values, or blocks, begin, counted from the lead's first byte."""
    indices: list[Index] = field(default_factory=list)
    """Their places in the column, one index for each array around them."""
    is_text: bool = False
    """Are the values of a block the characters of one string, UTF-16 or UTF-32?"""


@dataclass
class Layout:
    """Where the values of a message lie; all offsets count from the first byte of its lead."""

    head: int
    """Encapsulation: the first two bytes after the lead, as a little-endian number."""
    order: str
    """Byte order that it stands for, "<" or ">"."""
    guards: NDArray[np.int64]
    """Offsets of the length words, shape (G,)."""
    lengths: NDArray[np.uint32]
    """What is in them, shape (G,)."""
    leaves: tuple[Leaf, ...]
    """In the order of the wire."""
    counts: dict[str, dict[Index, int]]
    """Lengths of the sequences, by path and place."""

    @property
    def key(self) -> bytes:
        """Equal for equal layouts of messages of one type."""
        return self.order.encode() + self.guards.tobytes() + self.lengths.tobytes()


def length_path(path: str) -> str:
    """Column that holds the lengths of the sequence `path`."""
    return f"len({path})"


def trace(kind: Struct, message: bytes) -> Layout:
    """Layout of one message: its lead, the encapsulation header, its members.

    Raises UndecodableError if the bytes cannot be a message of this type.
    """
    size = len(message) - LEAD
    if size < BODY - LEAD:
        raise UndecodableError(f"{size} bytes are too few for a CDR message")
    if message[LEAD] != 0 or message[LEAD + 1] > 1:
        head = message[LEAD : LEAD + 2].hex()
        raise UndecodableError(f"its encapsulation is {head}; only plain CDR, 0000 and 0001, is read")
    walk = _Trace(message)
    walk.struct(kind, "", ())
    rest = len(message) - BODY - walk.position
    if not (rest <= _END_PADDING or 0 <= walk.position + rest - walk.reserved <= _END_PADDING):
        raise UndecodableError(f"{rest} of its {size} bytes are left over after the last member")
    return Layout(
        message[LEAD] | message[LEAD + 1] << 8, walk.order, np.array(walk.guards, np.int64),
        np.array(walk.lengths, np.uint32), tuple(walk.leaves.values()), walk.counts,
    )  # fmt: skip


class _Trace:
    """The walk through one message; `position` counts from the end of the encapsulation header.

    `reserved` counts what rmw_serialize of rmw_fastrtps reserves before it writes: it aligns empty sequences, too. A
    message that a node serialised for a bag itself, as with rosbag2's writers in C++ and Python, has that length.
    """

    def __init__(self, message: bytes) -> None:
        self._message = message
        self._end = len(message) - BODY
        self.order = "<" if message[LEAD + 1] else ">"
        self.position = 0
        self.reserved = 0
        self.guards: list[int] = []
        self.lengths: list[int] = []
        self.leaves: dict[tuple[str, str, int | None], Leaf] = {}
        self.counts: dict[str, dict[Index, int]] = {}
        self._add(LOG_TIME, "<i8", None, (), 0)
        self._add(PUBLISH_TIME, "<i8", None, (), 8)

    def struct(self, kind: Struct, prefix: str, index: Index) -> None:
        """Walk through the members of a struct, those of an array's elements at `index`."""
        for member in kind.members:
            path = prefix + member.path
            count = self._length(member, path, index)
            if member.element == STRING:
                self._strings(path, count, index)
            elif isinstance(member.element, Struct):
                self._structs(member.element, f"{path}.", count or 0, index)
            elif is_wstring(member.element):
                self._wide_strings(path, int(member.element.removeprefix(WSTRING)), count, index)
            else:
                self._numbers(path, member.element, count, index)

    def _length(self, member: Member, path: str, index: Index) -> int | None:
        """Elements of an array, None for a single value."""
        if not member.is_sequence:
            return member.length
        count = self._word(path)
        if member.length is not None and count > member.length:
            raise UndecodableError(f"{path} has {count} elements, at most {member.length} are allowed")
        self.counts.setdefault(path, {})[index] = count
        return count

    def _word(self, path: str) -> int:
        """A length word; it can never exceed the bytes that follow it."""
        offset = self._take(path, 4, 4)
        (value,) = struct.unpack_from(self.order + "I", self._message, offset)
        self.guards.append(offset)
        self.lengths.append(value)
        if value > self._end - self.position:
            raise UndecodableError(f"{path} is {value} long, {self._end - self.position} bytes are left")
        return int(value)

    def _take(self, path: str, alignment: int, size: int) -> int:
        """Offset of the next `size` bytes."""
        begin = self.position + -self.position % alignment
        if begin + size > self._end:
            raise UndecodableError(f"it ends after {len(self._message) - LEAD} bytes, before the end of {path}")
        self.position = begin + size
        self.reserved += -self.reserved % alignment + size
        return BODY + begin

    def _add(self, path: str, code: str, block: int | None, index: Index, offset: int, is_text: bool = False) -> None:
        leaf = self.leaves.get((path, code, block))
        if leaf is None:
            leaf = self.leaves[path, code, block] = Leaf(path, code, block, is_text=is_text)
        leaf.offsets.append(offset)
        leaf.indices.append(index)

    def _numbers(self, path: str, code: str, count: int | None, index: Index) -> None:
        size = 1 if code == "?" else int(code[1])
        if count == 0:
            self.reserved += -self.reserved % size
            return
        offset = self._take(path, size, size * (1 if count is None else count))
        self._add(path, ("u1" if code == "?" else self.order + code), count, index, offset)

    def _strings(self, path: str, count: int | None, index: Index) -> None:
        for place in [index] if count is None else ((*index, i) for i in range(count)):
            length = self._word(path)
            word = BODY + self.position - 4
            begin = self._take(path, 1, length)
            if length <= 1:  # of its final zero, if it has one: the length word has zeros that are known to be
                self._add(path, "S1", None, place, word + (self.order == "<"))
            else:
                self._add(path, f"S{length - 1}", None, place, begin)

    def _wide_strings(self, path: str, width: int, count: int | None, index: Index) -> None:
        """As Fast CDR writes them: the number of characters, these, no final zero."""
        for place in [index] if count is None else ((*index, i) for i in range(count)):
            length = self._word(path)
            if length:
                begin = self._take(path, width, width * length)
                self._add(path, f"{self.order}u{width}", length, place, begin, is_text=True)
            else:
                self._add(path, "S1", None, place, BODY + self.position - 4)
            self.reserved += _RESERVED_CHARACTER * (length + 1) - width * length

    def _structs(self, kind: Struct, prefix: str, count: int, index: Index) -> None:
        if count > self._end - self.position:
            raise UndecodableError(f"it ends after {len(self._message) - LEAD} bytes, before the end of {prefix[:-1]}")
        for i in range(count):
            self.struct(kind, prefix, (*index, i))
