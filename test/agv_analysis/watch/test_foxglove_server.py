"""The server for Foxglove beside a real loop on DDS, read by a WebSocket client: the bytes are those of the bag."""

from __future__ import annotations

import json
import re
import signal
import struct
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("foxglove", reason="needs foxglove-sdk: pip install '.[foxglove]'")
pytest.importorskip("flask", reason="needs Flask: pip install '.[explore]'")

from websockets.sync.client import connect

from agv_analysis.bags import read_bag
from agv_analysis.watch.foxglove_server import foxglove_served
from agv_ros.codec import decode_error, decode_pose, decode_slot
from agv_ros.errors import UserError
from test.conftest import Start

REPOSITORY = Path(__file__).parents[3]

WANTED = {"/agv/pose": decode_pose, "/edge/error": decode_error, "/edge/slot": decode_slot}
MESSAGE_DATA = 1
"""Opcode of the protocol: then follow subscription [u32], log time [ns, u64] and the message."""


def layout_topics() -> set[str]:
    layout = json.loads((REPOSITORY / "config/foxglove.json").read_text())
    return set(re.findall(r"/(?:agv|edge)/\w+", json.dumps(layout["configById"])))


def test_a_client_gets_the_messages_of_the_loop_as_they_are_in_the_bag(start: Start, tmp_path: Path) -> None:
    watcher = start("agv_analysis.cli", "watch", "--config", str(REPOSITORY / "config/outages.yaml"), "--port", "0",
                    "--foxglove", "--foxglove-port", "0", "--no-browser")  # fmt: skip
    address = watcher.wait_for("Foxglove: ").split()[1]
    assert address.startswith("ws://127.0.0.1:")
    watcher.wait_for("watch: ")
    loop = start("agv_analysis.cli", "run", str(REPOSITORY / "config/outages.yaml"), "--clock", "realtime",
                 "--duration", "inf", "--bag", str(tmp_path / "bag"))  # fmt: skip
    heard: dict[str, dict[int, Any]] = {topic: {} for topic in WANTED}
    announced: dict[str, dict[str, Any]] = {}
    with connect(address, subprotocols=["foxglove.sdk.v1"]) as client:  # type: ignore[list-item]
        names: dict[int, str] = {}
        while min(map(len, heard.values())) < 100:
            message = client.recv(60.0)
            if isinstance(message, str):
                for channel in json.loads(message).get("channels", ()):
                    announced[channel["topic"]] = channel
                    if channel["topic"] in WANTED:
                        names[channel["id"]] = channel["topic"]
                        asked = [{"id": channel["id"], "channelId": channel["id"]}]
                        client.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
            elif message[0] == MESSAGE_DATA:
                subscription, _ = struct.unpack_from("<IQ", message, 1)
                value = WANTED[names[subscription]](message[13:])
                heard[names[subscription]][int(value[0])] = value
    loop.process.send_signal(signal.SIGINT)
    _, said = loop.end(120.0)
    assert "everything that was published" in said
    bag = read_bag(tmp_path / "bag", topics=list(WANTED))
    for topic, values in heard.items():
        recorded = {int(decoded[0]): decoded for decoded in map(WANTED[topic], bag.payloads(topic))}
        assert {stamp: recorded.get(stamp) for stamp in values} == values
    assert announced["/agv/pose"]["encoding"] == "cdr"
    assert announced["/agv/pose"]["schemaName"] == "geometry_msgs/msg/PoseStamped"
    assert "MSG: geometry_msgs/Pose" in announced["/agv/pose"]["schema"]
    assert layout_topics() - {"/edge/pose", "/edge/reference"} <= {*announced}


def test_a_port_that_is_taken_is_one_line() -> None:
    with foxglove_served(0) as (address, _):
        port = int(address.rpartition(":")[2])
        with pytest.raises(UserError, match=f"port {port} .*--foxglove-port"), foxglove_served(port):
            pass
