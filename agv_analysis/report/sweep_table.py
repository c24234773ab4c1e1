"""The table of a sweep's report: of a point's many columns the ten that matter, in words and units."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from agv_analysis.metrics.confidence import computed
from agv_analysis.metrics.deviation import DIVERGED
from agv_analysis.metrics.distance_text import DIVERGES, three_digits
from agv_analysis.sweep.axis_words import axis_words
from agv_analysis.sweep.plan import Sweep

Row = dict[str, Any]


def sweep_table(sweep: Sweep, rows: list[Row]) -> tuple[list[str], list[list[str]]]:
    """Heads, and the cells of each point, as text; the varied parameters first."""
    columns = [
        *((axis_words(axis, sweep.base), _value_of(axis.name)) for axis in sweep.axes),
        *_columns(sweep, rows[0] if rows else {}),
    ]
    return [head for head, _ in columns], [[cell(row) for _, cell in columns] for row in rows]


def number(value: Any) -> str:
    """A value in up to four digits, `-` for none."""
    if isinstance(value, float):
        return "-" if math.isnan(value) else "none" if math.isinf(value) else f"{value:.4g}"
    return str(value)


def _columns(sweep: Sweep, first: Row) -> list[tuple[str, Callable[[Row], str]]]:
    found: list[tuple[str, Callable[[Row], str]]] = []
    if "verdict" in first:
        found.append(("verdict", lambda row: str(row["verdict"])))
    found += [
        ("probability of instability", lambda row: _digits(row["instability"])),
        ("95 % interval", lambda row: f"{row['instability_low']:.3f} .. {row['instability_high']:.3f}"),
        ("settled to 1 cm [s], median", lambda row: _seconds(row["settle_1cm_steps_p50"], _period(sweep, row))),
        ("worst deviation [m], median", lambda row: _distance(row["deviation_max_p50"])),
        ("worst deviation [m], 95 % of runs below", lambda row: _distance(row["deviation_max_p95"])),
    ]
    if "p_lap" in first:
        found += [
            ("any outages in the corridor, up to [slots]", lambda row: _outages(row["n_any"])),
            ("leaves the corridor in an hour", lambda row: computed(row["p_hour"])),
        ]
    else:
        found += [
            ("top speed asked for [m/s], median", lambda row: _digits(row["speed_max_p50"])),
            ("oldest pose [steps], median", lambda row: _digits(row["n_ul_max_p50"])),
        ]
    return found


def _value_of(name: str) -> Callable[[Row], str]:
    return lambda row: number(row[name])


def _period(sweep: Sweep, row: Row) -> float:
    """T_s of a point [s], which any node's axis may vary."""
    return float(next((row[axis.name] for axis in sweep.axes if axis.parameter == "ts"), sweep.base.plant.ts))


def _digits(value: float) -> str:
    return "-" if math.isnan(value) else "unbounded" if math.isinf(value) else f"{value:.3g}"


def _distance(value: float) -> str:
    """A distance in a column of metres."""
    if math.isnan(value):
        return "-"
    if not value <= DIVERGED:
        return DIVERGES
    return f"below {_SMALLEST:g}" if 0.0 < value < _SMALLEST else three_digits(value)


_SMALLEST = 1e-4
"""Distances [m] below which their digits say no more."""


def _outages(value: float) -> str:
    return "no limit found" if math.isinf(value) else "none" if value < 0.0 else _digits(value)


def _seconds(steps: float, ts: float) -> str:
    return "-" if math.isnan(steps) else "never" if math.isinf(steps) else f"{steps * ts:.3g}"
