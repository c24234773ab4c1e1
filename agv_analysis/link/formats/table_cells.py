"""Cells of a table: numbers, with a point or a comma, dates, yes and no; all of a column of a block at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.formats.rows import floats_at
from agv_analysis.link.formats.text_columns import Bytes, Places, cells, numbers_at
from agv_analysis.run import Floats

Flags = NDArray[np.bool_]

_TRUE = (b"1", b"true", b"yes", b"y", b"t")
_FALSE = (b"0", b"false", b"no", b"n", b"f")
_IS_LOST = {b"lost": True, b"dropped": True, b"timeout": True, b"delivered": False, b"received": False, b"ok": False}

_DAY = 86400.0
_DATE = np.frombuffer(b"dddd-dd-ddTdd:dd:", dtype=np.uint8)
"""The beginning of a date, `d` being a digit; a blank stands for the T as well."""


def trimmed(text: Bytes, begins: Places, ends: Places) -> tuple[Places, Places]:
    """Without one blank or quotation mark at the front, and one blank, quotation mark or carriage return at the end."""
    marks = np.frombuffer(b" \"'\r", dtype=np.uint8)
    for _ in range(2):
        begins = begins + ((begins < ends) & np.isin(text[np.minimum(begins, len(text) - 1)], marks))
        ends = ends - ((begins < ends) & np.isin(text[np.maximum(ends - 1, 0)], marks))
    return begins, ends


def flags_at(text: Bytes, begins: Places, ends: Places, commas: bool = False, origin: int = 0) -> tuple[Floats, Flags]:
    """As `floats_at`; words that mean yes or lost become 1, words that mean no or received 0."""
    letters = text[np.minimum(begins, len(text) - 1)]
    is_word = ((letters >= ord("A")) & (begins < ends)) & ~np.isin(letters, np.frombuffer(b"nN", dtype=np.uint8))
    is_word |= np.isin(letters, np.frombuffer(b"nN", dtype=np.uint8)) & (ends - begins <= 2)  # n, no
    values, good = np.full(len(begins), np.nan), np.zeros(len(begins), dtype=np.bool_)
    values[~is_word], good[~is_word] = floats_at(text, begins[~is_word], ends[~is_word], commas, origin)
    at = np.flatnonzero(is_word)
    if len(at):
        words = np.char.lower(cells(text, begins[at], ends[at]))
        for word, value in ((_TRUE, 1.0), (_FALSE, 0.0)):
            hit = at[np.isin(words, word)]
            values[hit], good[hit] = value, True
        for name, lost in _IS_LOST.items():
            hit = at[words == name]
            values[hit], good[hit] = float(lost), True
    return values, good


def is_date(text: Bytes, begins: Places, ends: Places) -> Flags:
    """Which cells begin as a date with a time does?"""
    found = ends - begins > len(_DATE)
    for i, letter in enumerate(_DATE.tolist()):
        seen = text[np.minimum(begins + i, len(text) - 1)]
        if letter == ord("d"):
            found &= (seen >= ord("0")) & (seen <= ord("9"))
        else:
            found &= (seen == letter) | ((letter == ord("T")) & ((seen == ord(" ")) | (seen == ord("t"))))
    return np.asarray(found)


def dates_at(text: Bytes, begins: Places, ends: Places, commas: bool = False, origin: int = 0) -> tuple[Floats, Flags]:
    """Dates of ISO 8601 with a time, as 2024-05-01T12:00:00.25+02:00, and which are some.

    In seconds since `origin`, which is in seconds since 1970. Without a zone they are taken as they stand: only their
    differences matter.
    """
    good = is_date(text, begins, ends)
    values = np.full(len(begins), np.nan)
    at = begins[good]
    if not len(at):
        return values, good

    def number(offset: int, digits: int) -> Places:
        found = np.zeros(len(at), dtype=np.int64)
        for i in range(offset, offset + digits):
            found = found * 10 + (text[at + i] - ord("0"))
        return found

    year, month, day = number(0, 4), number(5, 2), number(8, 2)
    is_real = (month >= 1) & (month <= 12) & (day >= 1) & (day <= 31) & (year >= 1)
    stated, inverse = np.unique((year * 12 + np.maximum(month, 1) - 1), return_inverse=True)
    days = (stated - 1970 * 12).astype("datetime64[M]").astype("datetime64[D]").astype(np.int64)[inverse] + day - 1
    seconds = numbers_at(text, at + len(_DATE), commas)
    behind = at + len(_DATE) + seconds.length
    zone, whole = _zones(text, behind, ends[good])
    is_real &= whole & (seconds.length >= 2)
    minutes = days * _DAY + number(11, 2) * 3600.0 + number(14, 2) * 60.0 - zone - origin
    found = minutes + seconds.values  # whole numbers first, which are exact
    values[good] = np.where(is_real, found, np.nan)
    good[good] = is_real
    return values, good


def _zones(text: Bytes, begins: Places, ends: Places) -> tuple[Floats, Flags]:
    """Offsets [s] of time zones, +hh:mm, +hhmm, +hh, Z or nothing, and which are so."""
    last = len(text) - 1
    sign, length = text[np.minimum(begins, last)], ends - begins
    hours = numbers_at(text, np.minimum(begins + 1, last))
    has_colon = text[np.minimum(begins + 3, last)] == ord(":")
    minutes = np.where(
        has_colon, numbers_at(text, np.minimum(begins + 4, last)).integers,
        np.where(length == 5, hours.integers % 100, 0),
    )  # fmt: skip
    hour = np.where(length == 5, hours.integers // 100, hours.integers)
    is_offset = ((sign == ord("+")) | (sign == ord("-"))) & np.isin(length, (3, 5, 6)) & (hours.length >= 2)
    is_utc = (length == 1) & ((sign == ord("Z")) | (sign == ord("z")))
    offset = np.where(sign == ord("-"), -1.0, 1.0) * (3600.0 * hour + 60.0 * minutes)
    return np.where(is_offset, offset, 0.0), is_offset | is_utc | (length == 0)
