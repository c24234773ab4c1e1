"""What a bag holds, in a few lines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags.bag import Bag
from agv_analysis.bags.layout import LOG_TIME, length_path
from agv_ros.stamps import NS_PER_S


@dataclass(frozen=True)
class TopicSummary:
    """One topic; times are log times."""

    name: str
    type: str
    messages: int
    first: float | None
    """Of the first message [s], None if there is none or it was not decoded."""
    last: float | None
    rate: float | None
    """Messages per second between the first and the last, None if these are not apart."""
    longest_gap: float | None
    """Longest time between two messages that follow each other [s]."""
    not_finite: dict[str, int]
    """Columns with NaN or infinite values -> how many messages have them."""


@dataclass(frozen=True)
class BagSummary:
    """A whole bag."""

    path: str
    is_complete: bool
    topics: tuple[TopicSummary, ...]
    metadata: dict[str, dict[str, str]]
    problems: tuple[str, ...]

    def lines(self) -> Iterator[str]:
        """As text, a line at a time."""
        total = sum(topic.messages for topic in self.topics)
        times = [time for topic in self.topics for time in (topic.first, topic.last) if time is not None]
        yield f"{self.path}: {total} messages on {len(self.topics)} topics"
        if times:
            yield f"from {_date(min(times))} on, for {max(times) - min(times):.3f} s"
        name_width = max((len(topic.name) for topic in self.topics), default=0)
        type_width = max((len(topic.type) for topic in self.topics), default=0)
        for topic in self.topics:
            rate = f"{topic.rate:10.2f} Hz" if topic.rate is not None else " " * 13
            gap = f"  longest gap {topic.longest_gap:.3f} s" if topic.longest_gap is not None else ""
            yield f"  {topic.name:{name_width}}  {topic.type:{type_width}}  {topic.messages:9}{rate}{gap}".rstrip()
        for name, content in self.metadata.items():
            yield f"metadata {name}: {', '.join(content)}"
        for topic in self.topics:
            for column, count in topic.not_finite.items():
                yield f"problem: {topic.name}: {column} not finite: {count}"
        for problem in self.problems:
            yield f"problem: {problem}"
        yield "nothing is known to be missing" if self.is_complete else "the recording is not complete"

    def to_json(self) -> dict[str, Any]:
        """As a JSON object."""
        return asdict(self)


def describe(bag: Bag) -> BagSummary:
    """Summary of a bag; times and values of those topics only that were read."""
    topics = tuple(_topic(name, topic.type, topic.count, bag.arrays.get(name)) for name, topic in bag.topics.items())
    return BagSummary(str(bag.path), bag.is_complete, topics, bag.metadata, bag.problems)


def _topic(name: str, kind: str, count: int, rows: NDArray[np.void] | None) -> TopicSummary:
    if rows is None or not len(rows):
        return TopicSummary(name, kind, count, None, None, None, None, {})
    times = rows[LOG_TIME] / NS_PER_S
    gaps = np.diff(np.sort(rows[LOG_TIME])) / NS_PER_S
    span = float(gaps.sum())
    return TopicSummary(
        name, kind, count, float(times.min()), float(times.max()), len(gaps) / span if span else None,
        float(gaps.max()) if len(gaps) else None, _not_finite(rows),
    )  # fmt: skip


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


def _date(time: float) -> str:
    try:
        return datetime.fromtimestamp(time, timezone.utc).isoformat(sep=" ", timespec="milliseconds")
    except (OverflowError, ValueError, OSError):
        return f"{time:.3f} s"
