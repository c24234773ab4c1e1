"""What a sweep found, in a sentence: where the loop is stable in every run."""

from __future__ import annotations

import math
from typing import Any

from agv_analysis.stability.verdict import GREEN, MEAN_SQUARE
from agv_analysis.sweep.plan import Axis

Rows = list[dict[str, Any]]


def sweep_sentence(rows: Rows, *axes: Axis) -> str:
    """What a sweep over `axes` found: a point counts as stable if every run is and its verdict does not object."""
    if not rows:
        return "No point of the sweep was run."
    short = sum(row.get("undecided", 0) > 0 for row in rows)
    calm = sum(is_calm(row) for row in rows)
    sense = "in all runs and by the verdict" if "verdict" in rows[0] else "in all runs"
    bad = sum(row["unstable"] == row["runs"] for row in rows)
    if calm == len(rows):
        return f"The loop is stable {sense} at all {len(rows)} points."
    too_short = f"; at {short} runs are too short to say" if short else ""
    where = _where(axes[0].name, rows) if calm and len(axes) == 1 else ""
    if where:
        return f"Stable {sense} for {where} ({calm} of {len(rows)} points){too_short}."
    return f"Of {len(rows)} points the loop is stable {sense} at {calm}, and in no run at {bad}{too_short}."


def is_calm(row: dict[str, Any]) -> bool:
    """Is every run at this point stable, and its verdict, if there is one, a green one?"""
    is_green = row.get("verdict", MEAN_SQUARE) in GREEN
    return row["unstable"] == 0 and not row.get("undecided") and is_green


def best_point(rows: Rows) -> dict[str, Any]:
    """The point with the smallest worst deviation, of those that are stable if there are some."""
    found = [row for row in rows if is_calm(row)] or rows
    return min(found, key=lambda row: (math.isnan(row["deviation_max_p50"]), row["deviation_max_p50"]))


def _where(name: str, rows: Rows) -> str:
    """The values of the one axis at which the loop is stable; empty where they are no interval of numbers."""
    if not all(isinstance(row[name], int | float) for row in rows):
        return ""
    rows = sorted(rows, key=lambda row: float(row[name]))
    calm = [place for place, row in enumerate(rows) if is_calm(row)]
    first, last = calm[0], calm[-1]
    if last - first + 1 != len(calm):
        return ""
    low, high = f"{rows[first][name]:.4g}", f"{rows[last][name]:.4g}"
    if first == 0:
        return f"{name} <= {high}"
    return f"{name} >= {low}" if last == len(rows) - 1 else f"{low} <= {name} <= {high}"
