"""A recording in memory: topics as arrays, its metadata, and what is wrong with it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags.bag_errors import BagError, PaddingError, UndecodableError
from agv_analysis.bags.checks import check_times
from agv_analysis.bags.findings import Findings
from agv_analysis.bags.json_table import JsonTable
from agv_analysis.bags.known_types import UNDEFINED, Definition, KnownTypes, is_undefined
from agv_analysis.bags.layout import LEAD, LOG_TIME
from agv_analysis.bags.message_batch import Batch
from agv_analysis.bags.message_compression import inflated_batches
from agv_analysis.bags.message_table import Table, longest_in_proportion
from agv_analysis.bags.records import QOS, TYPE_HASH, Channel, Schema
from agv_analysis.bags.rosbag2 import Contents, locate, open_files
from agv_analysis.bags.schema import short_name
from agv_analysis.bags.storage import Storage, is_large
from agv_analysis.bags.topic_types import TopicTypes
from agv_analysis.bags.type_hash import contradicts
from agv_ros.counted import counted

_MOST_EXPECTED = 2
"""Messages a byte of the file for which room is made at once, whatever number a damaged file states.

The smallest record of one has 31 bytes, and a compressed chunk is hardly ever 60 times as large.
"""

_THREADS = 2
"""Topics that are checked at a time."""

Progress = Callable[[int], None]
"""Called with the share of a bag that has been read [%], every now and then."""


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
    encoding: str
    """How its messages are serialised: "cdr" for those of ROS 2."""
    definition: str
    """Where the definition of its type is from: "the bag", "ROS 2 humble", a folder; empty if it is missing."""


class Attached(NamedTuple):
    """What is known of a file that was put into a recording; `recover` copies its content."""

    name: str
    media_type: str
    size: int
    """[B]."""
    log_time_ns: int
    create_time_ns: int


@dataclass(frozen=True)
class Bag:
    """A recording: `bag[topic]` is a structured array, one row for each message, in file order.

    Its fields are `log_time_ns`, `publish_time_ns` [ns], and one for each value of the message by its dotted path:
    "header.stamp.sec", "pose.position.x". Strings are bytes of fixed width (S); arrays are sub-arrays, sequences too:
    as long as the longest, filled up with NaN, 0 or b"", their true lengths in the field "len(path)".
    """

    path: Path
    topics: dict[str, Topic]
    """All topics of the bag, including those that were not requested."""
    metadata: dict[str, dict[str, str]]
    """MCAP's Metadata records by name; of several with one name the last."""
    problems: tuple[str, ...]
    """Everything that was lost, could not be checked, or is not as it should be; in words, with counts."""
    is_complete: bool
    """Is nothing known to be missing?"""
    attachments: tuple[Attached, ...]
    """MCAP's Attachment records, in file order."""
    distro: str
    """ROS distribution that recorded the bag, empty if it does not say."""
    arrays: dict[str, NDArray[np.void]] = field(repr=False)
    """The topics that were asked for and could be decoded; `bag[topic]` says of the others why they are not here."""
    _refusals: dict[str, str] = field(repr=False)
    _log_times: dict[str, NDArray[np.int64]] = field(repr=False)

    def log_times(self, topic: str) -> NDArray[np.int64]:
        """Log times [ns] of a topic's messages, in file order, if it was asked for, whether or not it can be decoded.

        Empty if it was not; without those messages that are not of their type.
        """
        if topic in self.arrays:
            return np.ascontiguousarray(self.arrays[topic][LOG_TIME])
        return self._log_times.get(topic, np.zeros(0, np.int64))

    def __getitem__(self, topic: str) -> NDArray[np.void]:
        """Messages of a topic. Raises BagError if it is not in the bag, was not asked for, or cannot be decoded."""
        if topic in self.arrays:
            return self.arrays[topic]
        if topic in self._refusals:
            raise BagError(f"{self.path}: {topic}: {self._refusals[topic]}; its bytes are in payloads({topic!r})")
        if topic in self.topics:
            raise BagError(f"{self.path}: {topic} was not asked for when the bag was read")
        raise BagError(f"{self.path}: no topic {topic}; it has {', '.join(sorted(self.topics)) or 'none'}")

    def __contains__(self, topic: object) -> bool:
        return topic in self.arrays

    def payloads(self, topic: str) -> list[bytes]:
        """The messages of a topic as they were sent (CDR), in file order; reads the file again.

        Raises BagError if the topic is not in the bag.
        """
        if topic not in self.topics:
            raise BagError(f"{self.path}: no topic {topic}; it has {', '.join(sorted(self.topics)) or 'none'}")
        return [
            payload
            for storage in open_files(locate(self.path))
            for _, batch in inflated_batches(storage, lambda channel: channel.topic == topic, Findings())
            for payload in batch.payloads()
        ]


def read_bag(
    path: Path | str,
    topics: Collection[str] | None = None,
    progress: Progress | None = None,
    definitions: Path | str | None = None,
) -> Bag:
    """Read a rosbag2 directory, split or not, with metadata.yaml or without, or a .mcap or .db3 file, packed or not.

    `topics`: those that are wanted as arrays, None for all; an empty collection reads what the bag holds and checks it.
    `definitions`: a folder with .msg, .idl or .srv files of types that the bag does not define.
    Whatever is wrong with the bag is in its `problems`. Raises BagError if there is no bag at `path`, or one of which
    nothing can be read.
    """
    path = Path(path)
    known = KnownTypes(None if definitions is None else Path(definitions))
    bag, padded = _read(path, topics, progress, known, {})
    longest = {topic: size for topic in padded if (size := _longest_kept(path, topic)) is not None}
    return _read(path, topics, progress, known, longest)[0] if longest else bag


def _longest_kept(path: Path, topic: str) -> int | None:
    """Bytes of the longest messages of a topic that are kept, if a few longer ones keep all from being an array."""
    sizes: Counter[int] = Counter()
    for storage in open_files(locate(path)):
        for _, batch in inflated_batches(storage, lambda channel: channel.topic == topic, Findings()):
            sizes.update(batch.sizes.tolist())
    return longest_in_proportion(sizes)


def _read(
    path: Path, topics: Collection[str] | None, progress: Progress | None, known: KnownTypes, longest: dict[str, int]
) -> tuple[Bag, list[str]]:
    """A bag, and its topics whose messages differ too much in length; `longest`: bytes up to which they are taken."""
    contents = locate(path)
    types = TopicTypes(contents, known)
    with ThreadPoolExecutor(1, "pages") as helper:
        reading = _Reading(topics, helper, contents, types, longest)
        for number, storage in enumerate(open_files(contents)):
            for channel, batch in inflated_batches(storage, reading.is_wanted, contents.findings):
                reading.take(storage, channel, batch)
                if progress is not None:
                    share = storage.position / max(1, storage.size)
                    progress(int(100 * (number + share) / len(contents.files)))
            reading.finish(storage)
        return reading.bag(path), reading.padded


class _Reading:
    """What has been read so far, over all files of a bag."""

    def __init__(
        self, topics: Collection[str] | None, helper: Executor, contents: Contents, types: TopicTypes,
        longest: dict[str, int],
    ) -> None:  # fmt: skip
        self._longest = longest
        self.padded: list[str] = []
        """Topics whose messages differ too much in length."""
        self._helper = helper
        self._contents = contents
        self._types = types
        self._wanted = None if topics is None else frozenset(topics)
        self._findings = Findings()
        self._known: dict[str, tuple[Channel, Schema | None]] = {}
        self._borrowed: dict[str, Definition] = {}
        self._first: dict[str, Definition] = {}
        self._silent: dict[str, tuple[Storage, Channel]] = {}
        self._tables: dict[str, Table | JsonTable] = {}
        self._refusals: dict[str, str] = {}
        self._counts: Counter[str] = Counter()
        self._metadata: dict[str, dict[str, str]] = {}
        self._attachments: list[Attached] = []
        self._distro = ""
        self._undecoded: dict[str, list[NDArray[np.int64]]] = {}
        self._latest: dict[int, tuple[Channel, Schema | None, Table | JsonTable | None]] = {}

    def is_wanted(self, channel: Channel) -> bool:
        """Are the messages of this channel asked for? Of those that cannot be decoded, the times are kept."""
        return self._wanted is None or channel.topic in self._wanted

    def take(self, storage: Storage, channel: Channel, batch: Batch) -> None:
        """Add a batch to the table of its topic; a topic that cannot be decoded is given up."""
        schema = storage.schemas.get(channel.schema_id)
        latest = self._latest.get(channel.id)
        if latest is None or latest[0] is not channel or latest[1] is not schema:
            latest = self._latest[channel.id] = channel, schema, self._table(storage, channel, batch)
        table = latest[2]
        if table is None:
            self._undecoded.setdefault(channel.topic, []).append(batch.log_times)
            return
        try:
            table.append(batch)
        except UndecodableError as error:
            self._refuse(channel.topic, error)
            self._undecoded.setdefault(channel.topic, []).append(batch.log_times)

    def finish(self, storage: Storage) -> None:
        """Take over what is known of a file after its last message."""
        for number, channel in storage.channels.items():
            self._counts[channel.topic] += storage.counts[number]
            self._known.setdefault(channel.topic, (channel, self._types.named(storage, channel)))
            if self.is_wanted(channel):
                self._silent.setdefault(channel.topic, (storage, channel))
        self._metadata.update(storage.metadata)
        self._distro = self._distro or storage.distro or self._contents.distro
        self._attachments += [
            Attached(item.name, item.media_type, item.size, item.log_time, item.create_time)
            for item in storage.attachments
        ]
        self._findings.merge(storage.findings)

    def _table(self, storage: Storage, channel: Channel, batch: Batch | None) -> Table | JsonTable | None:
        """The table of a channel's topic, None if its messages cannot be decoded; `batch`: some of them."""
        topic = channel.topic
        self._known.setdefault(topic, (channel, self._types.named(storage, channel)))
        if topic in self._refusals or (batch is None and topic in self._tables):
            return self._tables.get(topic)
        try:
            if channel.encoding == "json":
                return self._tables.setdefault(topic, JsonTable())
            if channel.encoding != "cdr":
                raise UndecodableError(f"its messages are encoded as {channel.encoding!r}; cdr and json are read")
            if batch is None:
                definition = self._types.without_messages(storage, channel)
            else:
                definition = self._types.define(storage, channel, batch)
            if definition.is_worth_a_note:
                self._borrowed[topic] = definition
            first = self._first.setdefault(topic, definition)
            if first.form != definition.form or short_name(first.schema.name) != short_name(definition.schema.name):
                one, other = first.schema.name, definition.schema.name
                raise UndecodableError(f"it has messages of two types, {one} and {other}")
            if topic not in self._tables:
                self._known[topic] = channel, definition.schema
                schema = definition.schema
                if contradicts(schema.name, schema.text, channel.metadata.get(TYPE_HASH, "")):
                    what = "definition of its type that does not match the recorded hash, so that values may be wrong"
                    self._findings.add(f"{topic}: {what}")
                helper = self._helper if is_large(storage.size) else None
                expected = min(storage.expected(channel.id), _MOST_EXPECTED * storage.size)
                longest = self._longest.get(topic)
                self._tables[topic] = Table(definition.form, expected, helper, longest)
        except UndecodableError as error:
            self._refuse(topic, error)
        return self._tables.get(topic)

    def _refuse(self, topic: str, error: UndecodableError) -> None:
        self._refusals[topic] = f"cannot be decoded: {error}"
        if isinstance(error, PaddingError):
            self.padded.append(topic)
        table = self._tables.pop(topic, None)
        if isinstance(table, Table) and len(table.rows):
            self._undecoded.setdefault(topic, []).append(table.rows[LOG_TIME].copy())
        self._latest.clear()

    def _doubt(self, topic: str, table: Table | JsonTable) -> None:
        """Give up a definition from elsewhere that does not describe most messages of a topic."""
        found = self._counts[topic]
        if isinstance(table, Table) and found and 2 * table.misfits >= found:
            about = (
                f"that of {self._borrowed[topic].source} does not describe {table.misfits} of its "
                f"{counted(found, 'message')}"
            )
            self._refuse(topic, UndecodableError(f"{UNDEFINED}, and {about}"))

    def bag(self, path: Path) -> Bag:
        """The bag, once all files have been read."""
        for storage, channel in self._silent.values():
            self._table(storage, channel, None)
        for topic in self._borrowed.keys() & self._tables.keys():
            self._doubt(topic, self._tables[topic])
        for topic, table in list(self._tables.items()):
            if isinstance(table, JsonTable) and len(table.strange_times):
                self._undecoded.setdefault(topic, []).append(table.strange_times)
                self._refuse(topic, UndecodableError(table.first_misfit))
        arrays: dict[str, NDArray[np.void]] = {}
        for topic, table in sorted(self._tables.items()):
            try:
                arrays[topic] = table.rows
            except UndecodableError as error:
                self._refuse(topic, error)
        self._findings.merge(self._contents.findings)
        self._contents.compare({name: self._topic(name) for name in self._known}, self._findings)
        for topic, table in sorted(self._tables.items()):
            if table.misfits:
                what = f"{topic}: message that is not of its type, left out ({table.first_misfit})"
                self._findings.add(what, table.misfits, is_loss=True)
            if isinstance(table, Table) and table.overlong:
                limit = f"message of more than {self._longest[topic] - LEAD} bytes"
                what = f"{topic}: {limit}, far longer than the others, left out"
                self._findings.add(what, table.overlong, is_loss=True)
        unclear = [topic for topic in arrays if not self._tables[topic].is_orderly]
        with ThreadPoolExecutor(_THREADS, "bag") as pool:
            for found in pool.map(check_times, unclear, map(arrays.__getitem__, unclear)):
                self._findings.merge(found)
        for topic, definition in sorted(self._borrowed.items()):
            if topic in arrays:
                self._findings.add(f"{topic}: {definition.note} used")
        for topic, reason in sorted(self._refusals.items()):
            self._findings.add(f"{topic}: topic that {reason}")
        topics = {name: self._topic(name) for name in sorted(self._known)}
        findings = self._findings
        times = {topic: np.concatenate(parts) for topic, parts in self._undecoded.items()}
        return Bag(
            path, topics, self._metadata, findings.texts(), not findings.is_loss, tuple(self._attachments),
            self._distro, arrays, self._refusals, times,
        )  # fmt: skip

    def _topic(self, name: str) -> Topic:
        channel, schema = self._known[name]
        kind, text = (schema.name, schema.text) if schema else ("", "")
        has_own = schema is not None and not is_undefined(schema)
        source = "the bag" if has_own or name in self._tables else ""
        if name in self._borrowed:
            source = self._borrowed[name].source
        return Topic(
            name, kind, self._counts[name], text, channel.metadata.get(QOS, ""), channel.encoding, source,
        )  # fmt: skip
