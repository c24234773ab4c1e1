"""The JSON file of irtt client -o, gzipped or not.

Each member of `round_trips` has a number, what became of it (`lost`: false, true, true_up, true_down, as a string or as
a boolean), time stamps and delays in nanoseconds. true_up was lost on the way there, so nothing came that could be lost
on the way back; true: irtt does not know on which way. Read one member at a time, so that a file may be of any size.
Source: irtt-client(1), JSON format.
"""

from __future__ import annotations

import json
import re
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.text_columns import Progress, chunks
from agv_analysis.link.measurement import (
    LOST,
    NOT_SENT,
    RECEIVED,
    UNKNOWN,
    Codes,
    Malformed,
    Measurement,
    MeasurementError,
    PacketOutcomes,
)
from agv_analysis.run import Floats

_BEGIN = re.compile(r'"round_trips"\s*:\s*\[')
_INTERVAL = re.compile(r'"interval"\s*:\s*(\d+)')
_NS = 1e-9
_COLUMNS = 8
"""Numbers of a round trip, see `_row`."""

_WAYS = {
    "false": (RECEIVED, RECEIVED),
    "true": (UNKNOWN, UNKNOWN),
    "true_up": (LOST, NOT_SENT),
    "true_down": (RECEIVED, LOST),
}
"""Outcomes of the uplink and the downlink by irtt's word."""


def _matches(head: bytes, path: Path) -> bool:
    return head.lstrip()[:1] == b"{" and (
        b'"round_trips"' in head or (b'"received_stats"' in head and b'"packets_sent"' in head)
        or (b'"open_timeouts"' in head and b'"system_info"' in head)
    )  # fmt: skip


def _read(path: Path, options: Options) -> Measurement:
    malformed, rows, stated = Malformed(), array("d"), [0.0]
    for number, member in enumerate(_members(path, options.progress, malformed, stated), start=1):
        row = _row(member)
        if row is None:
            malformed.add(number, json.dumps(member).encode())
        else:
            rows.extend(row)
    if not rows:
        raise MeasurementError(f"{path}: has no round trips: was irtt stopped before it wrote them?")
    table = np.frombuffer(rows).reshape(-1, _COLUMNS)
    return _measurement(str(path), table, malformed, stated[0], options)


def _members(path: Path, progress: Progress | None, malformed: Malformed, stated: list[float]) -> Iterator[Any]:
    """The round trips, one at a time; what follows a broken one is left out and counted as one."""
    decoder, text, began = json.JSONDecoder(), "", False
    for chunk in chunks(path, progress):
        text += chunk.decode("utf-8", "replace")
        if not began:
            begin = _BEGIN.search(text)
            if begin is None:
                continue
            interval = _INTERVAL.search(text[: begin.start()])
            stated[0] = 0.0 if interval is None else int(interval[1]) * _NS
            text, began = text[begin.end() :], True
        at = 0
        while True:
            at = _skip(text, at)
            if at >= len(text) or text[at] == "]":
                break
            try:
                member, at = decoder.raw_decode(text, at)
            except json.JSONDecodeError:
                break  # not whole yet
            yield member
        text = text[at:]
        if text.startswith("]"):
            return
    if began:
        malformed.add(0, f"the file ends within its round trips: {text[:40]}".encode())


def _skip(text: str, at: int) -> int:
    while at < len(text) and text[at] in " \t\r\n,":
        at += 1
    return at


def _row(member: Any) -> tuple[float, ...] | None:
    """Number, outcomes of both ways and of the whole, delays up, down, whole [s], time sent [s]; None if it has none.

    Delays that are not there are NaN.
    """
    if not isinstance(member, dict) or not isinstance(member.get("seqno"), int):
        return None
    word = str(member.get("lost", "false")).lower()
    if word not in _WAYS:
        return None
    up, down = _WAYS[word]
    whole = RECEIVED if word == "false" else LOST
    delay = member.get("delay") or {}
    sent = (((member.get("timestamps") or {}).get("client") or {}).get("send")) or {}
    stamp = sent.get("monotonic", sent.get("wall"))
    delays = (_seconds(delay.get("send")), _seconds(delay.get("receive")), _seconds(delay.get("rtt")))
    if whole == LOST:
        delays = (delays[0] if up == RECEIVED else np.nan, np.nan, np.nan)
    return (member["seqno"], up, down, whole, *delays, _seconds(stamp))


def _seconds(value: Any) -> float:
    return float(value) * _NS if isinstance(value, (int, float)) and not isinstance(value, bool) else np.nan


def _measurement(source: str, table: Floats, malformed: Malformed, stated: float, options: Options) -> Measurement:
    order = np.argsort(table[:, 0], kind="stable")
    reordered = int(np.count_nonzero(np.diff(order) < 0))
    table = table[order]
    fresh = np.append(True, np.diff(table[:, 0]) > 0)
    duplicates = int(np.count_nonzero(~fresh))
    table = table[fresh]
    notes = []
    codes: list[Codes] = [table[:, i].astype(np.int8) for i in (1, 2, 3)]
    up, down, whole = codes
    blind = int(np.count_nonzero((up == UNKNOWN) & (whole == LOST)))
    missing = int(table[-1, 0] - table[0, 0]) + 1 - len(table)
    if missing:
        notes.append(f"{missing} numbers are missing from the file, and what became of these packets is not known")
    if blind:
        notes.append(f"of {blind} lost packets irtt does not know on which way (lost is true): see --stats of irtt")
    uplink, downlink = PacketOutcomes(up, _or_none(table[:, 4])), PacketOutcomes(down, _or_none(table[:, 5]))
    if not np.isnan(table[:, 4]).all():
        notes.append("delays of each direction are as good as the two clocks agree")
    return Measurement(
        source=source, format="irtt", sent=_times(table, options.interval or stated), uplink=uplink, downlink=downlink,
        round_trip=PacketOutcomes(whole, _or_none(table[:, 6])), duplicates=duplicates, reordered=reordered,
        malformed=malformed, notes=tuple(notes),
    )  # fmt: skip


def _or_none(delay: Floats) -> Floats | None:
    return None if np.isnan(delay).all() else delay


def _times(table: Floats, interval: float) -> Floats:
    """When packets were sent [s] since the first: by their stamps, else by their numbers."""
    numbers, stamps = table[:, 0] - table[0, 0], table[:, 7]
    known = ~np.isnan(stamps)
    if np.count_nonzero(known) < 2:
        return np.asarray(numbers * (interval or 1.0))
    times = np.interp(numbers, numbers[known], stamps[known])
    return np.asarray(np.maximum.accumulate(times - times[0]))


FORMAT = Format("irtt", "JSON of irtt client -o", 10, _matches, _read)
