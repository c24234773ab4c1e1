"""Lines of words: which lines have so many, and the numbers that they are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from agv_analysis.link.formats.text_columns import (
    Block,
    Bytes,
    Numbers,
    Places,
    Progress,
    blocks,
    cells,
    numbers_at,
)
from agv_analysis.link.measurement import Malformed
from agv_analysis.run import Floats


class Words(NamedTuple):
    """The words of the lines of a block that have as many as wanted."""

    lines: Places
    """Shape (n,)."""
    begins: Places
    """Shape (n, words)."""
    ends: Places


def words_of(block: Block, count: int) -> Words:
    """Lines with `count` words between blanks; an empty block has none."""
    blank = block.text <= ord(" ")  # blanks and ends of lines
    edges = np.diff(np.concatenate(([True], blank)).astype(np.int8))
    begins = np.flatnonzero(edges == -1)
    ends = np.flatnonzero(np.diff(np.concatenate((blank, [True])).astype(np.int8)) == 1) + 1
    of_line = block.line_of(begins)
    is_whole = np.bincount(of_line, minlength=len(block.starts)) == count
    kept = is_whole[of_line]
    return Words(np.flatnonzero(is_whole), begins[kept].reshape(-1, count), ends[kept].reshape(-1, count))


_MOST_DIGITS = 19
"""Digits that an unsigned integer of 64 bits holds, whatever they are."""

MOST_EXACT = 2.0**53
"""Whole numbers below this are exact as floats: others are not sequence numbers."""

_NOTHING = (b"", b"nan", b"na", b"n/a", b"null", b"none", b"-", b".", b"*", b"lost", b"timeout")
"""What stands for a number that is not there."""


def floats_at(
    text: Bytes, begins: Places, ends: Places, commas: bool = False, origin: int = 0
) -> tuple[Floats, np.ndarray[tuple[int], np.dtype[np.bool_]]]:
    """The numbers between these places, shape (n,), and whether each is one; NaN is, and so is nothing at all.

    `commas`: a comma is a decimal mark, too. `origin`: they are told by how much they are more than this.
    """
    negative = text[np.minimum(begins, len(text) - 1)] == ord("-")
    numbers = numbers_at(text, begins + negative, commas)
    is_sound = numbers.length - (numbers.decimals > 0) <= _MOST_DIGITS
    is_sound &= (numbers.digits > 0) | (text.take(begins + negative, mode="clip") == ord("0"))  # a point alone is none
    values, good = numbers.beyond(origin), is_sound & (numbers.length == ends - begins - negative)
    others = np.flatnonzero(~good)
    if len(others):
        rows = others[is_sound[others] & (numbers.length[others] > 0)]
        scaled, fine = _scaled(text, (begins + negative)[rows], ends[rows], numbers.taken(rows))
        values[rows[fine]], good[rows[fine]] = scaled[fine] - origin, True
        others = np.flatnonzero(~good)
    if negative.any():
        values[negative] = -(values[negative] + origin) - origin
    if len(others):
        words = cells(text, begins[others], ends[others])
        empty = np.isin(np.char.lower(words), _NOTHING)
        values[others[empty]], good[others[empty]] = np.nan, True
        for i, word in zip(others[~empty].tolist(), words[~empty].tolist(), strict=True):
            try:
                values[i], good[i] = float(word.replace(b",", b".") if commas else word) - origin, True
            except ValueError:
                values[i] = np.nan
    return values, good


def _scaled(
    text: Bytes, begins: Places, ends: Places, numbers: Numbers
) -> tuple[Floats, np.ndarray[tuple[int], np.dtype[np.bool_]]]:
    """Numbers behind which a power of ten stands, as in 2.5e-03, shape (n,), and which are so."""
    at = begins + numbers.length
    sign = text.take(at + 1, mode="clip")
    is_minus = sign == ord("-")
    first = at + 1 + (is_minus | (sign == ord("+")))
    power = numbers_at(text, first)
    good = (text.take(at, mode="clip") | 32 == ord("e")) & (power.length > 0) & (power.length <= 2)
    good &= (first + power.length == ends) & (text.take(ends - 1, mode="clip") != ord("."))
    shift = np.where(is_minus, -power.integers, power.integers) - numbers.decimals
    scale = 10.0 ** np.abs(np.where(good, shift, 0))
    digits = numbers.digits.astype(np.float64)
    return np.where(shift < 0, digits / scale, digits * scale), good


def lines_of_words(
    path: Path, count: int, malformed: Malformed, progress: Progress | None = None
) -> Iterator[tuple[Block, Words]]:
    """Block by block the lines with `count` words; others that are not empty are malformed."""
    for block in blocks(path, progress):
        words = words_of(block, count)
        is_other = np.ones(len(block.starts), dtype=np.bool_)
        is_other[words.lines] = False
        for i in np.flatnonzero(is_other).tolist():
            line = block.line(i)
            if line.strip():
                malformed.add(block.number + i, line)
        yield block, words


def parts_of_rows(
    path: Path, count: int, malformed: Malformed, progress: Progress | None = None, wanted: Sequence[int] | None = None
) -> Iterator[Floats]:
    """The `wanted` columns of a file of `count` numbers a line between blanks, all by default, in parts.

    Each of shape (n, wanted). Lines that have others are malformed.
    """
    columns = range(count) if wanted is None else wanted
    for block, words in lines_of_words(path, count, malformed, progress):
        table = np.empty((len(words.lines), len(columns)))
        good = np.ones(len(table), dtype=np.bool_)
        for place, column in enumerate(columns):
            table[:, place], fine = floats_at(block.text, words.begins[:, column], words.ends[:, column])
            good &= fine & ~np.isinf(table[:, place])
        for i in np.flatnonzero(~good).tolist():
            malformed.add(block.number + int(words.lines[i]), block.line(int(words.lines[i])))
        yield table[good]
