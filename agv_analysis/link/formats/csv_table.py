"""A table with a header: a trace of ours, an export of tshark, or any CSV with columns called as below.

    time                 when a packet was sent [s]
    seq                  its number; a number that no row has was lost
    sent, received       when it was sent and when it arrived [s]; lost where `received` is empty
    lost, received       0/1, true/false, yes/no, or a word: lost, delivered, received, ok
    delay, rtt           one way, there and back again [s]; lost where both are empty and nothing else says it
    uplink_lost, downlink_lost, uplink_delay, downlink_delay       the same of each direction; lost is nan where nothing
                         was sent this way, since what it would have answered was lost

A name may end with its unit, as in `rtt_ms`; tshark's own names are known, and options name any others. The separator
is a comma, a semicolon, a tabulator or a bar, whichever splits the header into most names.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.rows import floats_at
from agv_analysis.link.formats.text_columns import Block, Bytes, Places, blocks, cells, head_of
from agv_analysis.link.measurement import (
    LOST,
    NOT_SENT,
    RECEIVED,
    UNKNOWN,
    Codes,
    Malformed,
    Measurement,
    MeasurementError,
    Numbered,
    PacketOutcomes,
    needs_packets,
    on_grid,
    unwrapped,
)
from agv_analysis.run import Floats

ROLES = (
    "time", "seq", "sent", "received", "lost", "delay", "rtt", "uplink_lost", "downlink_lost", "uplink_delay",
    "downlink_delay",
)  # fmt: skip
"""What a column may be."""

_KNOWN = {
    "frame.time_epoch": "time", "frame.time_relative": "time", "timestamp": "time", "t": "time", "time_s": "time",
    "icmp.seq": "seq", "icmp.seq_le": "seq", "rtps.sm.seqnumber": "seq", "rtp.seq": "seq", "seqno": "seq",
    "sequence": "seq", "icmp_seq": "seq", "k": "seq", "icmp.resptime": "rtt_ms", "latency": "delay",
    "verdict": "lost", "loss": "lost",
}  # fmt: skip
"""Usual names for a role."""

_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_TRUE = (b"1", b"true", b"yes", b"y", b"t")
_FALSE = (b"0", b"false", b"no", b"n", b"f")
_IS_LOST = {b"lost": True, b"dropped": True, b"delivered": False, b"received": False, b"ok": False}
_SEPARATORS = (",", ";", "\t", "|")
_MODULUS = 65536


class _Column(NamedTuple):
    place: int
    role: str
    unit: float


def _header(line: bytes) -> tuple[str, list[str]]:
    text = line.decode("utf-8-sig", "replace").strip("\r\n")
    separator = max(_SEPARATORS, key=text.count)
    return separator, [name.strip().strip("\"'").strip() for name in text.split(separator)]


def _role(name: str) -> tuple[str, float]:
    """The role of a column of this name and its unit; an empty role for one that has none."""
    name = _KNOWN.get(name.lower(), name.lower())
    found = re.fullmatch(r"(\w+?)[_ ]?[\[(]?(s|ms|us|ns)[\])]?", name)
    if name not in ROLES and found is not None and found[1] in ROLES:
        return found[1], _UNITS[found[2]]
    return (name, 1.0) if name in ROLES else ("", 1.0)


def _unit(name: str) -> float:
    """What the unit at the end of a name is worth [s], 1 without one."""
    found = re.search(r"[_ \[(](ms|us|ns)[\])]?$", _KNOWN.get(name.lower(), name.lower()))
    return _UNITS[found[1]] if found else 1.0


def _columns(names: list[str], options: Options, source: str) -> list[_Column]:
    """The columns that matter. Raises MeasurementError."""
    chosen: dict[str, _Column] = {}
    for role, name in options.columns.items():
        if role not in ROLES:
            raise MeasurementError(f"--column {role}={name}: must be one of {', '.join(ROLES)}")
        if name not in names:
            raise MeasurementError(f"{source}: has no column {name!r}; it has {', '.join(names)}")
        chosen[role] = _Column(names.index(name), role, _unit(name))
    for place, name in enumerate(names):
        role, unit = _role(name)
        if role and role not in chosen and place not in {column.place for column in chosen.values()}:
            chosen[role] = _Column(place, role, unit)
    return list(chosen.values())


def _is_enough(roles: set[str]) -> bool:
    """Do these columns say which packets were lost?"""
    says_it = {"lost", "received", "delay", "rtt", "uplink_lost", "downlink_lost"}
    return bool(roles & says_it) or roles >= {"time", "seq"}


def _matches(head: bytes, path: Path) -> bool:
    line = head.split(b"\n", 1)[0]
    try:
        return _is_enough({column.role for column in _columns(_header(line)[1], Options(), "")})
    except MeasurementError:
        return False


class _Rows(NamedTuple):
    """Columns by role, of the rows that were understood."""

    values: dict[str, Floats]
    """Numbers, NaN where a cell is empty; of `lost` and `received` 0 or 1, if they are no times."""
    malformed: Malformed


def _read(path: Path, options: Options) -> Measurement:
    separator, names = _header(head_of(path).split(b"\n", 1)[0])
    columns = _columns(names, options, str(path))
    roles = {column.role for column in columns}
    if not _is_enough(roles):
        raise MeasurementError(
            f"{path}: no column says which packets were lost; it has {', '.join(names)}: name one with --column, as in "
            f"--column lost=NAME; roles are {', '.join(ROLES)}"
        )
    malformed, parts = Malformed(), []
    for block in blocks(path, options.progress):
        parts.append(_columns_of(block, separator, len(names), columns, malformed))
    values = {role: np.concatenate([part[role] for part in parts]) for role in (column.role for column in columns)}
    needs_packets(len(next(iter(values.values()))), str(path), "row below its header")
    return _measurement(str(path), values, malformed, options)


def _columns_of(
    block: Block, separator: str, count: int, columns: list[_Column], malformed: Malformed
) -> dict[str, Floats]:
    text = block.text
    ends_of_cells = np.flatnonzero((text == ord(separator)) | (text == ord("\n")))
    lines = block.line_of(ends_of_cells)
    per_line = np.bincount(lines, minlength=len(block.starts))
    whole = per_line == count
    if block.number == 1:
        whole[0] = False
    for i in np.flatnonzero(~whole).tolist():
        if block.number + i > 1 and block.line(i).strip():
            malformed.add(block.number + i, block.line(i))
    rows = np.flatnonzero(whole)
    ends = ends_of_cells[whole[lines]].reshape(-1, count)
    begins = np.concatenate((block.starts[rows][:, None], ends[:, :-1] + 1), axis=1)
    good = np.ones(len(rows), dtype=np.bool_)
    found = {}
    for column in columns:
        values, fine = _values(text, *_trimmed(text, begins[:, column.place], ends[:, column.place]), column)
        found[column.role] = values * column.unit
        good &= fine
    for i in rows[~good].tolist():
        malformed.add(block.number + i, block.line(i))
    return {role: values[good] for role, values in found.items()}


def _trimmed(text: Bytes, begins: Places, ends: Places) -> tuple[Places, Places]:
    """Without one blank or quotation mark at the front, and one blank, quotation mark or carriage return at the end."""
    marks = np.frombuffer(b" \"'\r", dtype=np.uint8)
    for _ in range(2):
        begins = begins + ((begins < ends) & np.isin(text[np.minimum(begins, len(text) - 1)], marks))
        ends = ends - ((begins < ends) & np.isin(text[np.maximum(ends - 1, 0)], marks))
    return begins, ends


def _values(text: Bytes, begins: Places, ends: Places, column: _Column) -> tuple[Floats, NDArray[np.bool_]]:
    """Numbers of a column, and which cells have one or are empty; words of flags become 0 and 1."""
    values, good = floats_at_or_words(text, begins, ends) if _is_flag(column.role) else floats_at(text, begins, ends)
    return values, good


def _is_flag(role: str) -> bool:
    return role in ("lost", "received", "uplink_lost", "downlink_lost")


def floats_at_or_words(text: Bytes, begins: Places, ends: Places) -> tuple[Floats, NDArray[np.bool_]]:
    """As `floats_at`; words that mean yes or lost become 1, words that mean no or received 0."""
    letters = text[np.minimum(begins, len(text) - 1)]
    is_word = ((letters >= ord("A")) & (begins < ends)) & ~np.isin(letters, np.frombuffer(b"nN", dtype=np.uint8))
    is_word |= np.isin(letters, np.frombuffer(b"nN", dtype=np.uint8)) & (ends - begins <= 2)  # n, no
    values, good = np.full(len(begins), np.nan), np.zeros(len(begins), dtype=np.bool_)
    values[~is_word], good[~is_word] = floats_at(text, begins[~is_word], ends[~is_word])
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


def _measurement(source: str, values: dict[str, Floats], malformed: Malformed, options: Options) -> Measurement:
    notes: list[str] = []
    if "seq" in values and not values.keys() & {"lost", "received", "uplink_lost", "downlink_lost"}:
        return _by_number(source, values, malformed, options)
    sent, said = _times(values, options)
    notes += [said] if said else []
    order = np.argsort(sent, kind="stable")
    if np.any(np.diff(order) != 1):
        values, sent = {role: column[order] for role, column in values.items()}, sent[order]
    up, down, whole = _outcomes(values, sent)
    reordered, arrived = 0, _arrivals(values, sent)
    if arrived is not None:
        kept = arrived[~np.isnan(arrived)]
        reordered = int(np.count_nonzero(kept < np.maximum.accumulate(kept))) if len(kept) else 0
    if up is not None and down is None and whole is None:
        notes.append("one direction was measured, and is taken for the uplink")
    return Measurement(
        source=source, format="table", sent=sent - sent[0], uplink=up, downlink=down, round_trip=whole,
        reordered=reordered, malformed=malformed, notes=tuple(notes),
    )  # fmt: skip


def _times(values: dict[str, Floats], options: Options) -> tuple[Floats, str]:
    """When packets were sent [s], and what was assumed if the table does not say it."""
    for role in ("sent", "time"):
        if role in values and not np.isnan(values[role]).any():
            return values[role], ""
        if role in values and not np.isnan(values[role]).all():
            known = ~np.isnan(values[role])
            k = np.arange(len(known), dtype=np.float64)
            said = f"{int(np.count_nonzero(~known))} times were interpolated"
            return np.interp(k, k[known], values[role][known]), said
    count = len(next(iter(values.values())))
    interval = options.interval or 1.0
    number = values["seq"] - values["seq"][0] if "seq" in values else np.arange(count, dtype=np.float64)
    said = f"the table has no times: {interval:g} s between packets" + (
        ", as --interval says" if options.interval else " is assumed; say otherwise with --interval"
    )
    return number * interval, said


def _outcomes(
    values: dict[str, Floats], sent: Floats
) -> tuple[PacketOutcomes | None, PacketOutcomes | None, PacketOutcomes | None]:
    """Uplink, downlink and round trip of a table without a round trip or without directions."""
    if values.keys() & {"uplink_lost", "downlink_lost"}:
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
        codes = _codes(1.0 - arrived)
    elif arrived is not None:
        codes = np.where(np.isnan(arrived), LOST, RECEIVED).astype(np.int8)
    else:
        known = delay if delay is not None else rtt
        assert known is not None, "a table says which packets were lost"
        codes = np.where(np.isnan(known), LOST, RECEIVED).astype(np.int8)
    if delay is None and rtt is None and arrived is not None and not _are_flags(arrived):
        delay = arrived - sent
    if delay is not None:
        delay = np.where(codes == RECEIVED, delay, np.nan)
    if rtt is not None and delay is None:
        return None, None, PacketOutcomes(codes, np.where(codes == RECEIVED, rtt, np.nan))
    return PacketOutcomes(codes, delay), None, None


def _codes(flags: Floats, untold: int = UNKNOWN) -> Codes:
    """Outcomes of flags, `untold` where there is none."""
    return np.where(np.isnan(flags), untold, np.where(flags != 0.0, LOST, RECEIVED)).astype(np.int8)


def _are_flags(column: Floats) -> bool:
    """Is a column `received` one of yes and no, and not of times?"""
    known = column[~np.isnan(column)]
    return bool(np.isin(known, (0.0, 1.0)).all()) and not np.isnan(column).any()


def _arrivals(values: dict[str, Floats], sent: Floats) -> Floats | None:
    arrived = values.get("received")
    if arrived is not None and not _are_flags(arrived):
        return arrived
    return None if values.get("delay") is None else sent + values["delay"]


def _by_number(source: str, values: dict[str, Floats], malformed: Malformed, options: Options) -> Measurement:
    """Rows are what was received; a number without a row was lost."""
    numbered = np.isfinite(values["seq"])
    malformed.count += int(np.count_nonzero(~numbered))
    values = {role: column[numbered] for role, column in values.items()}
    needs_packets(len(values["seq"]), source, "row with a number")
    seq = values["seq"].astype(np.int64)
    delays = [role for role in ("delay", "rtt") if role in values]
    given = tuple(values[role] for role in delays)
    missing = np.zeros(len(seq), dtype=np.bool_)
    for column in given:
        missing |= np.isnan(column)
    has_rows_of_losses = bool(given) and bool(missing.any())
    received = ~missing if has_rows_of_losses else np.ones(len(seq), dtype=np.bool_)
    if int(seq.max()) < _MODULUS and np.any(np.diff(seq) < -_MODULUS // 2):
        seq = unwrapped(seq, _MODULUS)
    times = values.get("sent", values.get("time"))
    interval = options.interval or 1.0
    found = Numbered(
        seq[received], tuple(column[received] for column in given), None if times is None else times[received]
    )
    grid = on_grid(found, int(seq.min()), int(seq.max()), interval)
    notes = ["a number without a row is taken for lost; packets before the first and after the last are unknown"]
    if times is None:
        said = "as --interval says" if options.interval else "assumed; say otherwise with --interval"
        notes.append(f"the table has no times: {interval:g} s between packets, {said}")
    delay = dict(zip(delays, grid.delays, strict=True))
    outcomes = PacketOutcomes(grid.outcome, delay.get("delay", delay.get("rtt")))
    is_round_trip = "rtt" in delay and "delay" not in delay
    return Measurement(
        source=source, format="table", sent=grid.sent, uplink=None if is_round_trip else outcomes,
        round_trip=outcomes if is_round_trip else None, duplicates=grid.duplicates, reordered=grid.reordered,
        malformed=malformed, notes=tuple(notes),
    )  # fmt: skip


FORMAT = Format("table", "table with a header (CSV, tshark, our own traces)", 90, _matches, _read)
