"""What metadata.yaml of a rosbag2 directory says, as `ros2 bag` knows it (version 9, Jazzy)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import yaml

_VERSION = 9  # of the metadata of rosbag2 in Jazzy


class TopicInfo(NamedTuple):
    """What a bag says of a topic: name, type, definition, hash of the type (RIHS01), QoS of publishers, encoding."""

    name: str
    type: str
    schema: str
    type_hash: str
    offered_qos: Sequence[dict[str, Any]]
    encoding: str = "cdr"


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
