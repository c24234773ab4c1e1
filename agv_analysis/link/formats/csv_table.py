"""A table with a header: a trace of ours, an export of tshark, or any CSV with columns called as below.

    time                 when a packet was sent [s], or a date of ISO 8601 with a time
    seq                  its number; in a table of what was received one that no row has was lost
    sent, received       when it was sent and when it arrived; lost where `received` is empty, or, if it never is and
                         there are numbers, where a number is missing
    lost, received       0/1, true/false, yes/no, or a word: lost, delivered, received, ok
    delay, rtt           one way, there and back again [s]; lost where both are empty and nothing else says it
    uplink_lost, downlink_lost, uplink_delay, downlink_delay       the same of each direction; lost is nan where nothing
                         was sent this way, since what it would have answered was lost

A name may end with its unit, as in `rtt_ms` or `RTT [ms]`; tshark's own names are known, and options name any others.
The separator is a comma, a semicolon, a tabulator or a bar, whichever splits the header into most names, or blanks
where it has none of these; --delimiter names another. Unless it is a comma, a comma is a decimal mark. Lines that begin
with # are comments. A date without a unit that would be later than the year 5000 in seconds is one in ms, us or ns,
which is said.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.rows import MOST_EXACT
from agv_analysis.link.formats.table_header import FLAGS, columns_of, header_of, is_enough
from agv_analysis.link.formats.table_rows import TableRows
from agv_analysis.link.formats.text_columns import blocks
from agv_analysis.link.large_arrays import (
    Column,
    all_of,
    column_of,
    count_of,
    forget,
    is_increasing,
    median_step,
    parts,
    places_in_order,
    reordered_by,
)
from agv_analysis.link.measurement import (
    LOST,
    NOT_SENT,
    RECEIVED,
    UNKNOWN,
    Measurement,
    PacketOutcomes,
    needs_packets,
)
from agv_analysis.link.packet_grid import CountedOn, PacketGrid, spread_equal
from agv_analysis.run import Floats
from agv_ros.counted import counted

_DIRECTIONS = ("uplink_lost", "downlink_lost")
_ALWAYS_FLAGS = ("lost", *_DIRECTIONS)

_EMPTY = 2
"""Of a flag: no cell says it."""


def _matches(head: bytes, path: Path) -> bool:
    return is_enough({column.role for column in columns_of(header_of(head))})


def _read(path: Path, options: Options) -> Measurement:
    rows = TableRows(path, options)
    if "seq" in rows.roles and not rows.roles & set(FLAGS):
        return _by_number(path, rows, options)
    columns = {column.role: Column(np.int8 if column.role in _ALWAYS_FLAGS else np.float64) for column in rows.columns}
    for block in blocks(path, options.progress):
        for role, found in rows.part(block).items():
            columns[role].extend(_as_flags(found) if role in _ALWAYS_FLAGS else found)
    needs_packets(len(next(iter(columns.values()))), str(path), "row below its header", rows.malformed)
    values = {role: column.values for role, column in columns.items()}
    if _is_of_receiver(values):
        return _by_arrival(str(path), values, rows, options)
    return _measurement(str(path), values, rows, options)


def _is_of_receiver(values: dict[str, NDArray[Any]]) -> bool:
    """Are these the packets that arrived, with their numbers and no word on others?"""
    arrived = values.get("received")
    if arrived is None or "seq" not in values or values.keys() & set(_ALWAYS_FLAGS):
        return False
    return not _are_flags(arrived) and not count_of(arrived, np.isnan)


def _as_flags(values: Floats) -> NDArray[np.int8]:
    """0, 1, or _EMPTY where there is nothing."""
    return np.asarray(np.where(np.isnan(values), _EMPTY, values != 0.0), dtype=np.int8)


def _measurement(source: str, values: dict[str, NDArray[Any]], rows: TableRows, options: Options) -> Measurement:
    notes = rows.notes
    sent, said = _times(values, options)
    notes += [said] if said else []
    if not is_increasing(sent):
        order = places_in_order(sent)
        values = {role: reordered_by(column, order) for role, column in values.items()}
        sent = reordered_by(sent, order)
    up, down, whole = _outcomes(values, sent)
    notes += _spread(sent, options)
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
            said = f"{counted(int(np.count_nonzero(unknown)), 'time was', 'times were')} interpolated"
            return np.interp(k, k[~unknown], values[role][~unknown]), said
    count = len(next(iter(values.values())))
    number = values["seq"] - values["seq"][0] if "seq" in values else np.arange(count, dtype=np.float64)
    return number * (options.interval or 1.0), _undated(options)


def _undated(options: Options) -> str:
    return f"the table has no times: {options.interval or 1.0:g} s between packets {_said_of(options)}"


def _said_of(options: Options) -> str:
    return "as --interval says" if options.interval else "is assumed; say otherwise with --interval"


def _missing(seq: Floats | None) -> list[str]:
    """That rows are missing, by their numbers."""
    if seq is None or count_of(seq, np.isnan):
        return []
    steps = (np.diff(seq[part.start : part.stop + 1]) for part in parts(len(seq) - 1, seq))
    count = sum(int(np.count_nonzero(part > 1.0)) for part in steps)
    return (
        [f"numbers are missing in {counted(count, 'place')}, and what became of these packets is not known"]
        if count
        else []
    )


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


def _by_number(path: Path, rows: TableRows, options: Options) -> Measurement:
    """Rows are what was received; a number without a row, or in a row without its delay, was lost."""
    delays = [role for role in ("delay", "rtt") if role in rows.roles]
    instant = next((role for role in ("sent", "time") if role in rows.roles), "")
    found, numbers = PacketGrid(len(delays)), CountedOn(may_be_before=False)
    for block in blocks(path, options.progress):
        part = rows.part(block)
        is_numbered = np.abs(part["seq"]) < MOST_EXACT
        rows.malformed.count += int(np.count_nonzero(~is_numbered))
        seq = numbers.take(part["seq"][is_numbered].astype(np.int64))
        given = [part[role][is_numbered] for role in delays]
        came = np.ones(len(seq), dtype=np.bool_)
        for column in given:
            came &= ~np.isnan(column)
        found.mention(seq[~came])
        sent = part[instant][is_numbered][came] if instant else None
        found.add(seq[came], tuple(column[came] for column in given), sent)
    return _numbered(str(path), found, delays, rows, options)


def _by_arrival(source: str, values: dict[str, NDArray[Any]], rows: TableRows, options: Options) -> Measurement:
    """Rows are what arrived, and when; a number without a row was lost."""
    seq, arrived, sent = values["seq"], values["received"], values.get("sent", values.get("time"))
    found, numbers = PacketGrid(0 if sent is None else 1), CountedOn(may_be_before=False)
    for part in parts(len(seq), seq, arrived, sent):
        is_numbered = np.abs(seq[part]) < MOST_EXACT
        rows.malformed.count += int(np.count_nonzero(~is_numbered))
        places, came = numbers.take(seq[part][is_numbered].astype(np.int64)), arrived[part][is_numbered]
        if sent is None:
            found.add(places, (), came)
        else:
            found.add(places, (came - sent[part][is_numbered],), sent[part][is_numbered])
    told = _numbered(source, found, [] if sent is None else ["delay"], rows, options)
    said = (
        () if sent is not None else ("times are those of arrival, since the table does not say when packets were sent",)
    )
    return dataclasses.replace(told, notes=(*told.notes, *said))


def _numbered(source: str, found: PacketGrid, delays: Sequence[str], rows: TableRows, options: Options) -> Measurement:
    needs_packets(found.records, source, "row with a number", rows.malformed)
    notes = [
        *rows.notes, "a number without a row is taken for lost; packets before the first and after the last are unknown"
    ]  # fmt: skip
    if found.dated < 2:
        notes.append(_undated(options))
    grid = found.whole(options.interval or 1.0)
    if 2 * grid.duplicates > found.records - grid.duplicates:
        notes.append(
            f"{counted(grid.duplicates, 'row has', 'rows have')} the number of an earlier one: if they are "
            "answers, what was lost does not "
            "show, and a table of one direction is needed"
        )
    if found.dated >= 2:
        notes += _spread(grid.sent, options)
    delay = dict(zip(delays, grid.delays, strict=True))
    outcomes = PacketOutcomes(grid.outcome, delay.get("delay", delay.get("rtt")))
    is_round_trip = "rtt" in delay and "delay" not in delay
    return Measurement(
        source=source, format="table", sent=grid.sent, uplink=None if is_round_trip else outcomes,
        round_trip=outcomes if is_round_trip else None, duplicates=grid.duplicates, reordered=grid.reordered,
        malformed=rows.malformed, notes=tuple(notes),
    )  # fmt: skip


def _spread(sent: Floats, options: Options) -> list[str]:
    """Spread packets over stamps that are coarser than packets are apart, in place, and say so."""
    count = len(sent)
    if count > 1 and not sent[-1] > sent[0]:
        for part in parts(count, sent):
            sent[part] = np.arange(part.start, part.stop) * (options.interval or 1.0)
        return [f"all rows have the same time: {options.interval or 1.0:g} s between packets {_said_of(options)}"]
    if count < 3 or median_step(sent) > 0.0:
        return []
    return [
        f"{spread_equal(sent)} of {counted(count, 'packet has', 'packets have')} the time of the one before, and "
        "are spread evenly up to the "
        "next time: durations are as coarse as the stamps"
    ]


FORMAT = Format(
    "table", "table with a header (CSV, tshark, our own traces)", 90, _matches, _read, ("columns", "delimiter")
)
