"""What the loop does within its corridor at each point of a sweep, and the best point for it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from agv_analysis.corridor.corridor import Corridor, corridor
from agv_analysis.sweep import CORRIDOR_COLUMNS
from agv_analysis.sweep.plan import Sweep, varied

Rows = list[dict[str, Any]]


def has_corridor(sweep: Sweep) -> bool:
    """Has each point of a sweep a corridor?"""
    axis = next((axis for axis in sweep.axes if axis.name == "error_detector.corridor"), None)
    return sweep.base.error_detector.corridor > 0.0 if axis is None else min(axis.values) > 0.0


def with_corridors(
    sweep: Sweep, rows: Rows, laps: int | None = None, progress: Callable[[int], None] = lambda done: None
) -> Rows:
    """The rows of a sweep, each point of which has a corridor, with the CORRIDOR_COLUMNS after the others.

    NaN where there is no number, inf for an n without a bound and for a corridor that is never left. `progress`
    receives the number of points done. Raises PartError if a part raises.
    """
    found: Rows = []
    for row in rows:
        scenario = varied(sweep.base, sweep.axes, [row[axis.name] for axis in sweep.axes])
        within = corridor(scenario, laps, proved=False)
        assert within is not None
        found.append({**row, **dict(zip(CORRIDOR_COLUMNS, _values(within), strict=True))})
        progress(len(found))
    return found


def _values(found: Corridor) -> tuple[float, ...]:
    leaving, is_known = found.leaving, found.single is not None
    n_single, n_any = (
        (math.inf if n is None else float(n)) if is_known else math.nan for n in (found.n_single, found.n_any)
    )
    rms = math.nan if found.stationary is None or found.rms.value is None else found.rms.value
    p_lap, p_hour = leaving.p_lap, leaving.p_hour
    mean = math.inf if leaving.mean_time is None else leaving.mean_time.value
    return n_single, n_any, p_lap.value, p_lap.low, p_lap.high, p_hour.value, p_hour.low, p_hour.high, mean, rms


def best_for_corridor(sweep: Sweep, rows: Rows) -> dict[str, Any] | None:
    """The point that leaves its corridor most rarely, of equal ones that with the largest n_any; None without any."""

    def rank(row: dict[str, Any]) -> tuple[float, float]:
        return row["p_lap"], -row["n_any"] if not math.isnan(row["n_any"]) else math.inf

    return min((row for row in rows if "p_lap" in row), key=rank, default=None)
