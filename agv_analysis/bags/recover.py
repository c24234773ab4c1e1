"""A damaged bag -> a sound one with every complete message.

A message is copied whether or not its definition is known and describes it: the definition may be what is wrong.
"""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import yaml

from agv_analysis.bags.bag import Progress
from agv_analysis.bags.bag_errors import BagError, UndecodableError
from agv_analysis.bags.checksum import crc32
from agv_analysis.bags.findings import Findings
from agv_analysis.bags.known_types import Definition, KnownTypes
from agv_analysis.bags.mcap_writer import McapWriter
from agv_analysis.bags.message_batch import Batch, Layouts
from agv_analysis.bags.message_compression import inflated_batches
from agv_analysis.bags.records import DATA_END_SIZE, FOOTER_SIZE, MAGIC, QOS, RECORD, TYPE_HASH, Channel, Schema
from agv_analysis.bags.rosbag2 import METADATA, Contents, locate, open_files
from agv_analysis.bags.rosbag2_metadata import TopicInfo, metadata_text, rosbag2_metadata
from agv_analysis.bags.storage import Storage
from agv_analysis.bags.topic_types import TopicTypes

_PIECE = 2**20

_CHUNK = 2**20
"""Size of a chunk [B]."""


class Recovery(NamedTuple):
    """What the new bag holds, and what the damaged one no longer did."""

    counts: dict[str, int]
    """Messages by topic."""
    problems: tuple[str, ...]
    is_complete: bool
    """Is nothing known to be missing?"""


def recover(path: Path, out: Path, progress: Progress | None = None, definitions: Path | None = None) -> Recovery:
    """Write every whole message of a bag, as it was sent, to a new one, in file order, with all checksums and indexes.

    `out` becomes an MCAP file if its name ends in .mcap, else a rosbag2 directory. Of a message's record only the
    sequence number is not kept. A definition that the bag lacks is added from `definitions`, a folder, or from a ROS 2
    distribution, if that is known to describe the messages. Raises BagError if nothing can be read, or if `out` exists
    or cannot be written.
    """
    contents = locate(path)
    types = TopicTypes(contents, KnownTypes(definitions), is_thorough=True)
    is_file = out.suffix == ".mcap"
    writing = out.with_name(out.name + ".part")
    if out.exists() or writing.exists():
        raise BagError(f"{out if out.exists() else writing}: exists already; name a new one or remove it first")
    try:
        writing.parent.mkdir(parents=True, exist_ok=True)
        if not is_file:
            writing.mkdir()
        target = writing if is_file else writing / f"{out.name}_0.mcap"
        try:
            copy = _Copy(target, out.name if is_file else target.name, contents, types)
            for number, storage in enumerate(open_files(contents, keep_all=True)):
                for share in copy.add(storage):
                    if progress is not None:
                        progress(int(100 * (number + share) / len(contents.files)))
            copy.close(None if is_file else writing / METADATA)
            writing.rename(out)
        except BaseException:
            shutil.rmtree(writing) if writing.is_dir() else writing.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise BagError(f"{out}: cannot be written: {error.strerror}") from None
    copy.findings.merge(contents.findings)
    return Recovery(dict(sorted(copy.counts.items())), copy.findings.texts(), not copy.findings.is_loss)


class _Checked:
    """Messages of one topic and definition, and how many of them the definition does not describe."""

    def __init__(self, channel: Channel, schema: Schema | None, define: Callable[[], Definition]) -> None:
        """`schema` is what the bag says of the type, `define` gives its definition, from wherever there is one."""
        self._layouts: Layouts | None = None
        self.schema = schema
        """With a definition from elsewhere if the bag has none and that describes its messages."""
        self._definition: Definition | None = None
        self._reason = ""
        """Why messages cannot be held against the definition, if so."""
        self._count = 0
        try:
            if channel.encoding != "cdr":
                raise UndecodableError(f"they are encoded as {channel.encoding!r}")
            self._definition = define()
            self.schema = self._definition.schema
            self._layouts = Layouts(self._definition.form)
        except UndecodableError as error:
            self._reason = str(error)

    def take(self, batch: Batch) -> None:
        """Hold messages against the definition."""
        self._count += len(batch)
        try:
            if self._layouts is not None:
                self._layouts.split(batch)
        except UndecodableError as error:
            self._layouts, self._reason = None, str(error)

    def report(self, topic: str, findings: Findings) -> None:
        """Say which messages were copied although nothing describes them."""
        if self._definition is not None and self._definition.is_worth_a_note:
            findings.add(f"{topic}: {self._definition.note} written")
        if self._reason and self._count:
            findings.add(f"{topic}: message copied as it is, unchecked ({self._reason})", self._count)
        elif self._layouts is not None and self._layouts.misfits:
            is_damage = self._layouts.misfits < self._count  # else it is the definition that is wrong
            what = f"{topic}: message that its definition does not describe, copied as it is"
            findings.add(f"{what} ({self._layouts.first_misfit})", self._layouts.misfits, is_loss=is_damage)


class _Copy:
    """A new MCAP file in the course of being written."""

    def __init__(self, path: Path, name: str, contents: Contents, types: TopicTypes) -> None:
        """`name`: what the file is called in the end."""
        self._name = name
        self._distro = contents.distro
        self._has_foreign = False
        self._contents = contents
        self._types = types
        self.findings = Findings()
        self.counts: Counter[str] = Counter()
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[Any, ...], int] = {}
        self._topics: dict[str, TopicInfo] = {}
        self._checked: dict[tuple[str, str, int], _Checked] = {}
        self._first_ns, self._last_ns = 2**63 - 1, 0
        self._file = path.open("x+b")
        self._writer = McapWriter(self._file, _CHUNK, "agv_ncs")

    def add(self, storage: Storage) -> Iterator[float]:
        """Copy all that is whole in a file; yields the share that is done."""
        batches = inflated_batches(storage, lambda channel: True, self.findings)
        # The key holds on to the buffer, so that no other one can have its id.
        for _, part in groupby(batches, key=lambda found: (id(found[1].buffer), found[1].buffer)):
            for channel, log_time, publish_time, payload in _in_file_order(self._look(storage, part)):
                number = self._channel(storage, channel)
                self._writer.add_message(number, log_time, payload, publish_time)
                self.counts[channel.topic] += 1
                self._first_ns, self._last_ns = min(self._first_ns, log_time), max(self._last_ns, log_time)
            yield storage.position / max(1, storage.size)
        for record in storage.foreign:
            self._file.write(RECORD.pack(record.opcode, len(record.content)) + record.content)
            self._has_foreign = True
        self._distro = self._distro or storage.distro
        for channel in storage.channels.values():
            self._channel(storage, channel)
        for name, content in storage.metadata:
            if name != "rosbag2":  # counts the messages of the damaged bag
                self._writer.add_metadata(name, content)
        for item in storage.attachments:
            self._writer.add_attachment(item.create_time, item.log_time, item.name, item.media_type, item.content)
        self.findings.merge(storage.findings)

    def _look(self, storage: Storage, batches: Iterator[tuple[Channel, Batch]]) -> Iterator[tuple[Channel, Batch]]:
        """The batches, each held against the definition of its topic."""
        for channel, batch in batches:
            key = (str(storage.path), channel.topic, channel.id)
            if key not in self._checked:
                self._checked[key] = self._first(storage, channel, batch)
            self._checked[key].take(batch)
            yield channel, batch

    def _first(self, storage: Storage, channel: Channel, batch: Batch) -> _Checked:
        """What the first messages of a channel are held against."""
        schema = self._types.named(storage, channel)
        return _Checked(channel, schema, lambda: self._types.define(storage, channel, batch))

    def _channel(self, storage: Storage, channel: Channel) -> int:
        """Number of a channel in the clean file."""
        checked = self._checked.get((str(storage.path), channel.topic, channel.id))
        schema = checked.schema if checked is not None else storage.schemas.get(channel.schema_id)
        schema_id = 0
        if schema is not None:
            about = (schema.name, schema.encoding, schema.data)
            if about not in self._schemas:
                self._schemas[about] = self._writer.register_schema(*about)
            schema_id = self._schemas[about]
        key = (channel.topic, channel.encoding, schema_id, *sorted(channel.metadata.items()))
        if key not in self._channels:
            self._channels[key] = self._writer.register_channel(
                channel.topic, channel.encoding, schema_id, channel.metadata
            )
            self._topics.setdefault(channel.topic, _topic_info(channel, schema.name if schema else ""))
        return self._channels[key]

    def close(self, metadata: Path | None) -> None:
        """Write the index and, for a directory, its metadata.yaml."""
        for (_, topic, _), checked in self._checked.items():
            checked.report(topic, self.findings)
        topics = [(topic, self.counts[name]) for name, topic in sorted(self._topics.items())]
        first = min(self._first_ns, self._last_ns)
        about = rosbag2_metadata(self._name, first, self._last_ns, topics, self._distro, self._contents.custom_data)
        if metadata is not None or self._distro:
            self._writer.add_metadata("rosbag2", {"serialized_metadata": metadata_text(about)})
        if metadata is not None:
            metadata.write_text(metadata_text({"rosbag2_bagfile_information": about}), encoding="utf-8")
        self._writer.finish()
        if self._has_foreign:
            _seal(self._file)
        self._file.close()


def _seal(file: BinaryIO) -> None:
    """Put the CRC of the data section right, which the library computes without records that it did not write."""
    file.seek(RECORD.size - FOOTER_SIZE - len(MAGIC), os.SEEK_END)
    data_end = int.from_bytes(file.read(8), "little") - DATA_END_SIZE
    crc, left = 0, data_end
    file.seek(0)
    while left and (piece := file.read(min(left, _PIECE))):
        crc, left = crc32(piece, crc), left - len(piece)
    file.seek(data_end + RECORD.size)
    file.write(crc.to_bytes(4, "little"))


def _in_file_order(batches: Iterator[tuple[Channel, Batch]]) -> Iterator[tuple[Channel, int, int, bytes]]:
    """Messages of batches that share a buffer: channel, log time, publish time, payload."""
    messages = [
        (start, channel, log_time, publish_time, payload)
        for channel, batch in batches
        for start, log_time, publish_time, payload in zip(
            batch.starts.tolist(), batch.log_times.tolist(), batch.publish_times.tolist(), batch.payloads(), strict=True
        )
    ]
    messages.sort(key=lambda message: message[0])
    for _, channel, log_time, publish_time, payload in messages:
        yield channel, log_time % 2**64, publish_time % 2**64, payload


def _topic_info(channel: Channel, kind: str) -> TopicInfo:
    try:
        qos = yaml.safe_load(channel.metadata.get(QOS, "")) or []
    except yaml.YAMLError:
        qos = []
    type_hash = channel.metadata.get(TYPE_HASH, "")
    return TopicInfo(channel.topic, kind, "", type_hash, qos if isinstance(qos, list) else [], channel.encoding)
