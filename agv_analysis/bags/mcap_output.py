"""An MCAP file that grows, and that can be read up to its last whole record whatever ends it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from mcap.records import Message
from mcap.stream_reader import StreamReader

from agv_analysis.bags.mcap_writer import McapWriter
from agv_analysis.bags.rosbag2_metadata import TopicInfo, metadata_text

_CHUNK = 256 * 1024
"""Size of a chunk [B]: small, since a loop in real time in the same process waits while it is compressed."""


Recorded = tuple[int, int, bytes, int]
"""A message: log time [ns], number of its topic, payload, publish time [ns]; in a bag in this order."""


class _WholeWrites:
    """A file that holds whole writes only: what the disk has no more room for is taken back."""

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_NOFOLLOW, 0o666)
        self._position = 0

    def write(self, data: bytes) -> int:
        """Write all of it. Raises OSError."""
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError:
            os.ftruncate(self._descriptor, self._position)
            os.lseek(self._descriptor, self._position, os.SEEK_SET)
            raise
        self._position += len(data)
        return len(data)

    def tell(self) -> int:
        """Bytes so far."""
        return self._position

    def flush(self) -> None:
        """The system has all that was written. Raises FileNotFoundError if the file was removed: it will be lost."""
        if os.fstat(self._descriptor).st_nlink == 0:
            raise FileNotFoundError(2, "the file was removed")

    def sync(self) -> None:
        """Wait until the disk has all that was written."""
        os.fsync(self._descriptor)

    def close(self) -> None:
        """Close the file, unless it is."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._descriptor = -1


class McapOutput:
    """A file with numbered topics, each described by `describe` once there is a message of it."""

    def __init__(
        self,
        path: Path,
        describe: Sequence[Callable[[], TopicInfo]],
        metadata: tuple[str, Mapping[str, str]],
        sync: bool,
    ) -> None:
        """`metadata` goes first, if there is any.

        `sync`: wait for the disk, beside the loop, as often as the file is flushed.
        """
        self.path = path
        self.topics: dict[int, TopicInfo] = {}
        """Those that are in the file, by number."""
        self._describe = describe
        self._channels: dict[int, int] = {}
        self._schemas: dict[str, int] = {}
        self._file = _WholeWrites(path)
        self._disk = ThreadPoolExecutor(1, "disk") if sync else None
        self._synced: Future[None] | None = None
        library = f"agv_ncs {metadata[1].get('version', '')}".strip()
        self._writer = McapWriter(self._file, _CHUNK, library)
        if metadata[1]:
            self._writer.add_metadata(*metadata)

    def write(self, messages: Iterable[Recorded]) -> None:
        """Add messages. Raises OSError."""
        channels, add = self._channels, self._writer.add_message
        for log_time_ns, topic, data, publish_time_ns in messages:
            if topic not in channels:
                self.register(topic, self._describe[topic]())
            add(channels[topic], log_time_ns, data, publish_time_ns)

    def register(self, number: int, topic: TopicInfo) -> None:
        """Put a topic into the file."""
        self.topics[number] = topic
        if topic.type not in self._schemas:
            self._schemas[topic.type] = self._writer.register_schema(topic.type, "ros2msg", topic.schema.encode())
        about = {"offered_qos_profiles": metadata_text(topic.offered_qos), "topic_type_hash": topic.type_hash}
        self._channels[number] = self._writer.register_channel(topic.name, "cdr", self._schemas[topic.type], about)

    def finish_chunk(self) -> None:
        """Give the system all messages so far. Raises OSError."""
        self._writer.flush()
        self.check()

    def check(self) -> None:
        """Raise OSError if what was written is lost; with `sync`, the disk gets what has been written so far."""
        self._file.flush()
        if self._disk is not None and (self._synced is None or self._synced.done()):
            if self._synced is not None:
                self._synced.result()
            self._synced = self._disk.submit(self._file.sync)

    def finish(self, metadata: Sequence[tuple[str, Mapping[str, str]]]) -> None:
        """Write metadata records, the index and the end, and close the file. Raises OSError."""
        for name, content in metadata:
            self._writer.add_metadata(name, content)
        self._writer.finish()
        self.check()
        if self._disk is not None:
            self._disk.submit(self._file.sync).result()
        self.abandon()

    def abandon(self) -> None:
        """Close the file as it is."""
        if self._disk is not None:
            self._disk.shutdown()
        self._file.close()

    def messages(self) -> Iterator[Recorded]:
        """The messages of the finished file, in its order."""
        numbers = {channel: number for number, channel in self._channels.items()}
        with self.path.open("rb") as file:
            for record in StreamReader(file).records:
                if isinstance(record, Message):
                    yield record.log_time, numbers[record.channel_id], record.data, record.publish_time
