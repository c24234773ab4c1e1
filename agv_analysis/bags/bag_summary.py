"""What a bag holds, in a few lines."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags.bag import Attached, Bag, Topic
from agv_analysis.bags.layout import length_path
from agv_analysis.bags.topic_times import Silence, StampClock, periods_of, silences, stamp_clock
from agv_ros.counted import counted

_MOST_SILENCES = 5
"""Silences that are printed; all of them are in the JSON."""

_EVENTS, _EVENT = "/_service_event", "_Event"


@dataclass(frozen=True)
class TopicSummary:
    """One topic; times are log times [s], None where there are too few messages or they were not read."""

    name: str
    type: str
    messages: int
    encoding: str
    definition: str
    """Where the definition of the type is from, empty if it is missing."""
    first: float | None
    last: float | None
    rate: float | None
    """Messages per second between the first and the last."""
    period: float | None
    """Median time between messages that follow each other."""
    period_jitter: float | None
    """Standard deviation of these times, gaps left out."""
    longest_gap: float | None
    longest_gap_at: float | None
    gaps: int | None
    """Periods longer than 1.5 times the median."""
    clock: StampClock | None
    """Stamps against log times."""
    not_finite: dict[str, int]
    """Columns with NaN or infinite values -> how many messages have them."""


@dataclass(frozen=True)
class ServiceSummary:
    """A service whose events were recorded."""

    name: str
    type: str
    events: int


@dataclass(frozen=True)
class BagSummary:
    """A whole bag."""

    path: str
    distro: str
    """ROS distribution that recorded it, empty if it does not say."""
    is_complete: bool
    topics: tuple[TopicSummary, ...]
    services: tuple[ServiceSummary, ...]
    attachments: tuple[Attached, ...]
    metadata: dict[str, dict[str, str]]
    silences: tuple[Silence, ...]
    """Times without a message on any topic, the longest first."""
    problems: tuple[str, ...]

    def lines(self) -> Iterator[str]:
        """As text, a line at a time."""
        total = sum(topic.messages for topic in self.topics)
        times = [time for topic in self.topics for time in (topic.first, topic.last) if time is not None]
        by = f", recorded by ROS 2 {self.distro}" if self.distro else ""
        yield f"{self.path}: {counted(total, 'message')} on {counted(len(self.topics), 'topic')}{by}"
        if times:
            yield f"starts at {_date(min(times))}, lasts {max(times) - min(times):.3f} s"
        yield from _table([_HEAD, *(_cells(topic) for topic in self.topics)])
        clocks = [[topic.name, *_clock_cells(topic.clock)] for topic in self.topics if topic.clock is not None]
        if clocks:
            yield ""
            yield from _table([_CLOCK_HEAD, *clocks])
            yield ""
        for service in self.services:
            yield f"service {service.name} ({service.type}): {counted(service.events, 'event')}"
        for item in self.attachments:
            yield f"attachment {item.name} ({item.media_type}): {item.size} bytes, of {_date(item.log_time_ns / 1e9)}"
        for name, content in self.metadata.items():
            yield f"metadata {name}: {', '.join(content)}"
        for topic in self.topics:
            if not topic.definition and topic.encoding == "cdr":
                yield f"definition missing: {topic.type or 'a type without a name'}, of {topic.name}"
        for silence in self.silences[:_MOST_SILENCES]:
            yield f"no message at all for {silence.duration:.3f} s from {_date(silence.begin)} on"
        if len(self.silences) > _MOST_SILENCES:
            yield f"and {len(self.silences) - _MOST_SILENCES} shorter times without a message"
        for topic in self.topics:
            for column, count in topic.not_finite.items():
                yield f"problem: {topic.name}: {column} not finite: {count}"
        for problem in self.problems:
            yield f"problem: {problem}"
        yield "nothing is known to be missing" if self.is_complete else "the recording is not complete"

    def to_json(self) -> dict[str, Any]:
        """As a JSON object; what is a tuple with names here is an object there."""
        content = asdict(self)
        content["silences"] = [silence._asdict() for silence in self.silences]
        content["attachments"] = [item._asdict() for item in self.attachments]
        for topic, found in zip(self.topics, content["topics"], strict=True):
            found["clock"] = topic.clock._asdict() if topic.clock else None
        return content


# -- as text ----------------------------------------------------------------------------------------------------------

_HEAD = ["topic", "type", "messages", "rate [Hz]", "period [ms]", "jitter [ms]", "longest gap [s]", "gaps"]
_CLOCK_HEAD = ["log times against stamps of", "offset [s]", "drift [ppm]", "spread [ms]"]


def _table(rows: list[list[str]]) -> Iterator[str]:
    """Columns side by side; the first ones are texts, all others numbers."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    texts = 2 if rows[0] is _HEAD else 1
    for row in rows:
        cells = [
            cell.ljust(width) if place < texts else cell.rjust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        yield ("  " + "  ".join(cells)).rstrip()


def _cells(topic: TopicSummary) -> list[str]:
    return [
        topic.name, topic.type, str(topic.messages), _number(topic.rate, 1.0, 2), _number(topic.period, 1e3, 3),
        _number(topic.period_jitter, 1e3, 3), _number(topic.longest_gap, 1.0, 3), str(topic.gaps or ""),
    ]  # fmt: skip


def _clock_cells(clock: StampClock) -> list[str]:
    return [_number(clock.offset, 1.0, 6), _number(clock.drift, 1e6, 2), _number(clock.spread, 1e3, 3)]


def _number(value: float | None, factor: float, digits: int) -> str:
    return "" if value is None else f"{value * factor:.{digits}f}"


def _date(time: float) -> str:
    try:
        return datetime.fromtimestamp(time, timezone.utc).isoformat(sep=" ", timespec="milliseconds")
    except (OverflowError, ValueError, OSError):
        return f"{time:.3f} s"


# -- of a bag ---------------------------------------------------------------------------------------------------------


def describe(bag: Bag) -> BagSummary:
    """Summary of a bag; times and values of those topics only that were read."""
    topics = tuple(_topic(bag, topic) for topic in bag.topics.values())
    times = [bag.log_times(name) for name in bag.topics]
    return BagSummary(
        str(bag.path), bag.distro, bag.is_complete, topics, _services(bag.topics.values()), bag.attachments,
        bag.metadata, silences(np.concatenate(times or [np.zeros(0, np.int64)])), bag.problems,
    )  # fmt: skip


def _topic(bag: Bag, topic: Topic) -> TopicSummary:
    rows, times = bag.arrays.get(topic.name), bag.log_times(topic.name)
    clock = stamp_clock(rows) if rows is not None and len(rows) else None
    return TopicSummary(
        topic.name, topic.type, topic.count, topic.encoding, topic.definition, *periods_of(times), clock,
        _not_finite(rows) if rows is not None and len(rows) else {},
    )  # fmt: skip


def _services(topics: Iterable[Topic]) -> tuple[ServiceSummary, ...]:
    """Services by the topics on which ROS 2 publishes what they are asked and answer."""
    return tuple(
        ServiceSummary(topic.name.removesuffix(_EVENTS), topic.type.removesuffix(_EVENT), topic.count)
        for topic in topics
        if topic.name.endswith(_EVENTS) and "/srv/" in topic.type and topic.type.endswith(_EVENT)
    )


def _not_finite(rows: NDArray[np.void]) -> dict[str, int]:
    """Messages with NaN or infinite values, by column; a sequence is as long as it says, what follows is filling."""
    names = rows.dtype.names or ()
    counts = {}
    for name in names:
        parts = name.split(".")
        is_in_sequence = any(length_path(".".join(parts[: i + 1])) in names for i in range(len(parts)))
        if rows.dtype[name].base.kind == "f" and not is_in_sequence:
            finite = np.isfinite(rows[name]).reshape(len(rows), -1).all(axis=1)
            counts[name] = int(np.count_nonzero(~finite))
    return {name: count for name, count in counts.items() if count}
