"""What nodes say to systemd, heard at a real socket: up, alive as long as callbacks run, and at their end."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from agv_ros.service_manager import ALIVE, READY, STOPPING, notify, watchdog_period

Listener = Callable[[], str]


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[tuple[str, Listener]]:
    """The path of a socket such as systemd's, and what comes to it, one after the other."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        listener.settimeout(60.0)
        yield str(tmp_path / "notify"), lambda: listener.recv(1000).decode()


def test_a_state_comes_to_a_path_and_to_an_abstract_address(manager: tuple[str, Listener]) -> None:
    path, heard = manager
    notify(READY, {"NOTIFY_SOCKET": path})
    assert heard() == "READY=1"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(f"\0agv_ncs_test_{os.getpid()}")
        notify(STOPPING, {"NOTIFY_SOCKET": f"@agv_ncs_test_{os.getpid()}"})
        assert listener.recv(1000) == b"STOPPING=1"


@pytest.mark.parametrize("path", ["", "no/path", "/no/such/socket"])
def test_where_none_listens_nothing_is_said(path: str) -> None:
    notify(READY, {"NOTIFY_SOCKET": path})
    notify(READY, {})


@pytest.mark.parametrize(
    ("said", "period"),
    [
        ({"WATCHDOG_USEC": "5000000"}, 2.5),
        ({"WATCHDOG_USEC": "5000000", "WATCHDOG_PID": str(os.getpid())}, 2.5),
        ({"WATCHDOG_USEC": "5000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({}, None),
    ],
)
def test_alive_is_said_twice_in_the_time_allowed(said: dict[str, str], period: float | None) -> None:
    assert watchdog_period(said) == period


HANGS = """
import time
from agv_ros.executor import run_node
from agv_ros.node import LoopNode
from agv_ros.parameters import LoopParameters
from agv_ros.service_manager import notify

class HangingNode(LoopNode[LoopParameters]):
    def __init__(self):
        super().__init__("hanging", LoopParameters)
        self.times = 0
        self.every(0.2, self.hang)

    def hang(self):
        self.times += 1
        if self.times > 2:
            return
        notify("HANGS")
        time.sleep(0.4)  # what is tested: a callback that takes 20 times the watchdog's period
        notify("GOES ON")

run_node(HangingNode, [])
"""


def test_a_node_is_alive_while_its_callbacks_run(start: Callable[..., Any], manager: tuple[str, Listener]) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    path, heard = manager
    environment = {**os.environ, "NOTIFY_SOCKET": path, "WATCHDOG_USEC": "40000"}
    node = start(sys.executable, "-c", HANGS, env=environment)
    said = [heard()]
    while said.count("GOES ON") < 2 or said[-1] != ALIVE:
        said.append(heard())
    assert said[0] == READY
    hangs = [number for number, one in enumerate(said) if one == "HANGS"]
    assert {said[number + 1] for number in hangs} == {"GOES ON"}, "it says that it is alive while it hangs"
    node.process.terminate()
    while said[-1] != STOPPING:
        said.append(heard())
    status, text = node.end()
    assert (status, "Traceback" in text) == (0, False), text
