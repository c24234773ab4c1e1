"""Numbers out of large text files, a block of lines at a time, without a loop over lines.

A block is an array of bytes. Records are found by their punctuation, and all numbers that stand at the same place of
their records are read together, digit by digit.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.measurement import MeasurementError
from agv_analysis.run import Floats

Bytes = NDArray[np.uint8]
Places = NDArray[np.int64]

Progress = Callable[[float], None]
"""Called with the share of the file that is read, 0 to 1."""

_BLOCK = 1 << 20
"""Bytes of a block: its columns fit the processor's cache."""

_GZIP = b"\x1f\x8b"

_DIGITS = 24
"""Most characters of a number."""

_POWERS = 10.0 ** np.arange(_DIGITS + 1)

_WHOLE_POWERS = 10 ** np.arange(19, dtype=np.int64)
"""Those that an integer of 64 bits holds."""

_POINT, _COMMA = (np.uint8((ord(mark) - ord("0")) % 256) for mark in ".,")
"""Decimal marks, counted from the digit 0 on."""


class Block(NamedTuple):
    """Whole lines of a file."""

    text: Bytes
    """Shape (n,); ends with a line feed."""
    starts: Places
    """Where each line begins, shape (lines,)."""
    number: int
    """Of its first line in the file, from 1 on."""

    def line(self, i: int) -> bytes:
        """Line i of the block, without its end."""
        end = self.starts[i + 1] if i + 1 < len(self.starts) else len(self.text)
        return self.text[self.starts[i] : end].tobytes().rstrip(b"\r\n")

    def line_of(self, places: Places) -> Places:
        """The lines that places in the text are on."""
        return np.searchsorted(self.starts, places, side="right") - 1


def open_binary(path: Path) -> BinaryIO:
    """A file to read from, unpacked if it is packed by gzip. Raises MeasurementError."""
    try:
        file = open(path, "rb")  # noqa: SIM115  # the caller closes it
        packed = file.read(2) == _GZIP
        file.seek(0)
    except OSError as error:
        raise MeasurementError(f"{path}: cannot be read: {error.strerror}") from None
    return cast(BinaryIO, gzip.open(file)) if packed else file


def head_of(path: Path, size: int = 65536) -> bytes:
    """The beginning of a file, unpacked. Raises MeasurementError."""
    with open_binary(path) as file:
        try:
            return file.read(size)
        except (OSError, EOFError) as error:
            raise MeasurementError(f"{path}: cannot be unpacked: {error}") from None


def chunks(path: Path, progress: Progress | None = None, size: int = _BLOCK) -> Iterator[bytes]:
    """A file in pieces, unpacked. Raises MeasurementError."""
    total = max(1, path.stat().st_size)
    done = 0
    with open_binary(path) as file:
        while True:
            try:
                chunk = file.read(size)
            except (OSError, EOFError) as error:
                raise MeasurementError(f"{path}: cannot be unpacked: {error}") from None
            if not chunk:
                return
            yield chunk
            done += len(chunk)
            if progress is not None:
                progress(min(1.0, done / total))


def blocks(path: Path, progress: Progress | None = None) -> Iterator[Block]:
    """The lines of a file. Raises MeasurementError."""
    rest, number = b"", 1
    for chunk in chunks(path, progress):
        chunk = rest + chunk
        end = chunk.rfind(b"\n") + 1
        if end:
            block = block_of(chunk[:end], number)
            number += len(block.starts)
            yield block
        rest = chunk[end:]
    if rest:
        yield block_of(rest + b"\n", number)


def block_of(text: bytes, number: int = 1) -> Block:
    """A block from lines of text, the last of which ends with a line feed."""
    array = np.frombuffer(text, dtype=np.uint8)
    ends = np.flatnonzero(array == ord("\n"))
    return Block(array, np.concatenate(([0], ends[:-1] + 1)), number)


def is_preceded_by(text: Bytes, places: Places, word: bytes) -> NDArray[np.bool_]:
    """Does `word` stand right before each of these places?"""
    found = places >= len(word)
    for i, letter in enumerate(reversed(word), start=1):
        found &= text[np.maximum(places - i, 0)] == letter
    return np.asarray(found)


class Numbers(NamedTuple):
    """Unsigned decimal numbers, as digits and where the point is."""

    digits: NDArray[np.uint64]
    decimals: NDArray[np.int64]
    """Digits behind the point."""
    length: Places
    """Characters of each; 0: there is no number."""

    @property
    def values(self) -> Floats:
        """As floats, NaN where there is no number: exact up to 15 digits."""
        found = self.digits.astype(np.float64)
        found /= _POWERS[self.decimals]
        found[self.length == 0] = np.nan
        return found

    def beyond(self, origin: int) -> Floats:
        """By how much they are more than a whole number, NaN where there is no number: exact up to 19 digits.

        A float of seconds since 1970 is only exact to 0.2 us.
        """
        if not origin:
            return self.values
        shifted = origin * _WHOLE_POWERS[np.minimum(self.decimals, len(_WHOLE_POWERS) - 1)]
        found = (self.digits.astype(np.int64) - shifted).astype(np.float64)  # what is more than 64 bits cancels out
        found /= _POWERS[self.decimals]
        is_long = self.decimals >= len(_WHOLE_POWERS)
        found[is_long] = self.values[is_long] - origin
        found[self.length == 0] = np.nan
        return found

    @property
    def integers(self) -> NDArray[np.int64]:
        """As whole numbers."""
        return self.digits.astype(np.int64)

    def taken(self, rows: Places) -> Numbers:
        """Some of them."""
        return Numbers(self.digits[rows], self.decimals[rows], self.length[rows])


def numbers_at(text: Bytes, places: Places, commas: bool = False) -> Numbers:
    """The unsigned decimal numbers that begin at these places, shape (n,); `commas`: a comma is a decimal mark, too."""
    count = len(places)
    digits = np.zeros(count, dtype=np.uint64)
    point, length = np.full(count, -1), np.full(count, _DIGITS)
    rows, at, value, marked = np.arange(count), places.copy(), digits.copy(), point.copy()  # of those that go on
    for i in range(_DIGITS):
        letter = text.take(at, mode="clip") - np.uint8(ord("0"))  # others wrap around
        at += 1
        is_digit = letter < 10
        if is_digit.all():
            value *= np.uint64(10)
            value += letter
            continue
        is_point = letter == _POINT
        if commas:
            is_point |= letter == _COMMA
        is_point &= marked < 0
        marked[is_point] = i
        goes_on = is_digit | is_point
        if not goes_on.all():
            ended = ~goes_on
            done = rows[ended]
            digits[done], point[done], length[done] = value[ended], marked[ended], i
            rows, at, value, marked = rows[goes_on], at[goes_on], value[goes_on], marked[goes_on]
            if not len(rows):
                break
            letter, is_digit = letter[goes_on], is_digit[goes_on]
        value = np.where(is_digit, value * np.uint64(10) + letter, value)
    digits[rows], point[rows] = value, marked
    return Numbers(digits, np.where(point < 0, 0, length - 1 - point), length)


def cells(text: Bytes, begins: Places, ends: Places, width: int = 40) -> NDArray[np.bytes_]:
    """What stands between these places, without blanks around it, cut at `width`, as an array of bytes."""
    longest = int(min(width, max(1, (ends - begins).max(initial=1))))
    columns = begins[:, None] + np.arange(longest)
    letters = np.where(columns < ends[:, None], text[np.minimum(columns, len(text) - 1)], 0).astype(np.uint8)
    found = np.ascontiguousarray(letters).view(f"S{longest}").ravel()
    return np.asarray(np.char.strip(found, b" \t\r\"'"))
