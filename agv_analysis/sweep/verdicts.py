"""The word on each point of a sweep, from the same evidence and by the same rules as that of `agv-ncs stability`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from agv_analysis.simulation.batch import cores
from agv_analysis.stability.evidence import evidence_of_scenario
from agv_analysis.stability.verdict import GREEN, WORDS, decide
from agv_analysis.sweep.plan import Sweep, varied

FEWEST_RUNS = 10
"""Runs of a point, at least, that count for its verdict: of fewer, one that does not contract may be chance."""

NOT_GREEN = "verdict: not stable"
"""What pictures call a point whose verdict is not green."""

Rows = list[dict[str, Any]]


def not_green(rows: Rows) -> Rows:
    """Those whose verdict is known, and none of the words that say stable."""
    return [row for row in rows if row.get("verdict", GREEN[0]) not in GREEN]


def with_verdicts(
    sweep: Sweep, rows: Rows, workers: int | None = None, progress: Callable[[int], None] = lambda done: None
) -> Rows:
    """The rows of a sweep with the columns `verdict` and `verdict_reason`, after those of the varied parameters.

    The links are taken as they are known where they are finite Markov chains, else as the first seed shows them.
    `workers` threads, one a core by default, do the work; `progress` receives the number of points done. Raises
    PartError if a part raises.
    """
    found: Rows = []
    with ThreadPoolExecutor(workers or cores()) as pool:
        try:
            for row in pool.map(lambda row: _with_verdict(sweep, row), rows):
                found.append(row)
                progress(len(found))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return found


def _with_verdict(sweep: Sweep, row: dict[str, Any]) -> dict[str, Any]:
    names = [axis.name for axis in sweep.axes]
    scenario = varied(sweep.base, sweep.axes, [row[name] for name in names])
    counts = row["settles_without_losses"] and not row["undecided"] and row["runs"] >= FEWEST_RUNS
    twins = (row["runs"] - row["unstable"], row["runs"]) if counts else None
    verdict = decide(evidence_of_scenario(scenario, twins, with_margin=False))
    varied_values = {name: row[name] for name in names}
    return {**varied_values, "verdict": verdict.word, "verdict_reason": verdict.reason, **row}


def words_said(rows: Rows) -> str:
    """How often each word was said, the best first: `3 asymptotic, 1 infeasible`; empty without verdicts."""
    count = Counter(row.get("verdict") for row in rows)
    return ", ".join(f"{count[word]} {word}" for word in WORDS if count[word])
