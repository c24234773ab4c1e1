"""A topic of a recording: stamps of the messages that came, and when they were logged.

The edge's own slots, `edge/slot`, say of every message what became of it. Of any other topic with headers the stamps
are on a grid of the median period, and a place of the grid without a message was lost; the delay is the time from the
stamp to the log. Without stamps only the log times are known: a gap of more than one and a half periods is a loss.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags import Bag, read_bag
from agv_analysis.bags.bag_errors import BagError
from agv_analysis.bags.rosbag2 import looks_like_bag
from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.measurement import (
    LOST,
    RECEIVED,
    Measurement,
    MeasurementError,
    PacketOutcomes,
    needs_memory,
)
from agv_analysis.link.packet_grid import PacketGrid
from agv_analysis.recordings.sampling import period_of
from agv_ros.counted import counted

Times = NDArray[np.int64]

_NS = 1e-9
_SLOTS = ("edge/slot", "agv/slot")
_MOST = 100_000_000
"""Places of a grid: stamps that need more are on none."""

_LEAST = 100
"""Bytes that a message takes in memory, at least."""


def _matches(head: bytes, path: Path) -> bool:
    return looks_like_bag(path, head)


def _read(path: Path, options: Options) -> Measurement:
    held = _read_bag(path, (), options)
    slots = [topic for name in _SLOTS for topic in held.topics if topic.strip("/").endswith(name)]
    if not options.topic and slots:
        needs_memory(path, _LEAST * sum(held.topics[topic].count for topic in slots))
        return _of_slots(_read_bag(path, slots, options), slots)
    topics = [topic for topic in held.topics if topic.strip("/") == options.topic.strip("/")]
    if not topics:
        known = ", ".join(f"{name} ({topic.count})" for name, topic in sorted(held.topics.items()))
        asked = f"has no topic {options.topic}" if options.topic else "is a recording: name a topic with --topic"
        raise MeasurementError(f"{path}: {asked}; it has {known}")
    needs_memory(path, _LEAST * held.topics[topics[0]].count)
    return measure_topic(_read_bag(path, topics, options), topics[0], options.interval)


def _read_bag(path: Path, topics: Collection[str], options: Options) -> Bag:
    """A bag with the messages of some topics. Raises MeasurementError."""
    progress = options.progress
    try:
        return read_bag(path, topics, progress=None if progress is None else lambda percent: progress(percent / 100.0))
    except BagError as error:
        raise MeasurementError(str(error)) from None


def _stamps(rows: NDArray[np.void], name: str = "header.stamp") -> Times | None:
    """Stamps [ns], None if the messages have none."""
    names = rows.dtype.names or ()
    if f"{name}.sec" not in names:
        return None
    return np.asarray(rows[f"{name}.sec"].astype(np.int64) * 10**9 + rows[f"{name}.nanosec"].astype(np.int64))


def _of_slots(bag: Bag, topics: list[str]) -> Measurement:
    """Both links of this loop, by their slots."""
    found = {}
    for topic in topics:
        rows = bag[topic]
        stamps = _stamps(rows)
        if stamps is None or not len(rows):
            continue
        stamps, at = np.unique(stamps, return_index=True)
        lost = rows["source"][at] == b"lost"
        delay = np.where(lost, np.nan, 0.0)
        if topic.strip("/").endswith(_SLOTS[0]):
            found["uplink"] = stamps, np.where(lost, LOST, RECEIVED).astype(np.int8), delay
        else:
            found["downlink"] = stamps, np.where(lost, LOST, RECEIVED).astype(np.int8), delay
    if not found:
        raise MeasurementError(f"{bag.path}: its slots are empty")
    common = None
    for stamps, _, _ in found.values():
        common = stamps if common is None else np.intersect1d(common, stamps)
    assert common is not None
    if not len(common):
        raise MeasurementError(f"{bag.path}: its slots of both links have no step in common")
    ways = {name: PacketOutcomes(codes[np.searchsorted(stamps, common)]) for name, (stamps, codes, _) in found.items()}
    step = int(np.median(np.diff(common))) if len(common) > 1 else 0
    missing = 0 if step == 0 else round((int(common[-1]) - int(common[0])) / step) + 1 - len(common)
    notes = (f"{counted(missing, 'slot is', 'slots are')} missing from the recording",) if missing else ()
    return Measurement(
        source=str(bag.path), format="bag", sent=(common - common[0]) * _NS, uplink=ways.get("uplink"),
        downlink=ways.get("downlink"), notes=(*notes, "outcomes are those that the relay recorded slot by slot"),
    )  # fmt: skip


def measure_topic(bag: Bag, topic: str, period: float | None = None) -> Measurement:
    """What was lost of a topic that is sent every `period` [s], by default what most of its messages are apart.

    Raises MeasurementError if that has no answer.
    """
    logged = bag.log_times(topic)
    if len(logged) < 3:
        raise MeasurementError(f"{bag.path}: {topic} has {counted(len(logged), 'message')}: too few for a period")
    stamps = _stamps(bag.arrays[topic]) if topic in bag.arrays else None
    notes = []
    if stamps is not None and not stamps.all():
        notes.append(
            f"{counted(int(np.count_nonzero(stamps == 0)), 'message has', 'messages have')} no stamp: the log times "
            "stand for all of them"
        )
        stamps = None
    elif stamps is None:
        notes.append("the messages have no stamps: the log times stand for them")
    times = logged if stamps is None else stamps
    period = round(period / _NS) if period else round(period_of(np.asarray(np.diff(np.unique(times)), np.int64)))
    if period <= 0 or (int(times.max()) - int(times.min())) // period > _MOST:
        raise MeasurementError(f"{bag.path}: the stamps of {topic} are on no grid")
    seq = _places(times, period)
    delay = np.full(len(logged), np.nan) if stamps is None else np.asarray((logged - stamps) * _NS, dtype=np.float64)
    if stamps is not None:
        notes.append("delays are from stamp to log, and as good as the clocks of robot and recorder agree")
    packets = PacketGrid(delays=1)
    packets.add(seq, (delay,), np.asarray((times - times.min()) * _NS, dtype=np.float64))
    grid = packets.whole(period * _NS)
    return Measurement(
        source=f"{bag.path}:{topic}", format="bag", sent=grid.sent,
        uplink=PacketOutcomes(grid.outcome, None if stamps is None else grid.delays[0]), duplicates=grid.duplicates,
        reordered=grid.reordered, notes=tuple(notes),
    )  # fmt: skip


def _places(times: Times, period: int) -> Times:
    """The place of each message on a grid, counted from one message to the next: a period is never known exactly."""
    order = np.argsort(times, kind="stable")
    gaps = np.diff(times[order])
    steps = np.where(gaps == 0, 0, np.maximum(1, np.round(gaps / period))).astype(np.int64)
    places = np.empty(len(times), dtype=np.int64)
    places[order] = np.concatenate(([0], np.cumsum(steps)))
    return places


FORMAT = Format("bag", "topic of a ROS 2 bag", 5, _matches, _read, ("topic",))
