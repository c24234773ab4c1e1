"""How long the verdict on a run of 100 s takes, against the linear criteria alone.

Beside the criteria it rests on how surely the link was seen, on the commands that were driven, and on ten minutes of
the nonlinear loop under these losses.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path

from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.stability.analysis import analyse
from agv_analysis.stability.criteria.criterion import RunFacts
from agv_analysis.stability.evidence import Judgements
from benchmarks.comparison import Comparison

CONFIG = str(Path(__file__).parent.parent / "config" / "outages.yaml")


def measure() -> list[Comparison]:
    """The verdict against the criteria; compiled code is warm."""
    run = simulate(load_scenario(CONFIG))
    ours = _seconds(lambda: analyse(run))
    criteria = _seconds(lambda: dict(Judgements(RunFacts(run))))
    return [
        Comparison("verdict on 100 s", ours, "linear criteria alone", criteria, "s", smaller_is_better=True),
        Comparison("what the verdict adds", ours - criteria, "a second", 1.0, "s", 1.0, smaller_is_better=True),
    ]


def _seconds(work: Callable[[], object]) -> float:
    """Duration of the best of three tries after a first one."""
    work()
    best = math.inf
    for _ in range(3):
        begun = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - begun)
    return best
