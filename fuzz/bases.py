"""The sound bags that cases are made of."""

from __future__ import annotations

import contextlib
import functools
import io
import sqlite3
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore

STEPS = 6

OPTIONS: dict[str, dict[str, Any]] = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "none": {"compression": CompressionType.NONE},
    "without CRCs": {"compression": CompressionType.ZSTD, "enable_crcs": False},
    "none without CRCs": {"compression": CompressionType.NONE, "enable_crcs": False},
    "unchunked": {"use_chunking": False},
    "CRC of the data section": {"compression": CompressionType.ZSTD, "enable_data_crcs": True},
}
SQLITE3 = "sqlite3"
NAMES = (*OPTIONS, SQLITE3)


class Sent(NamedTuple):
    """A message of a base."""

    topic: str
    type: str
    log_time: int
    payload: bytes


@functools.cache
def definition(kind: str) -> str:
    """Definition of a type as a bag carries it."""
    return str(get_typestore(Stores.ROS2_JAZZY).generate_msgdef(kind, ros_version=2)[0])


@functools.cache
def messages() -> tuple[Sent, ...]:
    """A few steps of a loop: numbers, stamps, strings, sequences of numbers, of strings and of messages."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types, draw = store.types, np.random.default_rng(7)
    found: list[Sent] = []
    for k in range(STEPS):
        stamp = types["builtin_interfaces/msg/Time"](1, 5_000_000 * k)
        header = types["std_msgs/msg/Header"](stamp, "map")
        x, y, z, w = draw.normal(size=4)
        pose = types["geometry_msgs/msg/Pose"](
            types["geometry_msgs/msg/Point"](x, y, 0.0), types["geometry_msgs/msg/Quaternion"](0.0, 0.0, z, w)
        )
        path = [types["geometry_msgs/msg/PoseStamped"](header, pose)] * (k % 3)
        for topic, message in (
            ("/clock", types["rosgraph_msgs/msg/Clock"](stamp)),
            ("/pose", types["geometry_msgs/msg/PoseStamped"](header, pose)),
            ("/slot", types["sensor_msgs/msg/TimeReference"](header, stamp, "lost" if k % 5 == 1 else "delivered")),
            ("/joints", types["sensor_msgs/msg/JointState"](
                header, ["left", "right"][: k % 3], draw.normal(size=2), draw.normal(size=k % 2), np.zeros(0)
            )),
            ("/path", types["nav_msgs/msg/Path"](header, path)),
        ):  # fmt: skip
            kind = message.__msgtype__
            found.append(Sent(topic, kind, 10**9 + len(found), bytes(store.serialize_cdr(message, kind))))
    return tuple(found)


@functools.cache
def base(name: str) -> bytes:
    """The content of a sound bag."""
    return _database() if name == SQLITE3 else _mcap(OPTIONS[name])


def _mcap(options: dict[str, Any]) -> bytes:
    file = io.BytesIO()
    writer = Writer(file, chunk_size=1200, **options)
    writer.start(profile="ros2", library="fuzz")
    channels: dict[str, int] = {}
    for sent in messages():
        if sent.topic not in channels:
            schema = writer.register_schema(sent.type, "ros2msg", definition(sent.type).encode())
            channels[sent.topic] = writer.register_channel(sent.topic, "cdr", schema)
        writer.add_message(channels[sent.topic], sent.log_time, sent.payload, sent.log_time - 1)
    writer.add_metadata("about", {"seed": "7"})
    writer.finish()  # type: ignore[no-untyped-call]
    return file.getvalue()


def _database() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag"
        store = get_typestore(Stores.ROS2_JAZZY)
        with Rosbag2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
            connections = {}
            for sent in messages():
                if sent.topic not in connections:
                    connections[sent.topic] = writer.add_connection(sent.topic, sent.type, typestore=store)
                writer.write(connections[sent.topic], sent.log_time, sent.payload)
        with contextlib.closing(sqlite3.connect(path / "bag.db3")) as database:
            database.execute("VACUUM")
        return (path / "bag.db3").read_bytes()
