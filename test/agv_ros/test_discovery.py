"""Who finds a process's nodes: what the environment becomes, and what the sockets of a real node listen on."""

from __future__ import annotations

import os
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from agv_ros.discovery import limit_to_this_host

if TYPE_CHECKING:
    from test.conftest import Start

OURS, ELSEWHERE = (str(Path(__file__).parents[2] / "agv_ros" / name) for name in ("loopback.xml", "any_host.xml"))
PROFILES = {"FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"}
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"


@pytest.mark.parametrize(
    ("before", "are_ours"),
    [
        ({}, PROFILES),
        ({RANGE: "OFF"}, PROFILES),
        ({RANGE: "SUBNET"}, set()),
        ({RANGE: "SYSTEM_DEFAULT"}, set()),
        ({"ROS_STATIC_PEERS": "192.0.2.1"}, set()),
        ({"FASTRTPS_DEFAULT_PROFILES_FILE": "mine.xml"}, set()),
        ({RANGE: "SUBNET", **dict.fromkeys(PROFILES, OURS)}, set()),
        ({"FASTDDS_DEFAULT_PROFILES_FILE": OURS}, PROFILES),
        ({"FASTDDS_DEFAULT_PROFILES_FILE": ELSEWHERE}, PROFILES),
    ],
)
def test_sockets_are_limited_where_discovery_is(before: dict[str, str], are_ours: set[str]) -> None:
    environment = dict(before)
    limit_to_this_host(environment)
    assert {name for name, value in environment.items() if value == OURS} == are_ours
    is_chosen = "mine.xml" in before.values()
    assert {name for name, value in environment.items() if value == ELSEWHERE} == (
        set() if is_chosen else PROFILES - are_ours
    )
    kept = {name: value for name, value in before.items() if value not in (OURS, ELSEWHERE)}
    assert kept.items() <= environment.items()
    assert set(environment) - set(before) <= {RANGE, *PROFILES}


def test_both_profiles_say_the_same_of_subscriptions() -> None:
    def said(path: str) -> list[str]:
        root = ElementTree.parse(path).getroot()
        return [ElementTree.tostring(one, encoding="unicode").strip() for one in root.findall(".//{*}data_reader")]

    assert len(said(OURS)) == 1
    assert said(OURS) == said(ELSEWHERE)


@pytest.mark.parametrize("range_", ["LOCALHOST", "SUBNET"])
def test_a_subscription_that_falls_behind_in_its_publisher_s_process_hears_all(start: Start, range_: str) -> None:
    """Of more messages than Fast DDS by itself lets a subscription have unread, 5000, beyond which it stays deaf."""
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    found = start(sys.executable, str(Path(__file__).with_name("falls_behind.py")), env=os.environ | {RANGE: range_})
    assert found.wait_for("received ").split()[-1] == "6010"


def listening(pid: int) -> set[tuple[str, int]]:
    """Addresses and ports of the UDP sockets of a process at which participants of DDS are reached."""
    found = set()
    sockets = {str(file.readlink()) for file in Path(f"/proc/{pid}/fd").iterdir() if file.is_symlink()}
    for line in Path(f"/proc/{pid}/net/udp").read_text().splitlines()[1:]:
        words = line.split()
        if f"socket:[{words[9]}]" in sockets:
            address, port = (int(part, 16) for part in words[1].split(":"))
            found.add((".".join(str(byte) for byte in address.to_bytes(4, "little")), port))
    first = 7400 + 250 * int(os.environ["ROS_DOMAIN_ID"])  # RTPS 2.5, 9.6.2: ports of a domain
    return {(address, port) for address, port in found if first <= port < first + 250}


@pytest.mark.parametrize(("range_", "address"), [("LOCALHOST", "127.0.0.1"), ("SUBNET", "0.0.0.0")])
def test_the_sockets_of_a_node(start: Start, range_: str, address: str) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    node = start("agv_cloud.controller_node", env=os.environ | {RANGE: range_})
    node.wait_for("discovery:")
    addresses = {found for found, _ in listening(node.process.pid)}
    assert addresses == {address}
