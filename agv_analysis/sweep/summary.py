"""A sweep in one row a point: probability of instability, quantiles of the metrics."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.metrics.confidence import clopper_pearson
from agv_analysis.run import Floats
from agv_analysis.simulation.batch import Table
from agv_analysis.simulation.decay import NOT_SETTLED
from agv_analysis.stability.empirical import is_unstable, left_without_losses
from agv_analysis.stability.repeated_run import settles_without_losses
from agv_analysis.sweep import METRICS
from agv_analysis.sweep.plan import Sweep
from agv_analysis.version import version


def summarise(sweep: Sweep, table: Table, done: NDArray[np.bool_]) -> list[dict[str, Any]]:
    """One row a point with at least one run done; `table` and `done` have shape (points, seeds)."""
    return [_row(sweep, point, table[point, done[point]]) for point in range(sweep.size) if done[point].any()]


def _row(sweep: Sweep, point: int, runs: Table) -> dict[str, Any]:
    scenario = sweep.scenario(point)
    settles = settles_without_losses(scenario)
    left = left_without_losses(scenario)
    # Where the loop does not even settle without losses twins may well come together while both drift away.
    said = [is_unstable(contraction, left) if settles else True for contraction in runs["contraction"].tolist()]
    unstable, unsaid = said.count(True), said.count(None)
    low, high = clopper_pearson(unstable, len(runs))[0], clopper_pearson(unstable + unsaid, len(runs))[1]
    row: dict[str, Any] = {axis.name: value for axis, value in zip(sweep.axes, sweep.values(point), strict=True)}
    row |= {
        "runs": len(runs),
        "unstable": unstable,
        "undecided": unsaid,
        "instability": math.nan if unsaid else unstable / len(runs),
        "instability_low": low,
        "instability_high": high,
        "settles_without_losses": settles,
        "diverged": int(np.count_nonzero(np.isinf(runs["contraction"]))),
    }
    for metric in METRICS:
        values = runs[metric].astype(np.float64)
        if metric.startswith("settle"):  # of an AGV that begins on its reference there is nothing to settle
            values[(values == NOT_SETTLED) & np.isnan(runs["overshoot"])] = math.nan
        p50, p95 = quantiles(values, metric.startswith("settle"))
        row |= {f"{metric}_p50": p50, f"{metric}_p95": p95}
    return row | {"first_seed": sweep.seeds[0], "version": version()}


def quantiles(values: Floats, settling: bool) -> tuple[float, float]:
    """Median and 95th percentile, values that occurred; a settling that did not happen counts as inf.

    NaN where a metric is not defined in every run, as the settling of an AGV that begins on its reference.
    """
    if settling:
        values = np.where(values == NOT_SETTLED, np.inf, values)
    if np.isnan(values).any():
        return math.nan, math.nan
    p50, p95 = np.percentile(values, [50.0, 95.0], method="inverted_cdf")
    return float(p50), float(p95)
