"""How fast the explorer answers: a lap of 20 000 steps simulated anew, its margins, and what the browser gets to draw.

The peer is what a person bears: an answer within 0.2 s is one to the hand that moves the slider.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

from agv_analysis.explore.answer import answer
from agv_analysis.explore.settings import Values, scenario_of, values_of
from agv_analysis.scenario import Scenario, load_scenario
from benchmarks.comparison import Comparison

CONFIG = str(Path(__file__).parent.parent / "config" / "outages.yaml")
AT_ONCE = 0.2
"""[s]"""


def measure() -> list[Comparison]:
    """The slowest of ten moves, with and without a pinned setting."""
    base = load_scenario(CONFIG)
    values = values_of(base)
    scenario_and_answer(base, values, None)  # compiles
    moves = [{**values, "kx": 20.0 + move} for move in range(10)]
    return [
        Comparison(
            f"a move of a slider{what}", max(scenario_and_answer(base, move, pinned) for move in moves), "at once",
            AT_ONCE, "s", 1.0, smaller_is_better=True,
        )
        for what, pinned in (("", None), (", one pinned", base))
    ]  # fmt: skip


def scenario_and_answer(base: Scenario, values: Values, pinned: Scenario | None) -> float:
    """Seconds from the values on the page to what is sent to it."""
    begun = time.perf_counter()
    found = answer(scenario_of(base, values), pinned)
    json.dumps((found.track, found.time))
    return time.perf_counter() - begun
