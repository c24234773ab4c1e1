"""Sweeps from Python: the loop at every point of a grid of parameters, under many seeds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.scenario import Scenario
from agv_analysis.sweep import MOST_POINTS
from agv_analysis.sweep.collect import collect
from agv_analysis.sweep.execute import on_this_machine
from agv_analysis.sweep.plan import Sweep, axis_of
from agv_analysis.sweep.rows_file import write_rows
from agv_analysis.sweep.verdicts import with_verdicts
from agv_ros.errors import UserError


@dataclass(frozen=True)
class SweepResult:
    """What came of a sweep: one row for each point of the grid, the last parameter varying fastest."""

    rows: list[dict[str, Any]]
    """By column: the varied parameters, `runs`, `unstable`, `instability` with its 95 % confidence interval
    `instability_low` and `instability_high`, `undecided`, `diverged`, and of each metric the median `<metric>_p50` and
    the 95th percentile `<metric>_p95`; as in the CSV file of `agv-ncs sweep`. With verdicts `verdict` and
    `verdict_reason`, too."""
    axes: dict[str, tuple[Any, ...]]
    """The values of each varied parameter, by its name."""
    _sweep: Sweep = field(repr=False)

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values of each varied parameter."""
        return self._sweep.shape

    def __getitem__(self, column: str) -> NDArray[Any]:
        """A column as an array of `shape`. Raises UserError if there is none of this name."""
        if column not in self.rows[0]:
            raise UserError(f"the sweep has no column {column!r}, it has {', '.join(self.rows[0])}")
        return np.array([row[column] for row in self.rows]).reshape(self.shape)

    def draw(self, path: str | Path, column: str = "instability") -> None:
        """Draw a column over one or two varied numbers to a PNG, SVG or PDF file. Raises UserError if that fails."""
        from agv_analysis.sweep.picture import draw

        _ = self[column]
        draw(self._sweep, self.rows, column, Path(path))

    def write(self, path: str | Path) -> None:
        """Write the rows to a .csv or a .parquet file. Raises UserError if that fails."""
        write_rows(self.rows, Path(path))


def sweep(
    scenario: Scenario,
    vary: Mapping[str, Iterable[Any]],
    seeds: int = 20,
    workers: int | None = None,
    progress: Callable[[int], None] = lambda runs: None,
    verdicts: bool | None = None,
) -> SweepResult:
    """Simulate a scenario at every combination of the values in `vary`, each under `seeds` seeds from relay.seed on.

    `vary` gives values by parameter: {"controller.kx": [5.0, 25.0], "relay.uplink.p": np.linspace(0.0, 0.5, 11)}. A run
    is unstable if a twin that begins a micrometre away and meets the same losses does not come closer by its end.
    `verdicts`: whether to add the word on each point, by the rules of `agv-ncs stability`; by default for up to 200
    points. `workers` threads, one a core by default, do the work; `progress` receives the number of runs done. Raises
    UserError for a parameter or value that cannot be used.
    """
    plan = Sweep(scenario, tuple(axis_of(name, values) for name, values in vary.items()), seeds)
    plan.check()
    rows, is_complete = collect(plan, None, partial(on_this_machine, plan, workers=workers), progress)
    if not is_complete:
        raise KeyboardInterrupt
    if verdicts or (verdicts is None and len(rows) <= MOST_POINTS):
        rows = with_verdicts(plan, rows, workers)
    return SweepResult(rows, {axis.name: axis.values for axis in plan.axes}, plan)
