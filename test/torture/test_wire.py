"""A few of the messages that `make torture` sends to a running loop."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")

from torture.wire import attack

CONFIG = str(Path(__file__).parents[2] / "config/outages.yaml")


def test_a_loop_in_lockstep_comes_to_its_end_under_attack(tmp_path: Path) -> None:
    found = attack(1, "lockstep", 100, tmp_path, CONFIG, steps=1500)
    assert found.faults == [], found.said
    assert found.sent > 0
