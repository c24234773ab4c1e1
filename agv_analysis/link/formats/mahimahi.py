"""A packet-delivery trace of mahimahi: a line an opportunity for 1500 bytes to cross the link, in milliseconds.

It is a capacity, not a series of packets. Read as a link it answers when a packet of the loop would arrive that is sent
every so often and fits into one opportunity: at the next one. Nothing is lost, it waits; so an outage is a time without
opportunities. At its end the trace begins again. Source: mm-link(1).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.rows import parts_of_rows
from agv_analysis.link.large_arrays import Column, column_of, is_increasing, parts
from agv_analysis.link.measurement import (
    RECEIVED,
    Malformed,
    Measurement,
    MeasurementError,
    PacketOutcomes,
    needs_packets,
)

_USUAL_INTERVAL = 0.005
"""Time between the packets that are asked about [s]: the usual sampling period."""

_MS = 1e-3

_MOST = 100_000_000
"""Packets that are asked about, at most."""


def _matches(head: bytes, path: Path) -> bool:
    lines = head.splitlines()
    lines = lines[:-1] if len(lines) > 1 and len(head) >= 65536 else lines  # the last one may be cut
    words = [line.strip() for line in lines if line.strip()]
    if not words or not all(word.isdigit() for word in words):
        return False
    times = np.array([int(word) for word in words])
    return bool(np.all(np.diff(times) >= 0)) and times[-1] > 1


def _read(path: Path, options: Options) -> Measurement:
    malformed, found = Malformed(), Column()
    for rows in parts_of_rows(path, 1, malformed, options.progress):
        found.extend(rows[:, 0])
    at = found.values
    needs_packets(len(at), str(path), "line of an opportunity", malformed)
    if not is_increasing(at) or not at[-1] > 0.0:
        raise MeasurementError(f"{path}: times of a mahimahi trace must not decrease, and end behind 0")
    interval = options.interval or _USUAL_INTERVAL
    if at[-1] * _MS / interval > _MOST:
        raise MeasurementError(f"{path}: lasts {at[-1] * _MS:g} s, too long for a packet every {interval:g} s")
    count = max(1, int(np.floor(at[-1] * _MS / interval + 1e-9)))
    again = at[0] + at[-1]
    sent, delays = Column(), Column()
    for part in parts(count, at):
        times = np.arange(part.start, part.stop) * interval
        place = np.searchsorted(at, (times - 1e-9) / _MS)
        arrives = np.where(place < len(at), at[np.minimum(place, len(at) - 1)], again) * _MS
        sent.extend(times)
        delays.extend(np.maximum(0.0, arrives - times))
    received = (np.full(part.stop - part.start, RECEIVED) for part in parts(count))
    note = (
        f"opportunities, not packets: one of up to 1500 byte is asked about every {interval:g} s (--interval), which "
        "waits for the next opportunity and is never lost"
    )
    return Measurement(
        source=str(path), format="mahimahi", sent=sent.values,
        uplink=PacketOutcomes(column_of(received, np.int8), delays.values),
        malformed=malformed, notes=(note,),
    )  # fmt: skip


FORMAT = Format("mahimahi", "packet-delivery trace of mahimahi", 60, _matches, _read)
