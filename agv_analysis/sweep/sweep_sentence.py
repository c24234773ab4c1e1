"""What a sweep found, in a sentence: where the loop is stable in every run."""

from __future__ import annotations

import math
import re
from typing import Any

from agv_analysis.stability.verdict import GREEN, MEAN_SQUARE
from agv_analysis.sweep.plan import Axis
from agv_ros.counted import counted

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
        return f"The loop is stable {sense} at {_all(len(rows))}."
    too_short = f"; at {counted(short, 'point')} runs are too short to say" if short else ""
    where = _where(axes[0].name, rows) if calm and len(axes) == 1 else ""
    if where:
        return f"Stable {sense} for {where} ({calm} of {counted(len(rows), 'point')}){too_short}."
    nowhere = f", and in no run at {bad}" if bad else ""
    return f"Of {counted(len(rows), 'point')} the loop is stable {sense} at {calm}{nowhere}{too_short}."


def _all(points: int) -> str:
    return {1: "the only point", 2: "both points"}.get(points, f"all {points} points")


def sweep_reason(rows: Rows, *axes: Axis) -> str:
    """Why the points that are not stable are so, or all are stable: the reason that most of them share; empty for none.

    Reasons that differ in their numbers alone are one; then they are those of the first point that has it, which is
    named.
    """
    asked = [row for row in rows if not is_calm(row)] or rows
    if not asked:
        return ""
    kinds: dict[str, list[dict[str, Any]]] = {}
    for row in asked:
        kinds.setdefault(_NUMBERS.sub("#", reason_of(row)), []).append(row)
    found = max(kinds.values(), key=len)
    what = "points" if is_calm(asked[0]) else "points that are not stable"
    where = f"at {len(found)} of the {len(asked)} {what}" if len(found) < len(asked) else ""
    reason = reason_of(found[0])
    if len({reason_of(row) for row in found}) > 1:
        first = ", ".join(f"{axis.name} {_plain(found[0][axis.name])}" for axis in axes)
        where += f"{', ' if where else ''}as at {first}"
    return f"{where}{': ' if where else ''}{reason}"


def reason_of(row: dict[str, Any]) -> str:
    """Why a point counts as stable or not: what its verdict says, or without one its runs."""
    if not row["settles_without_losses"]:
        said = "the loop does not settle even without losses"
    elif row["unstable"]:
        said = "neighbouring trajectories that meet the same losses do not come closer in the simulated runs"
    elif row.get("undecided"):
        said = "the runs are too short to say"
    else:
        said = "neighbouring trajectories that meet the same losses come closer in every run"
    if row.get("verdict") in GREEN and not is_calm(row):  # it is not the verdict that objects
        return said
    return str(row.get("verdict_reason") or said)


def _plain(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


_NUMBERS = re.compile(r"\d+(?:\.\d+)?(?:e[+-]?\d+)?")


def is_calm(row: dict[str, Any]) -> bool:
    """Is every run at this point stable, and its verdict, if there is one, a green one?"""
    is_green = row.get("verdict", MEAN_SQUARE) in GREEN
    return row["unstable"] == 0 and not row.get("undecided") and is_green


def best_point(rows: Rows) -> dict[str, Any]:
    """The point with the smallest worst deviation, of those that are stable if there are some."""
    found = [row for row in rows if is_calm(row)] or rows
    return min(found, key=lambda row: (math.isnan(row["deviation_max_p50"]), row["deviation_max_p50"]))


def _where(name: str, rows: Rows) -> str:
    """The values of the one axis at which the loop is stable; empty where they are not an interval of numbers."""
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
