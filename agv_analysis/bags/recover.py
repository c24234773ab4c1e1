"""A damaged bag -> a clean one with every complete message."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from mcap.writer import CompressionType, Writer

from agv_analysis.bags.bag import Progress
from agv_analysis.bags.bag_errors import BagError, UndecodableError
from agv_analysis.bags.findings import Findings
from agv_analysis.bags.message_batch import Batch, Layouts
from agv_analysis.bags.records import TYPE_HASH, Channel
from agv_analysis.bags.rosbag2 import METADATA, locate, open_files
from agv_analysis.bags.schema import parse_schema
from agv_analysis.bags.storage import Storage
from agv_analysis.bags.writer import TopicInfo, metadata_text, rosbag2_metadata


class Recovery(NamedTuple):
    """What a clean bag holds, and what the damaged one no longer did."""

    counts: dict[str, int]
    """Messages by topic."""
    problems: tuple[str, ...]
    is_complete: bool
    """Is nothing known to be missing?"""


def recover(path: Path, out: Path, progress: Progress | None = None) -> Recovery:
    """Write every whole message of a bag, as it was sent, to a new one, in file order, with all checksums and indexes.

    `out` becomes an MCAP file if its name ends in .mcap, else a rosbag2 directory. Of a message's record only the
    sequence number is not kept. Raises BagError if nothing can be read, or if `out` exists or cannot be written.
    """
    contents = locate(path)
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
            copy = _Copy(target)
            for number, storage in enumerate(open_files(contents, keep_attachments=True)):
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


class _Copy:
    """A clean MCAP file in the course of being written."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.findings = Findings()
        self.counts: Counter[str] = Counter()
        self._schemas: dict[tuple[str, str, str], int] = {}
        self._channels: dict[tuple[str, str, int], int] = {}
        self._topics: dict[str, TopicInfo] = {}
        self._layouts: dict[tuple[str, int], Layouts | None] = {}
        self._first_ns, self._last_ns = 2**63 - 1, 0
        self._file = path.open("xb")
        self._writer = Writer(self._file, compression=CompressionType.ZSTD, enable_crcs=True, enable_data_crcs=True)
        self._writer.start(profile="ros2", library="agv_ncs")

    def add(self, storage: Storage) -> Iterator[float]:
        """Copy all that is whole in a file; yields the share that is done."""
        batches = storage.batches(lambda channel: True)
        # The key holds on to the buffer, so that no other one can have its id.
        for _, part in groupby(batches, key=lambda found: (id(found[1].buffer), found[1].buffer)):
            for channel, log_time, publish_time, payload in _in_file_order(self._sound(storage, part)):
                number = self._channel(storage, channel)
                self._writer.add_message(number, log_time, payload, publish_time)
                self.counts[channel.topic] += 1
                self._first_ns, self._last_ns = min(self._first_ns, log_time), max(self._last_ns, log_time)
            yield storage.position / max(1, storage.size)
        for channel in storage.channels.values():
            self._channel(storage, channel)
        for name, content in storage.metadata.items():
            if name != "rosbag2":  # counts the messages of the damaged bag
                self._writer.add_metadata(name, content)
        for item in storage.attachments:
            self._writer.add_attachment(item.create_time, item.log_time, item.name, item.media_type, item.content)
        self.findings.merge(storage.findings)

    def _sound(self, storage: Storage, batches: Iterator[tuple[Channel, Batch]]) -> Iterator[tuple[Channel, Batch]]:
        """The batches without those messages that are not of their topic's type."""
        for channel, batch in batches:
            layouts = self._layouts_of(storage, channel)
            if layouts is None:
                yield channel, batch
                continue
            before = layouts.misfits
            places = [group.places for group in layouts.split(batch)]
            if layouts.misfits == before:
                yield channel, batch
                continue
            what = f"{channel.topic}: message that is not of its type, left out ({layouts.first_misfit})"
            self.findings.add(what, layouts.misfits - before, is_loss=True)
            if places:
                kept = np.sort(np.concatenate(places))
                yield channel, Batch(batch.buffer, batch.starts[kept], batch.sizes[kept])

    def _layouts_of(self, storage: Storage, channel: Channel) -> Layouts | None:
        """Layouts of a channel's messages, None if these cannot be decoded and thus not be checked."""
        key = (str(storage.path), channel.id)
        if key not in self._layouts:
            schema = storage.schemas.get(channel.schema_id)
            self._layouts[key] = None
            if schema is not None and channel.encoding == "cdr":
                try:
                    self._layouts[key] = Layouts(parse_schema(schema.name, schema.encoding, schema.text))
                except UndecodableError as error:
                    self.findings.add(f"{channel.topic}: topic whose messages are copied unchecked ({error})")
        return self._layouts[key]

    def _channel(self, storage: Storage, channel: Channel) -> int:
        """Number of a channel in the clean file."""
        schema = storage.schemas.get(channel.schema_id)
        schema_id = 0
        if schema is not None:
            about = (schema.name, schema.encoding, schema.text)
            if about not in self._schemas:
                self._schemas[about] = self._writer.register_schema(*about[:2], about[2].encode())
            schema_id = self._schemas[about]
        key = (channel.topic, channel.encoding, schema_id)
        if key not in self._channels:
            self._channels[key] = self._writer.register_channel(
                channel.topic, channel.encoding, schema_id, channel.metadata
            )
            self._topics.setdefault(channel.topic, _topic_info(channel, schema.name if schema else ""))
        return self._channels[key]

    def close(self, metadata: Path | None) -> None:
        """Write the index and, for a directory, its metadata.yaml."""
        topics = [(topic, self.counts[name]) for name, topic in sorted(self._topics.items())]
        first = min(self._first_ns, self._last_ns)
        about = rosbag2_metadata(self.path.name, first, self._last_ns, topics)
        if metadata is not None:
            self._writer.add_metadata("rosbag2", {"serialized_metadata": metadata_text(about)})
            metadata.write_text(metadata_text({"rosbag2_bagfile_information": about}), encoding="utf-8")
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()


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
        qos = yaml.safe_load(channel.metadata.get("offered_qos_profiles", "")) or []
    except yaml.YAMLError:
        qos = []
    type_hash = channel.metadata.get(TYPE_HASH, "")
    return TopicInfo(channel.topic, kind, "", type_hash, qos if isinstance(qos, list) else [])
