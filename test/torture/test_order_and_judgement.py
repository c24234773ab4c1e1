"""What `make torture` runs first, what it calls too late, and what the processes that it forks make known."""

from __future__ import annotations

import os
import signal
from itertools import product
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")

from torture.forked import Forked
from torture.kills import CLOCKS, IN_TIME, MOMENTS, NODES, SIGNALS, STARTS, cases, in_fair_order, too_late


@pytest.mark.parametrize("seed", [1, 2])
def test_the_first_cases_are_a_fair_sample_of_all(seed: int) -> None:
    order = in_fair_order(seed)
    assert len(order) == 440
    assert set(order) == set(cases())
    first = order[:60]
    assert {(case.node, case.number) for case in first} == set(product(NODES, SIGNALS))
    for clock, moment in product(CLOCKS, MOMENTS):  # 7.5 of each would be even
        assert 5 <= sum((case.clock, case.moment) == (clock, moment) for case in first) <= 10
    for start in STARTS:
        assert sum(case.start == start for case in first) >= 20


def test_a_run_is_too_late_by_what_a_lack_of_processors_does_not_explain() -> None:
    assert too_late("it", IN_TIME, 0.0, 0.0) == []
    assert too_late("it", IN_TIME + 0.1, 0.0, 0.0) == ["it after 5.1 s, 0.0 s of it without a processor"]
    assert too_late("it", IN_TIME + 0.6, 0.7, 0.0) == []
    assert too_late("it", IN_TIME + 0.8, 0.7, 0.0) != []
    assert too_late("it", IN_TIME + 10.0, 4.1, 0.0) == []
    assert too_late("it", IN_TIME + 20.0, 4.1, 0.0) != []


def _refuse() -> None:
    print("hello", flush=True)
    raise SystemExit("no")


def _die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize(
    ("main", "status", "said"), [(lambda: None, 0, ""), (_refuse, 1, "hello\nno\n"), (_die, -signal.SIGKILL, "")]
)
def test_a_forked_process_has_the_status_and_the_output_of_a_program(
    tmp_path: Path, main: object, status: int, said: str
) -> None:
    assert callable(main)
    process = Forked(main, tmp_path / "log")
    while process.poll() is None:
        pass
    assert (process.returncode, process.said()) == (status, said)
