"""Some of the signals that `make torture` sends to the processes of a run."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")

from torture.kills import Case, faults, run

CONFIG = str(Path(__file__).parents[2] / "config/outages.yaml")


@pytest.mark.parametrize(
    "case",
    [
        Case("plant", signal.SIGTERM, "lockstep", "running"),
        Case("relay", signal.SIGKILL, "realtime", "running"),
        Case("recorder", signal.SIGKILL, "lockstep", "running"),
        Case("runner", signal.SIGKILL, "lockstep", "running"),
    ],
    ids=str,
)
def test_a_run_ends_as_it_should_whatever_process_gets_a_signal(tmp_path: Path, case: Case) -> None:
    ended = run(case, tmp_path, CONFIG)
    # How fast it ends is a matter of the machine, too: `make torture` looks at that.
    assert faults(case, ended._replace(seconds=0.0), tmp_path / "bag") == [], ended.said
