"""Restarts in a recording, from reports written by hand."""

from __future__ import annotations

import numpy as np

from agv_analysis.recordings.restarts import restarts
from agv_ros.stamps import NS_PER_S, Grid

GRID = Grid(NS_PER_S, NS_PER_S // 200)

DIAGNOSTICS = np.dtype([
    ("header.stamp.sec", np.int32), ("header.stamp.nanosec", np.uint32), ("len(status)", np.uint32),
    ("status.name", "S20", (1,)), ("status.values.key", "S30", (1, 2)), ("status.values.value", "S9", (1, 2)),
])  # fmt: skip


def said(*reports: tuple[str, int, int]) -> list[str]:
    """What is said of reports: node, second after step 0, number of its report."""
    keys = [["published /diagnostics", "published /agv/pose"]]
    rows = [(1 + second, 0, 1, [name], keys, [[str(number), "7"]]) for name, second, number in reports]
    return list(restarts(np.array(rows, dtype=DIAGNOSTICS), "/", GRID))


def test_a_node_that_goes_on_counting_is_one_process() -> None:
    assert said(*(("plant", second, second + 1) for second in range(5)), ("relay", 0, 1), ("relay", 1, 2)) == []


def test_whoever_counts_from_one_again_was_started_again() -> None:
    first = [("controller", second, second + 1) for second in range(4)]
    again = [("controller", 5, 1), ("controller", 6, 2), ("controller", 9, 1)]
    (note,) = said(*first, *again)
    assert note == "controller was started again in the middle of the run: its reports start again at step 1000, 1800"


def test_reports_that_were_out_of_order_or_missed_are_no_restart() -> None:
    assert said(("plant", 3, 9), ("plant", 1, 7), ("plant", 0, 8)) == []


def test_other_loops_are_not_spoken_of() -> None:
    assert said(("agv_2/plant", 0, 1), ("agv_2/plant", 1, 1)) == []
