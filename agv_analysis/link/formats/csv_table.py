"""A table with a header: a trace of ours, an export of tshark, or any CSV with columns called as below.

    time                 when a packet was sent [s], or a date of ISO 8601 with a time
    seq                  its number; a number that no row has was lost
    sent, received       when it was sent and when it arrived; lost where `received` is empty
    lost, received       0/1, true/false, yes/no, or a word: lost, delivered, received, ok
    delay, rtt           one way, there and back again [s]; lost where both are empty and nothing else says it
    uplink_lost, downlink_lost, uplink_delay, downlink_delay       the same of each direction; lost is nan where nothing
                         was sent this way, since what it would have answered was lost

A name may end with its unit, as in `rtt_ms` or `RTT [ms]`; tshark's own names are known, and options name any others.
The separator is a comma, a semicolon, a tabulator or a bar, whichever splits the header into most names; where it is no
comma, a comma is a decimal mark. Lines that begin with # are comments.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.rows import floats_at
from agv_analysis.link.formats.table_cells import dates_at, flags_at, is_date, trimmed
from agv_analysis.link.formats.table_header import (
    FLAGS,
    INSTANTS,
    ROLES,
    Header,
    TableColumn,
    columns_of,
    header_of,
    is_enough,
)
from agv_analysis.link.formats.text_columns import Block, Bytes, Places, blocks, head_of
from agv_analysis.link.large_arrays import Column, all_of, column_of, count_of, forget, parts
from agv_analysis.link.measurement import (
    LOST,
    NOT_SENT,
    RECEIVED,
    UNKNOWN,
    Malformed,
    Measurement,
    MeasurementError,
    PacketOutcomes,
    needs_packets,
)
from agv_analysis.link.packet_grid import CountedOn, PacketGrid
from agv_analysis.run import Floats

_DIRECTIONS = ("uplink_lost", "downlink_lost")
_ALWAYS_FLAGS = ("lost", *_DIRECTIONS)

_EMPTY = 2
"""Of a flag: no cell says it."""

Part = dict[str, NDArray[np.float64]]
"""Columns of a block by role, of the rows that were understood; NaN where a cell is empty."""


def _matches(head: bytes, path: Path) -> bool:
    return is_enough({column.role for column in columns_of(header_of(head))})


class _Rows:
    """Reads the rows of a table, block by block."""

    def __init__(self, path: Path, options: Options) -> None:
        self.header: Header = header_of(head_of(path))
        self.columns = columns_of(self.header, options.columns, str(path))
        self.roles = {column.role for column in self.columns}
        self.malformed = Malformed()
        self.has_commas = False
        """Was a comma where it may be a decimal mark?"""
        self._dated: dict[str, bool] = {}
        if not is_enough(self.roles):
            raise MeasurementError(
                f"{path}: no column says which packets were lost; it has {', '.join(self.header.names)}: name one with "
                f"--column, as in --column lost=NAME; roles are {', '.join(ROLES)}"
            )

    def part(self, block: Block) -> Part:
        """The columns of a block's rows."""
        text, count = block.text, len(self.header.names)
        ends_of_cells = np.flatnonzero((text == ord(self.header.separator)) | (text == ord("\n")))
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

    def _values(
        self, text: Bytes, begins: Places, ends: Places, column: TableColumn
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """The cells of a column as numbers, NaN for an empty one, and which of them are in order."""
        if column.role in INSTANTS and self._is_dated(text, begins, ends, column.role):
            values, good = dates_at(text, begins, ends, self.header.may_have_commas)
            return values, good | (begins == ends)
        read = flags_at if column.role in FLAGS else floats_at
        values, good = read(text, begins, ends, self.header.may_have_commas)
        values *= column.unit
        return values, good

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
        return ["commas are taken for decimal marks"] if self.has_commas else []


def _read(path: Path, options: Options) -> Measurement:
    rows = _Rows(path, options)
    if "seq" in rows.roles and not rows.roles & set(FLAGS):
        return _by_number(path, rows, options)
    columns = {column.role: Column(np.int8 if column.role in _ALWAYS_FLAGS else np.float64) for column in rows.columns}
    for block in blocks(path, options.progress):
        for role, values in rows.part(block).items():
            columns[role].extend(_as_flags(values) if role in _ALWAYS_FLAGS else values)
    needs_packets(len(next(iter(columns.values()))), str(path), "row below its header", rows.malformed)
    return _measurement(str(path), {role: column.values for role, column in columns.items()}, rows, options)


def _as_flags(values: Floats) -> NDArray[np.int8]:
    """0, 1, or _EMPTY where there is nothing."""
    return np.asarray(np.where(np.isnan(values), _EMPTY, values != 0.0), dtype=np.int8)


def _measurement(source: str, values: dict[str, NDArray[Any]], rows: _Rows, options: Options) -> Measurement:
    notes = rows.notes
    sent, said = _times(values, options)
    notes += [said] if said else []
    if any(np.any(sent[part.start + 1 : part.stop + 1] < sent[part]) for part in parts(len(sent) - 1, sent)):
        order = np.argsort(sent, kind="stable")
        values, sent = {role: column[order] for role, column in values.items()}, sent[order]
    up, down, whole = _outcomes(values, sent)
    notes += _missing(values.get("seq"))
    if up is not None and down is None and whole is None:
        notes.append("one direction was measured, and is taken for the uplink")
    reordered = _overtaken(values, sent)
    origin = sent[0]
    for part in parts(len(sent), sent):
        sent[part] -= origin
    return Measurement(
        source=source, format="table", sent=sent, uplink=up, downlink=down, round_trip=whole,
        reordered=reordered, malformed=rows.malformed, notes=tuple(notes),
    )  # fmt: skip


def _times(values: dict[str, NDArray[Any]], options: Options) -> tuple[Floats, str]:
    """When packets were sent [s], and what was assumed if the table does not say it."""
    for role in ("sent", "time"):
        if role not in values:
            continue
        if not count_of(values[role], np.isnan):
            return values.pop(role), ""
        unknown = np.isnan(values[role])
        if not unknown.all():
            k = np.arange(len(unknown), dtype=np.float64)
            said = f"{int(np.count_nonzero(unknown))} times were interpolated"
            return np.interp(k, k[~unknown], values[role][~unknown]), said
    count = len(next(iter(values.values())))
    number = values["seq"] - values["seq"][0] if "seq" in values else np.arange(count, dtype=np.float64)
    return number * (options.interval or 1.0), _undated(options)


def _undated(options: Options) -> str:
    said = "as --interval says" if options.interval else "is assumed; say otherwise with --interval"
    return f"the table has no times: {options.interval or 1.0:g} s between packets {said}"


def _missing(seq: Floats | None) -> list[str]:
    """That rows are missing, by their numbers."""
    if seq is None or count_of(seq, np.isnan):
        return []
    steps = (np.diff(seq[part.start : part.stop + 1]) for part in parts(len(seq) - 1, seq))
    count = sum(int(np.count_nonzero(part > 1.0)) for part in steps)
    return [f"numbers are missing in {count} places, and what became of these packets is not known"] if count else []


def _outcomes(
    values: dict[str, NDArray[Any]], sent: Floats
) -> tuple[PacketOutcomes | None, PacketOutcomes | None, PacketOutcomes | None]:
    """Uplink, downlink and round trip of a table without a round trip or without directions."""
    if values.keys() & set(_DIRECTIONS):
        up, down = (
            PacketOutcomes(_codes(values[f"{way}_lost"], NOT_SENT), values.get(f"{way}_delay"))
            if f"{way}_lost" in values else None
            for way in ("uplink", "downlink")
        )  # fmt: skip
        return up, down, None
    delay, rtt = values.get("delay"), values.get("rtt")
    arrived = values.get("received")
    if "lost" in values:
        codes = _codes(values["lost"])
    elif arrived is not None and _are_flags(arrived):
        codes = _codes(column_of((_as_flags(1.0 - arrived[part]) for part in parts(len(arrived), arrived)), np.int8))
    else:
        known = next(column for column in (arrived, delay, rtt) if column is not None)
        told = (np.where(np.isnan(known[part]), LOST, RECEIVED) for part in parts(len(known), known))
        codes = column_of(told, np.int8)
    if delay is None and rtt is None and arrived is not None and not _are_flags(arrived):
        delay = column_of((arrived[part] - sent[part] for part in parts(len(sent), arrived, sent)), np.float64)
    for column in (delay, rtt):
        if column is not None:
            forget(column, codes, RECEIVED)
    if rtt is not None and delay is None:
        return None, None, PacketOutcomes(codes, rtt)
    return PacketOutcomes(codes, delay), None, None


def _codes(flags: NDArray[np.int8], untold: int = UNKNOWN) -> NDArray[np.int8]:
    """Outcomes of flags, `untold` where there is none."""
    codes = np.array([RECEIVED, LOST, untold], dtype=np.int8)
    return column_of((codes[flags[part]] for part in parts(len(flags), flags)), np.int8)


def _are_flags(column: Floats) -> bool:
    """Is a column `received` one of yes and no, and not of times?"""
    return all_of(column, lambda part: (part == 0.0) | (part == 1.0))


def _overtaken(values: dict[str, NDArray[Any]], sent: Floats) -> int:
    """Packets that arrived after one that was sent later, as far as the table says when they did."""
    arrived, delay = values.get("received"), values.get("delay")
    if arrived is None or _are_flags(arrived):
        if delay is None:
            return 0
        arrived = None
    count, newest = 0, -np.inf
    for part in parts(len(sent), sent, delay, arrived):
        at = sent[part] + values["delay"][part] if arrived is None else arrived[part]
        at = np.append(newest, at[~np.isnan(at)])
        count += int(np.count_nonzero(at < np.maximum.accumulate(at)))
        newest = at.max()
    return count


def _by_number(path: Path, rows: _Rows, options: Options) -> Measurement:
    """Rows are what was received; a number without a row, or in a row without its delay, was lost."""
    delays = [role for role in ("delay", "rtt") if role in rows.roles]
    instant = next((role for role in ("sent", "time") if role in rows.roles), "")
    found, numbers = PacketGrid(len(delays)), CountedOn(may_be_before=False)
    for block in blocks(path, options.progress):
        part = rows.part(block)
        is_numbered = np.isfinite(part["seq"])
        rows.malformed.count += int(np.count_nonzero(~is_numbered))
        seq = numbers.take(part["seq"][is_numbered].astype(np.int64))
        given = [part[role][is_numbered] for role in delays]
        came = np.ones(len(seq), dtype=np.bool_)
        for column in given:
            came &= ~np.isnan(column)
        found.mention(seq[~came])
        sent = part[instant][is_numbered][came] if instant else None
        found.add(seq[came], tuple(column[came] for column in given), sent)
    needs_packets(found.records, str(path), "row with a number", rows.malformed)
    notes = [
        *rows.notes, "a number without a row is taken for lost; packets before the first and after the last are unknown"
    ]  # fmt: skip
    if found.dated < 2:
        notes.append(_undated(options))
    grid = found.whole(options.interval or 1.0)
    delay = dict(zip(delays, grid.delays, strict=True))
    outcomes = PacketOutcomes(grid.outcome, delay.get("delay", delay.get("rtt")))
    is_round_trip = "rtt" in delay and "delay" not in delay
    return Measurement(
        source=str(path), format="table", sent=grid.sent, uplink=None if is_round_trip else outcomes,
        round_trip=outcomes if is_round_trip else None, duplicates=grid.duplicates, reordered=grid.reordered,
        malformed=rows.malformed, notes=tuple(notes),
    )  # fmt: skip


FORMAT = Format("table", "table with a header (CSV, tshark, our own traces)", 90, _matches, _read)
