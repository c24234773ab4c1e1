"""What an offset, a drift or a leap of the recorder's clock costs, as docs/deployment.md says."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from test.agv_analysis.recordings.test_robot_timing import LOG, MS, START, STEPS, T, driven

PAGE = Path(__file__).parents[3] / "docs/deployment.md"
ROWS = re.findall(
    r"^\| (ahead|drifts|leaps) by (-?\d+) (?:ms|ppm) \| (\d+) \| (\d+) \|$", PAGE.read_text("utf-8"), re.MULTILINE
)

CLOCKS: dict[str, Callable[[int, int], int]] = {
    "ahead": lambda stamp, ms: stamp + LOG + ms * MS,
    "drifts": lambda stamp, ppm: stamp + LOG + (stamp - START) * ppm // 1_000_000,
    "leaps": lambda stamp, ms: stamp + LOG + (ms * MS if stamp >= START + STEPS // 2 * T else 0),
}
"""Log time [ns] of what comes at once, from its stamp [ns], half-way through a run for a leap."""


def test_the_page_has_a_row_of_each_kind() -> None:
    assert {kind for kind, *_ in ROWS} == set(CLOCKS)


@pytest.mark.parametrize(("kind", "by", "older", "oldest"), ROWS)
def test_the_page_is_right(kind: str, by: str, older: str, oldest: str, tmp_path: Path) -> None:
    run = driven(tmp_path, log_of=lambda stamp: CLOCKS[kind](stamp, int(by)))
    assert (len(run), int((run.n_ul > 0).sum()), int(run.n_ul.max())) == (STEPS, int(older), int(oldest))
