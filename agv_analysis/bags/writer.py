"""Writing a rosbag2 directory: metadata.yaml and one MCAP file, as `ros2 bag` knows them, from serialised messages.

Messages are put in the order (log time, topic, payload) before they are written, within a window that is far longer
than the loop needs to carry a step around. In lockstep, where log times are stamps, two equal runs thus give equal
files, whatever way the messages of a step overtook each other on their way to the recorder.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from mcap.writer import CompressionType, Writer

from agv_ros.errors import UserError

METADATA_NAME = "agv_ncs"
"""Name of the MCAP metadata record that holds the run's version, seed and parameters."""

REPLAY_OF = "replay_of"
"""Key in it that names the recording, if the edge answered to that instead of an AGV."""

NODES_NAME = "agv_ncs_nodes"
"""Name of the record with what the loop's nodes said: the full name of each, and `params`, their parameters' values."""

RESTART = "restart_"
"""Of the i-th node that was started again `restart_i_from` is the stamp [ns] from which on it is another process, and
`restart_i_params` what that said of its parameters, as a params file."""

_WINDOW = 1024
"""Messages that are held back to be ordered."""

_BATCH = 256
"""Messages that are written at a time: few, since a loop in real time in the same process waits meanwhile."""

_BY_STAMP = 64
"""So many times as many where log times are stamps: it may be seconds before DDS brings a message again that a busy
recorder has missed, in which a loop in lockstep goes on for thousands of steps; and there is no hurry in it."""

_CHUNK = 256 * 1024
"""Size of a chunk [B], likewise."""

_VERSION = 9  # of the metadata of rosbag2 in Jazzy


class TopicInfo(NamedTuple):
    """What a bag says of a topic: name, type, definition, hash of the type (RIHS01), QoS of publishers, encoding."""

    name: str
    type: str
    schema: str
    type_hash: str
    offered_qos: Sequence[dict[str, Any]]
    encoding: str = "cdr"


@contextmanager
def new_directory(directory: Path) -> Iterator[None]:
    """Make a directory for recordings, and what is in it first. Raises UserError if it exists or cannot be made."""
    try:
        directory.mkdir(parents=True)
        yield
    except FileExistsError:
        raise UserError(f"{directory}: exists already; name a new directory or remove it first") from None
    except OSError as error:
        raise UserError(f"{directory}: cannot be recorded to: {error.strerror}") from None


class BagWriter:
    """An open bag. `describe` is asked for a topic, by its number, once there are some messages, or at the end.

    A topic without a publisher is in the bag only once it has a message.
    """

    def __init__(
        self, directory: Path, describe: Sequence[Callable[[], TopicInfo]], about: dict[str, str], by_stamp: bool
    ) -> None:
        """Create the directory. `by_stamp`: log times are stamps. Raises UserError if it exists or cannot be made."""
        self._window, self._batch = (_BY_STAMP * _WINDOW, _BY_STAMP * _BATCH) if by_stamp else (_WINDOW, _BATCH)
        self._room = _WINDOW  # until topics are described, while those who offer them are still there
        self._directory = directory
        self._file_name = f"{directory.name}_0.mcap"
        self._describe = describe
        self._topics: dict[int, TopicInfo] = {}
        self._channels: dict[int, int] = {}
        self._schemas: dict[str, int] = {}
        self._pending: list[tuple[int, int, bytes, int]] = []
        self.counts = [0] * len(describe)
        self._first_ns, self._last_ns = 0, 0
        with new_directory(directory):
            self._file = (directory / self._file_name).open("xb")
        self._writer = Writer(
            self._file, chunk_size=_CHUNK, compression=CompressionType.ZSTD, enable_crcs=True, enable_data_crcs=True
        )
        self._writer.start(profile="ros2", library=f"agv_ncs {about.get('version', '')}".strip())
        self._writer.add_metadata(METADATA_NAME, about)

    def write(self, topic: int, data: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        """Add a message to the topic with this number."""
        self._pending.append((log_time_ns, topic, data, publish_time_ns))
        self.counts[topic] += 1
        if len(self._pending) >= self._room:
            self._write_all_but(self._window)
            self._room = self._window + self._batch

    def add_metadata(self, name: str, content: dict[str, str]) -> None:
        """Add a metadata record, after the messages that have been written so far."""
        self._writer.add_metadata(name, content)

    def close(self) -> None:
        """Write what is held back, the index and metadata.yaml."""
        self._write_all_but(0)
        topics = [(topic, self.counts[number]) for number, topic in sorted(self._topics.items())]
        metadata = rosbag2_metadata(self._file_name, self._first_ns, self._last_ns, topics)
        self._writer.add_metadata("rosbag2", {"serialized_metadata": metadata_text(metadata)})
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()
        text = metadata_text({"rosbag2_bagfile_information": metadata})
        (self._directory / "metadata.yaml").write_text(text, encoding="utf-8")

    def _write_all_but(self, newest: int) -> None:
        if not self._topics:
            for number, describe in enumerate(self._describe):
                topic = describe()
                if topic.offered_qos or self.counts[number]:
                    self._register(number, topic)
        count = len(self._pending) - newest
        if count <= 0:
            return
        self._pending.sort()
        for log_time_ns, number, data, publish_time_ns in self._pending[:count]:
            if number not in self._channels:
                self._register(number, self._describe[number]())
            self._writer.add_message(self._channels[number], log_time_ns, data, publish_time_ns)
        self._first_ns = self._first_ns or self._pending[0][0]
        self._last_ns = max(self._last_ns, self._pending[count - 1][0])
        del self._pending[:count]

    def _register(self, number: int, topic: TopicInfo) -> None:
        self._topics[number] = topic
        if topic.type not in self._schemas:
            self._schemas[topic.type] = self._writer.register_schema(topic.type, "ros2msg", topic.schema.encode())
        about = {"offered_qos_profiles": metadata_text(topic.offered_qos), "topic_type_hash": topic.type_hash}
        self._channels[number] = self._writer.register_channel(topic.name, "cdr", self._schemas[topic.type], about)


def rosbag2_metadata(
    file_name: str,
    first_ns: int,
    last_ns: int,
    topics: Sequence[tuple[TopicInfo, int]],
    distro: str = "jazzy",
    custom_data: dict[str, str] | None = None,
) -> dict[str, Any]:
    """What metadata.yaml says of a bag of one MCAP file; `topics` with their number of messages."""
    start = {"nanoseconds_since_epoch": first_ns}
    duration = {"nanoseconds": last_ns - first_ns}
    total = sum(count for _, count in topics)
    file = {"path": file_name, "starting_time": start, "duration": duration, "message_count": total}
    return {
        "version": _VERSION,
        "storage_identifier": "mcap",
        "duration": duration,
        "starting_time": start,
        "message_count": total,
        "topics_with_message_count": [
            {"topic_metadata": _topic_metadata(topic), "message_count": count} for topic, count in topics
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file_name],
        "files": [file],
        "custom_data": custom_data,
        "ros_distro": distro,
    }


def _topic_metadata(topic: TopicInfo) -> dict[str, Any]:
    return {
        "name": topic.name,
        "type": topic.type,
        "serialization_format": topic.encoding,
        "offered_qos_profiles": list(topic.offered_qos),
        "type_description_hash": topic.type_hash,
    }


class _Dumper(yaml.SafeDumper):
    """Writes every value out: rosbag2's reader is not asked to know YAML's anchors."""

    def ignore_aliases(self, _: Any) -> bool:
        return True


def metadata_text(content: Any) -> str:
    """YAML as rosbag2 reads it."""
    return yaml.dump(content, Dumper=_Dumper, sort_keys=False)
