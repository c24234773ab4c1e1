"""Some of the signals that `make torture` sends to the processes of a run."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")

from torture.by_hand import faults_by_hand, run_by_hand
from torture.forked import import_all
from torture.kills import Case, faults, run

CONFIG = str(Path(__file__).parents[2] / "config/outages.yaml")

Apart = Callable[..., Any]


@pytest.fixture(scope="module")
def apart() -> Iterator[Apart]:
    """Call a function in a process that has no thread and no DDS participant, as the one of the tests may have."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), import_all) as pool:
        yield lambda function, *arguments: pool.submit(function, *arguments).result()


@pytest.mark.parametrize(
    "case",
    [
        Case("plant", signal.SIGTERM, "lockstep", "running"),
        Case("relay", signal.SIGKILL, "realtime", "outage"),
        Case("recorder", signal.SIGKILL, "lockstep", "running"),
        Case("runner", signal.SIGKILL, "lockstep", "running"),
    ],
    ids=str,
)
def test_a_run_ends_as_it_should_whatever_process_gets_a_signal(tmp_path: Path, case: Case, apart: Apart) -> None:
    ended = apart(run, case, tmp_path, CONFIG)
    # How fast it ends is a matter of the machine, too: `make torture` looks at that.
    assert faults(case, ended._replace(seconds=0.0), tmp_path / "bag") == [], ended.said


def test_nodes_by_hand_end_as_they_should_when_one_of_them_gets_a_signal(tmp_path: Path, apart: Apart) -> None:
    case = Case("controller", signal.SIGTERM, "realtime", "outage", "hand")
    ended = apart(run_by_hand, case, tmp_path, CONFIG)
    assert ended.statuses == dict.fromkeys(("recorder", "controller", "error_detector", "relay", "plant"), 0)
    on_time = ended._replace(seconds=0.0, victim_seconds=0.0)
    assert faults_by_hand(case, on_time, tmp_path / "bag") == [], ended.said
    # That the comparison sees them: a plant that says nothing, a node that does not end, one that ends by itself.
    mute = on_time._replace(said=dict.fromkeys(ended.said, ""), orphans=("relay",), early=("recorder",))
    assert set(faults_by_hand(case, mute, tmp_path / "bag")) == {
        "the plant ends with 0 and has not done its steps", "relay does not end", "recorder ended by itself",
    }  # fmt: skip
