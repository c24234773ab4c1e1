"""The rows of a table, a block of lines at a time: its columns as numbers, and the lines that are not rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.formats.format import Options
from agv_analysis.link.formats.rows import floats_at
from agv_analysis.link.formats.table_cells import dates_at, flags_at, is_date, trimmed
from agv_analysis.link.formats.table_header import (
    BLANKS,
    FLAGS,
    INSTANTS,
    ROLES,
    Header,
    TableColumn,
    columns_of,
    header_of,
    is_enough,
)
from agv_analysis.link.formats.text_columns import Block, Bytes, Places, head_of
from agv_analysis.link.measurement import Malformed, MeasurementError
from agv_analysis.run import Floats

Part = dict[str, NDArray[np.float64]]
"""Columns of a block by role, of the rows that were understood; NaN where a cell is empty."""

_LONG_AGO = 1e6
"""Times of more seconds than this count from about the first one: floats of seconds since 1970 are exact to 0.2 us."""

_BEFORE = 10
"""So many seconds before the first one, so that none becomes a 0 or 1, which may be yes or no."""

_DATES = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
"""From which number on since 1970 it is one of units [s] smaller than a second: 1e11 s are more than 3000 years."""


class TableRows:
    """Reads the rows of a table, block by block."""

    def __init__(self, path: Path, options: Options) -> None:
        self.header: Header = header_of(head_of(path), options.delimiter)
        self.columns = columns_of(self.header, options.columns, str(path))
        self.roles = {column.role for column in self.columns}
        self.malformed = Malformed()
        self.has_commas = False
        """Was a comma where it may be a decimal mark?"""
        self.impossible = 0
        """Cells with a time that no packet takes."""
        self._dated: dict[str, bool] = {}
        self._units: dict[str, float] = {}
        self._origin: int | None = None
        self._origins: dict[str, int] = {}
        if not is_enough(self.roles):
            raise MeasurementError(
                f"{path}: no column says which packets were lost; it has {', '.join(self.header.names)}: name one with "
                f"--column, as in --column lost=NAME; roles are {', '.join(ROLES)}"
            )

    def part(self, block: Block) -> Part:
        """The columns of a block's rows."""
        text, count = block.text, len(self.header.names)
        ends_of_cells = np.flatnonzero(self._separates(text) | (text == ord("\n")))
        lines = block.line_of(ends_of_cells)
        is_row = np.bincount(lines, minlength=len(block.starts)) == count
        is_row[: max(0, self.header.line + 1 - block.number)] = False
        is_row &= text[block.starts] != ord("#")
        rows = np.flatnonzero(is_row)
        ends = ends_of_cells[is_row[lines]].reshape(-1, count)
        begins = np.concatenate((block.starts[rows][:, None], ends[:, :-1] + 1), axis=1)
        if self.header.may_have_commas and not self.has_commas:
            self.has_commas = bool((text == ord(",")).any())
        good, found = np.ones(len(rows), dtype=np.bool_), {}
        for column in self.columns:
            cells = trimmed(text, begins[:, column.place], ends[:, column.place])
            found[column.role], fine = self._values(text, *cells, column)
            good &= fine
        is_row[rows[~good]] = False
        for i in np.flatnonzero(~is_row).tolist():
            line = block.line(i)
            if block.number + i > self.header.line and line.strip() and not line.startswith(b"#"):
                self.malformed.add(block.number + i, line)
        return {role: values[good] for role, values in found.items()}

    def _separates(self, text: Bytes) -> NDArray[np.bool_]:
        """Which characters are separators, and not between quotation marks?"""
        separator = self.header.separator
        found = _last_of_blanks(text) if separator == BLANKS else text == ord(separator)
        marks = text == ord('"')
        if marks.any():
            upto, ends = np.cumsum(marks), np.flatnonzero(text == ord("\n"))
            of_lines = np.diff(upto[ends], prepend=0)
            before = np.repeat(upto[ends] - of_lines, np.diff(ends, prepend=-1))  # marks on the lines above
            found = found & ((upto - before) % 2 == 0)
        return np.asarray(found)

    def _values(
        self, text: Bytes, begins: Places, ends: Places, column: TableColumn
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """The cells of a column as numbers, NaN for an empty one, and which of them are in order."""
        if column.role in INSTANTS:
            return self._instants(text, begins, ends, column)
        read = flags_at if column.role in FLAGS else floats_at
        values, good = read(text, begins, ends, self.header.may_have_commas)
        values *= column.unit
        is_none = np.isinf(values) | ((values < 0.0) & (column.role == "rtt"))
        self.impossible += int(np.count_nonzero(is_none))
        values[is_none] = np.nan
        return values, good

    def _instants(
        self, text: Bytes, begins: Places, ends: Places, column: TableColumn
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """As `_values`, of a column of times: in seconds since the origin, the same of all columns."""
        role, commas = column.role, self.header.may_have_commas
        if self._is_dated(text, begins, ends, role):
            if self._origin is None:
                self._begin_at(dates_at(text, begins, ends, commas)[0])
            values, good = dates_at(text, begins, ends, commas, self._origin or 0)
            return values, good | (begins == ends)
        read = flags_at if role in FLAGS else floats_at
        if role not in self._origins:
            self._scale(column, read(text, begins, ends, commas)[0])
        values, good = read(text, begins, ends, commas, self._origins.get(role, 0))
        values *= self._unit(column)
        return values, good & ~np.isinf(values)

    def _scale(self, column: TableColumn, values: Floats) -> None:
        """Take from the first number of a column of times its unit and, in that unit, the origin."""
        held = values[np.isfinite(values)][:1]
        if not len(held):
            return
        if column.unit == 1.0:
            self._units[column.role] = next((unit for least, unit in _DATES if held[0] >= least), 1.0)
        if column.role in FLAGS and held[0] in (0.0, 1.0):  # no time, but yes or no
            self._origins[column.role] = 0
            return
        unit = self._unit(column)
        if self._origin is None:
            self._begin_at(held * unit)
        self._origins[column.role] = (self._origin or 0) * round(1.0 / unit)

    def _begin_at(self, times: Floats) -> None:
        """Tell times from about the first one on [s], if they are dates or as long."""
        held = times[np.isfinite(times)][:1]
        if len(held):
            self._origin = int(held[0]) - _BEFORE if held[0] >= _LONG_AGO else 0

    def _unit(self, column: TableColumn) -> float:
        """What a number of a column is worth [s]: what its name says, else what makes a date of its first one."""
        return column.unit if column.unit != 1.0 else self._units.get(column.role, 1.0)

    def _is_dated(self, text: Bytes, begins: Places, ends: Places, role: str) -> bool:
        """Does the first cell of a column that holds something hold a date?"""
        if role not in self._dated:
            held = np.flatnonzero(begins < ends)[:1]
            if not len(held):
                return False
            self._dated[role] = bool(is_date(text, begins[held], ends[held])[0])
        return self._dated[role]

    @property
    def notes(self) -> list[str]:
        """What was assumed of how cells are written."""
        said = ["commas are taken for decimal marks"] if self.has_commas else []
        if self.impossible:
            said.append(f"{self.impossible} round trips below 0, or infinite times, count as none")
        for role, unit in self._units.items():
            if unit != 1.0:
                said.append(
                    f"{role} has no unit, and numbers that are dates in units of {unit:g} s: it is taken for that"
                )
        return said


def _last_of_blanks(text: Bytes) -> NDArray[np.bool_]:
    """The last one of blanks and tabulators that stand together, if they are within a line and not at its beginning."""
    is_blank = (text == ord(" ")) | (text == ord("\t"))
    first = is_blank & ~np.append(False, is_blank[:-1])
    last = is_blank & ~np.append(is_blank[1:], False)
    begins, ends = np.flatnonzero(first), np.flatnonzero(last)
    before, behind = text[np.maximum(begins - 1, 0)], text[np.minimum(ends + 1, len(text) - 1)]
    is_within = (begins > 0) & (before != ord("\n")) & (behind != ord("\n")) & (behind != ord("\r"))
    found = np.zeros(len(text), dtype=np.bool_)
    found[ends[is_within]] = True
    return found
