"""Measured outcomes with the times at which they were measured, played by time and not by row.

Theory of operation. Packet i of the measurement was sent at t_i. A message that the loop sends at the time t has the
fate of the last packet measured by then: what a measurement saw holds until it looked again. So an outage that lasted
from a lost packet to the next one received lasts as long in the loop, to one slot, whatever the periods of the two; an
outage between two packets that both came through was not seen, and is not played. After its last packet a trace lasts
one median interval more; then it begins again, or what `trace_end` says.

A file has a column `time` [s], increasing, and `lost` (0, 1) or `verdict`, or `uplink_lost` and `downlink_lost`; and
where messages were late `delay`, or `uplink_delay` and `downlink_delay` [s], empty or nan for what was lost. An outcome
that is nan is not known, since nothing was sent this way: it is what was known before. A file without times has a row a
slot, as ever.
"""

from __future__ import annotations

import csv
import functools
import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_plant.channels.trace import TraceError, load_trace
from agv_ros.errors import open_text
from agv_ros.json_text import parse_json

Floats = NDArray[np.float64]

TIME = "time"

_EARLY = 1e-9
"""Share of a slot by which a slot may come before the packet that it belongs to: times are rounded."""

_WORDS = {"0": 0.0, "1": 1.0, "0.0": 0.0, "1.0": 1.0, "delivered": 0.0, "lost": 1.0, "nan": math.nan}


class Trace(NamedTuple):
    """What was measured in one direction."""

    lost: NDArray[np.bool_]
    """Outcome of each packet, or of each slot, shape (n,)."""
    time: Floats | None = None
    """When each packet was sent, in seconds since the first, shape (n,); None: a row is a slot, whatever its length."""
    delay: Floats | None = None
    """Time under way of each packet that was not lost [s], shape (n,); None if none was late."""

    def length(self, ts: float) -> float:
        """How long it lasts [s], with slots of `ts` [s] if a row is a slot."""
        if self.time is None:
            return len(self.lost) * ts
        return float(self.time[-1]) + (float(np.median(np.diff(self.time))) if len(self.time) > 1 else ts)

    def rows(self, k: NDArray[np.int64], ts: float, end: str, start: float = 0.0) -> NDArray[np.int64]:
        """The row that decides each slot `k` of `ts` [s], shape (m,); -1 behind the end, where nothing is lost.

        Slot 0 is played at `start` [s] of the trace. `end` is one of `trace.ENDS`. Raises TraceError for a slot behind
        the end of a trace that may not be outrun.
        """
        if self.time is None:
            at = k + round(start / ts)
            within = at < len(self.lost)
            rows = at % len(self.lost)
        else:
            length = self.length(ts)
            t = start + k * ts
            within = t < length - _EARLY * ts
            # A slot that is due at the end, but for rounding, is the first of the next round.
            t = t - length * np.floor(t / length + _EARLY * ts / length)
            rows = np.maximum(0, np.searchsorted(self.time, t + _EARLY * ts, side="right") - 1)
        if end == "stop" and not within.all():
            slots = int(np.count_nonzero(np.cumsum(~within) == 0)) if len(within) else 0
            raise TraceError(
                f"the trace ends after {self._slots(ts, start)} slots, and slot {int(k[slots])} is asked for: make the "
                "run shorter, or set trace_end to repeat or hold"
            )
        return np.where(within | (end == "repeat"), rows, -1)

    def _slots(self, ts: float, start: float) -> int:
        """Slots of `ts` [s] from `start` [s] to the end."""
        if self.time is None:
            return len(self.lost) - round(start / ts)
        return math.ceil((self.length(ts) - start) / ts - _EARLY)


def start_of(trace: Trace, seed: int, window: float, ts: float) -> float:
    """Where in a trace [s] slot 0 of a run with this seed is: seed 1 at its beginning, the next one a window later.

    Behind its end the windows go on at its beginning. A window of 0 s: all begin with it.
    """
    return (seed - 1) * window % trace.length(ts) if window > 0.0 else 0.0


def read_trace(path: str, link: str) -> Trace:
    """What a file says of the link called `link`. Raises TraceError; the text names file, line and reason.

    Only `uplink` and `downlink` have columns of their own.
    """
    try:
        found = Path(path).stat()
    except OSError:
        load_trace(path)  # says what is wrong
        raise
    return _read(path, link, found.st_mtime_ns, found.st_size)


@functools.lru_cache(maxsize=4)
def _read(path: str, link: str, modified: int, size: int) -> Trace:
    """As `read_trace`, once for each state of a file."""
    if path.endswith(".json"):
        return _from_json(path, link)
    if Path(path).is_dir() or path.endswith(".mcap"):
        return Trace(np.array(load_trace(path)))
    with open_text(path, TraceError, encoding="utf-8-sig", newline="") as file:
        header = [cell.strip() for cell in next(csv.reader([file.readline()]), [])]
        is_empty = not file.readline()
    if TIME not in header:
        if any(name.endswith("_lost") for name in header):
            raise TraceError(f"{path}:1: has outcomes of each direction, but no column time: it cannot be played")
        return Trace(np.array(load_trace(path)))
    if is_empty:
        raise TraceError(f"{path}: no rows below the header")
    lost, delay = _columns_of(header, link, path)
    columns = [header.index(name) for name in (TIME, lost, *([delay] if delay else []))]
    return _checked(_rows(path, columns, header), path)


def has_delays(path: str) -> bool:
    """Does a trace say how late messages were? Raises TraceError if the file cannot be read."""
    if path.endswith(".json"):
        with open_text(path, TraceError, encoding="utf-8-sig") as text:
            content = text.read()
        return '"time"' in content and 'delay"' in content
    with open_text(path, TraceError, encoding="utf-8-sig", newline="") as file:
        header = [cell.strip() for cell in next(csv.reader([file.readline()]), [])]
    return TIME in header and any(name == "delay" or name.endswith("_delay") for name in header)


def _columns_of(header: Sequence[str], link: str, path: str) -> tuple[str, str]:
    """Names of the columns of a link's outcomes and delays; the latter is empty if there is none. Raises TraceError."""
    own = f"{link}_lost"
    named = [name for name in (own, "lost", "verdict") if name in header]
    if not named:
        others = [name for name in header if name.endswith("_lost")]
        of_other = f"; it has {', '.join(others)}" if others else ""
        raise TraceError(f"{path}:1: no column says what the {link or 'link'} lost (lost, verdict or {own}){of_other}")
    delay = f"{link}_delay" if named[0] == own else "delay"
    return named[0], delay if delay in header else ""


def _rows(path: str, columns: list[int], header: list[str]) -> Floats:
    """The columns as numbers, shape (n, columns): all at once, or line by line where that does not work."""
    _refuse_empty_rows(path)
    try:
        return np.loadtxt(
            path, delimiter=",", skiprows=1, usecols=columns, ndmin=2, encoding="utf-8-sig", comments=None
        )
    except (ValueError, OSError):
        pass  # words, empty cells, or a line that has to be named
    found = []
    with open_text(path, TraceError, encoding="utf-8-sig", newline="") as file:
        reader = csv.reader(file)
        next(reader, None)
        for row in reader:
            if row:
                found.append([_number(row, column, header, f"{path}:{reader.line_num}") for column in columns])
    return np.array(found).reshape(-1, len(columns))


def _refuse_empty_rows(path: str) -> None:
    """Raise TraceError for a row without anything in it that others follow: numpy would pass over it."""
    if not _may_have_empty_rows(path):
        return
    empty = 0
    with open_text(path, TraceError, encoding="utf-8-sig") as file:
        for number, line in enumerate(file, start=1):
            if empty and not line.isspace():
                raise TraceError(f"{path}:{empty}: the row is empty")
            if line.isspace():
                empty = empty or number


_EMPTY_ROW = re.compile(rb"[\r\n][ \t\v\f]*[\r\n]+[ \t\v\f]*[^\s]")
"""A row without anything in it that others follow."""


def _may_have_empty_rows(path: str) -> bool:
    """A first look, a hundred times as fast as one line by line."""
    last = b""
    with open(path, "rb") as file:
        while chunk := file.read(1 << 20):
            chunk = last + chunk
            if _EMPTY_ROW.search(chunk.replace(b"\r\n", b"\n")):
                return True
            last = chunk[len(chunk.rstrip()) - 1 :] if chunk.strip() else chunk
    return False


def _number(row: Sequence[str], column: int, header: Sequence[str], where: str) -> float:
    """One cell; an empty delay is unknown. Raises TraceError."""
    name = header[column]
    cell = row[column].strip() if column < len(row) else ""
    if name in ("lost", "verdict") or name.endswith("_lost"):
        if cell not in _WORDS:
            raise TraceError(f"{where}: {name} must be 0 or 1, found {cell!r}")
        return _WORDS[cell]
    if not cell and name != TIME:
        return math.nan
    try:
        return float(cell)
    except ValueError:
        raise TraceError(f"{where}: {name} must be a number of seconds, found {cell!r}") from None


def _from_json(path: str, link: str) -> Trace:
    with open_text(path, TraceError, encoding="utf-8-sig") as file:
        text = file.read()
    try:
        content = parse_json(text)
    except json.JSONDecodeError:
        content = None
    if not isinstance(content, dict) or not isinstance(content.get(TIME), list):
        return Trace(np.array(load_trace(path)))
    lost, delay = _columns_of(list(content), link, path)
    names = [TIME, lost, *([delay] if delay else [])]
    if len({len(content[name]) for name in names}) != 1:
        raise TraceError(f"{path}: the lists {', '.join(names)} must be equally long")
    rows = [
        [_number(["" if cell is None else _text(cell)], 0, [name], f"{path}: {name}[{i}]")
         for name, cell in zip(names, cells, strict=True)]
        for i, cells in enumerate(zip(*(content[name] for name in names), strict=True))
    ]  # fmt: skip
    return _checked(np.array(rows).reshape(-1, len(names)), path)


def _text(cell: object) -> str:
    return str(int(cell)) if isinstance(cell, bool) else str(cell)


def _held(flags: Floats) -> Floats:
    """What is not known of a packet, NaN, is what was known before it; at the beginning that none was lost."""
    last = np.maximum.accumulate(np.where(np.isnan(flags), -1, np.arange(len(flags))))
    return np.where(last >= 0, flags[np.maximum(last, 0)], 0.0)


def _checked(rows: Floats, path: str) -> Trace:
    """A trace from columns time, lost and perhaps delay. Raises TraceError naming the row."""
    if not len(rows):
        raise TraceError(f"{path}: no rows below the header")
    time, flags = rows[:, 0], _held(rows[:, 1])
    bad = np.flatnonzero(~np.isin(flags, (0.0, 1.0)))
    if len(bad):
        raise TraceError(f"{path}: row {bad[0] + 1}: lost must be 0 or 1, found {flags[bad[0]]:g}")
    bad = np.flatnonzero(~np.isfinite(time) | np.append(False, np.diff(time) <= 0.0))
    if len(bad):
        raise TraceError(f"{path}: row {bad[0] + 1}: time must increase from row to row, found {time[bad[0]]:g} s")
    lost = flags != 0.0
    if rows.shape[1] < 3:
        return Trace(lost, _since_first(time))
    delay = np.where(lost, 0.0, rows[:, 2])
    bad = np.flatnonzero(~(np.nan_to_num(delay, nan=0.0) >= 0.0) | np.isinf(delay))
    if len(bad):
        raise TraceError(f"{path}: row {bad[0] + 1}: delay must be >= 0 s and finite, found {delay[bad[0]]:g}")
    # What was received at an unknown delay came as late as the packet before it, the first ones at once.
    known = ~np.isnan(delay) & ~lost
    last = np.maximum.accumulate(np.where(known, np.arange(len(delay)), -1))
    filled = np.where(lost, 0.0, np.where(last >= 0, delay[np.maximum(last, 0)], 0.0))
    return Trace(lost, _since_first(time), np.nan_to_num(filled) if filled.any() else None)


_DATE = 1e8
"""Times of more seconds than this count from 1970."""


def _since_first(time: Floats) -> Floats:
    """Times [s] since the first, shape (n,).

    Those since 1970 to the microsecond: as floats they are off by 0.1 us, and a packet that is late by that is not yet
    there when the slot begins to which it belongs.
    """
    since = time - time[0]
    return np.asarray(np.round(since, 6) if time[0] > _DATE else since)
