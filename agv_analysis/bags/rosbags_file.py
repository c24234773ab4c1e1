"""Bags that are not MCAP, read by the library rosbags: sqlite3, and what rosbag2 compressed as files or messages."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from agv_analysis.bags.batch import Batch
from agv_analysis.bags.errors import BagError
from agv_analysis.bags.findings import Findings
from agv_analysis.bags.records import Attachment, Channel, Schema
from agv_analysis.bags.storage import IsWanted

_BATCH = 4096
_LEAD = struct.Struct("<qq")


class RosbagsFile:
    """Reads a rosbag2 directory or a .db3 file through rosbags; it knows one time of a message only."""

    def __init__(self, path: Path) -> None:
        """Open the bag. Raises BagError if rosbags is not installed or cannot open it."""
        self.path = path
        self.findings = Findings()
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: list[Attachment] = []
        self.counts: Counter[int] = Counter()
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.position = 0
        try:
            from rosbags.rosbag2 import Reader
        except ImportError:
            raise BagError(
                f"{path}: to read this kind of bag (sqlite3, or compressed as a whole), `pip install rosbags`"
            ) from None
        self._reader = Reader(path)
        try:
            self._reader.open()
            self._describe()
        except Exception as error:  # rosbags lets through what its libraries raise
            raise BagError(f"{path}: rosbags cannot open it: {error}") from None
        self.findings.add("storage without checksums, whose content is not checked")

    @property
    def size(self) -> int:
        """Messages that there are to read."""
        return int(self._reader.message_count)

    def close(self) -> None:
        """Close the bag."""
        self._reader.close()

    def expected(self, channel: int) -> int:
        """Messages that the channel is said to have."""
        return int(self._connections[channel].msgcount)

    def _describe(self) -> None:
        self._connections = {connection.id: connection for connection in self._reader.connections}
        for number, connection in self._connections.items():
            self.schemas[number] = Schema(number, connection.msgtype, "ros2msg", _definition(connection))
            self.channels[number] = Channel(number, number, connection.topic, "cdr", {})

    def batches(self, is_wanted: IsWanted) -> Iterator[tuple[Channel, Batch]]:
        """The messages of all channels that are wanted, in the order of their times, in batches of one channel."""
        waiting: dict[int, list[bytes]] = {}
        try:
            for connection, time, payload in self._reader.messages():
                self.counts[connection.id] += 1
                self.position += 1
                if is_wanted(self.channels[connection.id]):
                    messages = waiting.setdefault(connection.id, [])
                    messages.append(_LEAD.pack(time, time) + payload)
                    if len(messages) == _BATCH:
                        yield self.channels[connection.id], _batch(waiting.pop(connection.id))
        except Exception as error:  # rosbags lets through what its libraries raise
            self.findings.add(f"end of what rosbags can read ({error})", is_loss=True)
        for number, messages in waiting.items():
            yield self.channels[number], _batch(messages)


def _definition(connection: Any) -> str:
    """Definition of a topic's type: the bag's, or for older bags, which have none, that of ROS 2 Jazzy."""
    if connection.msgdef.format.name == "MSG" and connection.msgdef.data:
        return str(connection.msgdef.data)
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    if connection.msgtype not in store.types:
        return ""
    return str(store.generate_msgdef(connection.msgtype, ros_version=2)[0])


def _batch(messages: list[bytes]) -> Batch:
    sizes = np.array([len(message) for message in messages], np.int64)
    return Batch(np.frombuffer(b"".join(messages), np.uint8), np.cumsum(sizes) - sizes, sizes)
