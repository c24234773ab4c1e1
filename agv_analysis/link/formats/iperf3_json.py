"""The JSON file of iperf3 -u -J: packets and losses of each interval, and not which packets were lost.

The receiver's figures count: those of `server_output_json` (--get-server-output) or, with -R, the client's own. Without
either only the sums at the end are the receiver's. Source: iperf3(1).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.rows import MOST_EXACT
from agv_analysis.link.formats.text_columns import open_binary
from agv_analysis.link.measurement import LossRates, MeasurementError, needs_memory
from agv_ros.json_text import parse_json

_EXPANDS = 4
"""Bytes in memory of a byte of JSON, at least."""

Row = tuple[float, float, int, int]


def _matches(head: bytes, path: Path) -> bool:
    return head.lstrip()[:1] == b"{" and (b'"test_start"' in head or (b'"version"' in head and b"iperf" in head))


def _read(path: Path, options: Options) -> LossRates:
    needs_memory(path, _EXPANDS * path.stat().st_size)
    with open_binary(path) as file:
        try:
            content = parse_json(file.read())
        except (ValueError, OSError) as error:
            raise MeasurementError(f"{path}: is not a whole JSON file: {error}") from None
    if not isinstance(content, dict):
        raise MeasurementError(f"{path}: is not iperf3's JSON")
    start = (content.get("start") or {}).get("test_start") or {}
    if str(start.get("protocol", "UDP")).upper() != "UDP":
        raise MeasurementError(f"{path}: a test over TCP, which sends again what is lost: measure with iperf3 -u")
    rows, notes = _rows(content), tuple[str, ...]()
    if not rows:
        rows = _sum(content)
        notes = ("the sums of the whole test: its intervals are the sender's, who knows no losses",)
    if not rows:
        raise MeasurementError(f"{path}: has neither intervals nor sums with lost_packets and packets")
    begin, end, packets, lost = (np.array(column) for column in zip(*rows, strict=True))
    return LossRates(
        str(path), "iperf3", begin.astype(np.float64), end.astype(np.float64), packets.astype(np.int64),
        lost.astype(np.int64), is_uplink=not start.get("reverse", 0), notes=notes,
    )  # fmt: skip


def _rows(content: dict[str, Any]) -> list[Row]:
    """Of the receiver's intervals; empty if only the sender's are there."""
    for source in (content.get("server_output_json") or {}, content):
        intervals = source.get("intervals") or []
        found = [row for interval in intervals if (row := _row((interval or {}).get("sum") or {})) is not None]
        if found:
            return found
    return []


def _sum(content: dict[str, Any]) -> list[Row]:
    end = content.get("end") or {}
    for name in ("sum_received", "sum"):
        row = _row(end.get(name) or {})
        if row is not None:
            return [row]
    return []


def _row(found: dict[str, Any]) -> Row | None:
    if found.get("omitted") or not found.get("packets") or "lost_packets" not in found:
        return None
    try:
        row = float(found["start"]), float(found["end"]), int(found["packets"]), int(found["lost_packets"])
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    return row if -MOST_EXACT < row[0] < row[1] < MOST_EXACT and 0 <= row[3] <= row[2] < MOST_EXACT else None


FORMAT = Format("iperf3", "JSON of iperf3 -u -J", 20, _matches, _read)
