"""A recording in memory: topics as arrays, what is written about it, what is wrong with it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags.batch import Batch
from agv_analysis.bags.errors import BagError, UndecodableError
from agv_analysis.bags.findings import Findings
from agv_analysis.bags.mcap_file import McapFile
from agv_analysis.bags.records import Channel, Schema
from agv_analysis.bags.schema import parse_schema
from agv_analysis.bags.table import Table


@dataclass(frozen=True)
class Topic:
    """One topic of a bag."""

    name: str
    type: str
    """As in "geometry_msgs/msg/PoseStamped"."""
    count: int
    """Messages that were found."""
    schema: str
    """The definition of its type, and of the types in it."""
    offered_qos: str
    """The publishers' QoS as the recorder wrote it (YAML), empty if it did not."""


@dataclass(frozen=True)
class Bag(Mapping[str, NDArray[np.void]]):
    """A recording: `bag[topic]` is a structured array, one row for each message, in file order.

    Its fields are `log_time_ns`, `publish_time_ns` [ns], and one for each value of the message by its dotted path:
    "header.stamp.sec", "pose.position.x". Strings are bytes of fixed width (S); arrays are sub-arrays, sequences too:
    as long as the longest, filled up with NaN, 0 or b"", their true lengths in the field "len(path)".
    """

    path: Path
    topics: dict[str, Topic]
    metadata: dict[str, dict[str, str]]
    """MCAP's Metadata records by name."""
    problems: tuple[str, ...]
    """Everything that was lost, could not be checked, or is not as it should be; in words, with counts."""
    is_complete: bool
    """Is nothing known to be missing?"""
    _arrays: dict[str, NDArray[np.void]] = field(repr=False)
    _refusals: dict[str, str] = field(repr=False)

    def __getitem__(self, topic: str) -> NDArray[np.void]:
        """Messages of a topic. Raises BagError if it is not in the bag, was not asked for, or cannot be decoded."""
        if topic in self._arrays:
            return self._arrays[topic]
        if topic in self._refusals:
            raise BagError(f"{self.path}: {topic}: {self._refusals[topic]}; its bytes are in payloads({topic!r})")
        if topic in self.topics:
            raise BagError(f"{self.path}: {topic} was not asked for when the bag was read")
        raise BagError(f"{self.path}: no topic {topic}; it has {', '.join(sorted(self.topics)) or 'none'}")

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)

    def payloads(self, topic: str) -> list[bytes]:
        """The messages of a topic as they were sent (CDR), in file order; reads the file again.

        Raises BagError if the topic is not in the bag.
        """
        if topic not in self.topics:
            self[topic]
        return [payload for _, batch in _batches(self.path, {topic}) for payload in batch.payloads()]


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    return sorted(path.glob("*.mcap"))


def _batches(path: Path, topics: Collection[str]) -> Iterator[tuple[Channel, Batch]]:
    for name in _files(path):
        file = McapFile(name)
        yield from file.batches(lambda channel: channel.topic in topics)
        file.close()


def read_bag(path: Path | str, topics: Collection[str] | None = None) -> Bag:
    """Read a rosbag2 directory, or a bare MCAP file.

    `topics`: those that are wanted as arrays, None for all. Raises BagError if there is no bag at `path`.
    """
    path = Path(path)
    if not path.exists():
        raise BagError(f"{path}: there is no such file or directory")
    files = _files(path)
    if not files:
        raise BagError(f"{path}: no .mcap file in this directory")
    reading = _Reading(topics)
    for name in files:
        reading.read(McapFile(name))
    return reading.bag(path)


class _Reading:
    """What has been read so far, over all files of a bag."""

    def __init__(self, topics: Collection[str] | None) -> None:
        self._wanted = topics
        self._findings = Findings()
        self._tables: dict[str, Table] = {}
        self._refusals: dict[str, str] = {}
        self._channels: dict[str, tuple[Channel, Schema | None]] = {}
        self._counts: dict[str, int] = {}
        self._metadata: dict[str, dict[str, str]] = {}

    def read(self, file: McapFile) -> None:
        for channel, batch in file.batches(lambda channel: self._wanted is None or channel.topic in self._wanted):
            self._take(file, channel, batch)
        for channel in file.channels.values():
            known = channel.topic in self._channels
            self._channels.setdefault(channel.topic, (channel, file.schemas.get(channel.schema_id)))
            self._counts[channel.topic] = self._counts.get(channel.topic, 0) + file.found.get(channel.id, 0)
            if not known and (self._wanted is None or channel.topic in self._wanted):
                self._table(file, channel)
        self._metadata.update(file.metadata)
        self._findings.merge(file.findings)
        file.close()

    def _table(self, file: McapFile, channel: Channel) -> Table | None:
        topic = channel.topic
        if topic in self._tables or topic in self._refusals:
            return self._tables.get(topic)
        schema = file.schemas.get(channel.schema_id)
        try:
            if channel.encoding != "cdr":
                raise UndecodableError(f"its messages are encoded as {channel.encoding!r}; only cdr is read")
            if schema is None:
                raise UndecodableError("the bag does not hold the definition of its type")
            expected = file.statistics.by_channel.get(channel.id, 0) if file.statistics else 0
            table = Table(parse_schema(schema.name, schema.encoding, schema.text), expected)
        except UndecodableError as error:
            self._refusals[topic] = f"cannot be decoded: {error}"
            return None
        return self._tables.setdefault(topic, table)

    def _take(self, file: McapFile, channel: Channel, batch: Batch) -> None:
        table = self._table(file, channel)
        if table is None:
            return
        try:
            table.append(batch)
        except UndecodableError as error:
            self._refusals[channel.topic] = f"cannot be decoded: {error}"
            del self._tables[channel.topic]

    def bag(self, path: Path) -> Bag:
        for topic, table in self._tables.items():
            if table.layouts.misfits:
                self._findings.add(
                    f"{topic}: message that is not of its type, left out ({table.layouts.first_misfit})",
                    table.layouts.misfits, is_loss=True,
                )  # fmt: skip
        topics = {name: self._topic(name) for name in sorted(self._channels)}
        refused = tuple(f"{topic}: {reason}" for topic, reason in self._refusals.items())
        return Bag(
            path, topics, self._metadata, self._findings.texts() + refused, not self._findings.is_loss,
            {name: table.rows for name, table in self._tables.items()}, self._refusals,
        )  # fmt: skip

    def _topic(self, name: str) -> Topic:
        channel, schema = self._channels[name]
        kind, text = (schema.name, schema.text) if schema else ("", "")
        qos = channel.metadata.get("offered_qos_profiles", "")
        return Topic(name, kind, self._counts.get(name, 0), text, qos)
