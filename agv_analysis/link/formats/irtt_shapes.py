"""Round trips in irtt's JSON that are written alike: all but their numbers is the same text, letter by letter.

irtt writes one member after the other with the same names, in the same order, with the same blanks. The text between
the numbers of a member is its shape. A member of a known shape is read by comparing that text and taking the numbers
from between. The first one of each shape is read by the JSON module, which says what each number is; a member without a
known shape is for the JSON module alone.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import compiled
from agv_analysis.link.formats.text_columns import Bytes
from agv_analysis.run import Floats

Trip = tuple[int, int, float, float, float, float, float]
"""Number, code of irtt's word, delays up, down and whole [ns], when it was sent [ns] by two clocks; NaN: not there.

The last clock counts from 1970 and is an integer where the file has one, since floats are only exact to 0.2 us there.
"""

_WORD = 1
"""Place of the word in a trip; the others are numbers of the member, or not there."""

_FIELDS = 6
"""Numbers of a trip."""

_MOST = 16
"""Shapes that are kept: irtt has a handful."""

_LONGEST = 1 << 14
"""Bytes of a member that may be the first of its shape."""

_DIGITS = 19
"""Digits of the largest number that an integer of 64 bits holds."""

_TOKEN = re.compile(rb'"(?:[^"\\]|\\.)*"|-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?')
"""A string or a number of JSON."""

_INTEGER = re.compile(rb"-?\d+")

_BLANKS = b" \t\r\n"


class Alike(NamedTuple):
    """Members that have known shapes, one after the other."""

    seq: NDArray[np.int64]
    """Shape (n,)."""
    word: NDArray[np.int8]
    times: Floats
    """The other numbers of a trip [ns], shape (n, 5)."""
    wall: NDArray[np.int64]
    """The last of them as integers, where they are there, shape (n,)."""
    end: int
    """Where the first byte is that belongs to none of them."""


class Shapes:
    """The shapes of the members of a file, learned as they come."""

    def __init__(self, trip_of: Callable[[Any], Trip | None]) -> None:
        """`trip_of`: what a member, decoded, says; None if it is not a round trip."""
        self._trip_of = trip_of
        self._known: list[_Shape] = []
        self._arrays: _Arrays | None = None

    def read(self, batch: bytes, begin: int = 0) -> Alike:
        """The members from a place of a text on, up to one whose shape is not known."""
        at = begin
        while at < len(batch) and batch[at] in _BLANKS + b",":
            at += 1
        if self._arrays is None:
            return _nothing(at)
        arrays = self._arrays
        rows = (len(batch) - at) // arrays.shortest + 1
        numbers, shape = np.zeros((rows, _FIELDS), dtype=np.int64), np.zeros(rows, dtype=np.int64)
        text = np.frombuffer(batch, dtype=np.uint8)
        count, at = compiled(_read_alike)(
            text, at, arrays.text, arrays.bounds, arrays.numbers, arrays.columns, numbers, shape
        )
        shape = shape[:count]
        times = numbers[:count, 1:].astype(np.float64)
        if not arrays.has.all():
            times[~arrays.has[shape]] = np.nan
        return Alike(numbers[:count, 0], arrays.words[shape], times, numbers[:count, -1], at)

    def learn(self, batch: bytes, at: int) -> bool:
        """Learn the shape of the member that begins at a place of a text; False if it has none, or is known."""
        member = _member(batch, at)
        found = None if member is None or len(self._known) == _MOST else self._shape(member)
        if found is None or found in self._known:
            return False
        self._known.append(found)
        self._arrays = _arrays(self._known)
        return True

    def _shape(self, member: bytes) -> _Shape | None:
        """The shape of a member whose numbers are all integers."""
        pieces: list[bytes] = []
        numbered: list[bytes] = []
        last = 0
        for token in _TOKEN.finditer(member):
            if token[0].startswith(b'"'):
                continue
            if not _INTEGER.fullmatch(token[0]):
                return None
            pieces.append(member[last : token.start()])
            numbered.append(pieces[-1] + str(len(numbered)).encode())
            last = token.end()
        pieces.append(member[last:])
        try:
            # Each number is its place among them, and so a trip says which of them it takes.
            trip = self._trip_of(json.loads(b"".join(numbered) + pieces[-1]))
        except (ValueError, RecursionError):
            return None
        if trip is None:
            return None
        taken = [value for i, value in enumerate(trip) if i != _WORD]
        columns = [taken.index(i) if i in taken else -1 for i in range(len(numbered))]
        return _Shape(tuple(pieces), tuple(columns), int(trip[_WORD]))


class _Shape(NamedTuple):
    pieces: tuple[bytes, ...]
    """The text before each number, and behind the last."""
    columns: tuple[int, ...]
    """Which number of a trip each of them is, without the word; -1: none."""
    word: int


class _Arrays(NamedTuple):
    """All shapes that are known, as a compiled function takes them."""

    text: Bytes
    """All pieces."""
    bounds: NDArray[np.int64]
    """Where each piece begins and, behind the last, ends, shape (shapes, most pieces + 1)."""
    numbers: NDArray[np.int64]
    """How many a member of each has, shape (shapes,)."""
    columns: NDArray[np.int64]
    """Shape (shapes, most numbers)."""
    words: NDArray[np.int8]
    """Shape (shapes,)."""
    has: NDArray[np.bool_]
    """Which times a trip of it has, shape (shapes, 5)."""
    shortest: int
    """Bytes of a member at least."""


def _arrays(known: list[_Shape]) -> _Arrays:
    most = max(len(shape.columns) for shape in known)
    bounds = np.zeros((len(known), most + 2), dtype=np.int64)
    columns = np.full((len(known), most), -1, dtype=np.int64)
    has = np.zeros((len(known), _FIELDS - 1), dtype=np.bool_)
    text = b""
    for i, shape in enumerate(known):
        for j, piece in enumerate(shape.pieces):
            bounds[i, j] = len(text)
            text += piece
            bounds[i, j + 1] = len(text)
        columns[i, : len(shape.columns)] = shape.columns
        has[i] = np.isin(np.arange(1, _FIELDS), shape.columns)
    numbers = np.array([len(shape.columns) for shape in known], dtype=np.int64)
    words = np.array([shape.word for shape in known], dtype=np.int8)
    shortest = min(sum(map(len, shape.pieces)) for shape in known)
    return _Arrays(np.frombuffer(text, dtype=np.uint8), bounds, numbers, columns, words, has, max(1, shortest))


def _nothing(at: int) -> Alike:
    none = np.zeros(0, dtype=np.int64)
    return Alike(none, none.astype(np.int8), np.zeros((0, _FIELDS - 1)), none, at)


def _member(batch: bytes, at: int) -> bytes | None:
    """The member that begins here; None if none does."""
    try:
        text = batch[at : at + _LONGEST].decode("ascii")
        _, end = json.JSONDecoder().raw_decode(text)
    except (ValueError, RecursionError):
        return None
    return text[:end].encode()


def _read_alike(
    text: Bytes, at: int, pieces: Bytes, bounds: NDArray[np.int64], counts: NDArray[np.int64],
    columns: NDArray[np.int64], numbers: NDArray[np.int64], shape: NDArray[np.int64],
) -> tuple[int, int]:  # fmt: skip
    """Read members from a place on, row by row; how many have known shapes, and where the first other one begins."""
    rows, last = 0, 0
    while at < len(text) and rows < len(shape):
        end = -1
        for i in range(len(counts)):
            tried = (last + i) % len(counts)
            end = read_member(text, at, pieces, bounds[tried], counts[tried], columns[tried], numbers[rows])
            if end >= 0:
                last = tried
                break
        if end < 0:
            break
        following = after_blanks(text, end)
        if following < len(text):
            if text[following] != 44:  # a comma
                break
            following = after_blanks(text, following + 1)
        shape[rows] = last
        rows += 1
        at = following
    return rows, at


def read_member(
    text: Bytes, at: int, pieces: Bytes, bounds: NDArray[np.int64], count: int, columns: NDArray[np.int64],
    found: NDArray[np.int64],
) -> int:  # fmt: skip
    """Read a member of a shape; where it ends, or -1 if it has another one."""
    for j in range(count + 1):
        piece = pieces[bounds[j] : bounds[j + 1]]
        if at + len(piece) > len(text):
            return -1
        there = text[at : at + len(piece)]
        different = 0
        for i in range(len(piece)):  # without an end in between, so that many are compared at once
            different |= there[i] ^ piece[i]
        if different != 0:
            return -1
        at += len(piece)
        if j == count:
            break
        negative = at < len(text) and text[at] == 45  # a minus
        if negative:
            at += 1
        begun, value = at, 0
        while at < len(text) and at - begun < _DIGITS and 48 <= text[at] <= 57:
            value = value * 10 + (np.int64(text[at]) - 48)
            at += 1
        # Nothing, a leading zero, which JSON has not, or more than 64 bits.
        if at == begun or (at - begun > 1 and text[begun] == 48) or value < 0:
            return -1
        if columns[j] >= 0:
            found[columns[j]] = -value if negative else value
    return at


def after_blanks(text: Bytes, at: int) -> int:
    """The first place from here on that is not a blank."""
    while at < len(text) and text[at] <= 32:
        at += 1
    return at
