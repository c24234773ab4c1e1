"""Many runs on all cores, of each only its statistics: no history is kept, whatever the number of runs."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import get_type_hints

import numpy as np
from numpy.typing import NDArray

from agv_analysis.scenario import Scenario
from agv_analysis.simulation.compiled import compiled, numbers
from agv_analysis.simulation.loop import Statistics, at_rest, statistics
from agv_analysis.simulation.single import settings_of, steps_of
from agv_analysis.simulation.verdicts import Air
from agv_cloud.parameters import ErrorDetectorParameters
from agv_cloud.reference import Reference

STATISTICS = np.dtype([(name, np.dtype(kind)) for name, kind in get_type_hints(Statistics).items()])
"""One run's row: the fields of `loop.Statistics`, int64 and float64."""

Table = NDArray[np.void]
Postures = Callable[[ErrorDetectorParameters, int], NDArray[np.float64]]

_UNITS_PER_WORKER = 4
"""Each seed's runs are cut in so many parts that every worker gets at least this many, so that none waits long."""


def simulate_batch(
    scenarios: Sequence[Scenario],
    seeds: Sequence[int],
    workers: int | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> Table:
    """Statistics of every scenario under every seed, an array of STATISTICS of shape (scenarios, seeds).

    Seeds are paired: under one seed all scenarios with the same channel meet the same outages; `relay.seed` of the
    scenarios does not count. `workers` threads, one a core by default, do the work; their number changes nothing in the
    result. `progress` is told how many runs are done. Raises UserError if a run has no end.
    """
    steps = [steps_of(scenario) for scenario in scenarios]
    workers = workers or cores()
    table = np.zeros((len(scenarios), len(seeds)), dtype=STATISTICS)
    postures: Postures = functools.lru_cache(maxsize=16)(lambda detector, n: Reference(detector).first(n))

    def work(column: int, part: range) -> int:
        airs = functools.cache(functools.partial(Air, seeds[column]))
        for row in part:
            table[row, column] = _run(scenarios[row], steps[row], airs(steps[row]), postures)
        return len(part)

    done = 0
    with ThreadPoolExecutor(workers) as pool:
        try:
            units = [pool.submit(work, *unit) for unit in _units(len(scenarios), len(seeds), workers)]
            for unit in as_completed(units):
                done += unit.result()
                progress(done)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return table


def _run(scenario: Scenario, steps: int, air: Air, postures: Postures) -> Statistics:
    relay = scenario.relay
    found: Statistics = compiled(statistics)(
        numbers(postures(scenario.error_detector, steps)),
        numbers(air.verdicts(relay.uplink, "uplink")),
        numbers(air.verdicts(relay.downlink, "downlink")),
        at_rest(*scenario.plant.initial_pose),
        settings_of(scenario),
    )
    return found


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _units(rows: int, columns: int, workers: int) -> list[tuple[int, range]]:
    """Work in parts: (column, rows of it), at least `_UNITS_PER_WORKER` a worker where there is enough to do."""
    parts = -(-_UNITS_PER_WORKER * workers // max(1, columns))
    size = max(1, rows // parts)
    return [(column, range(rows)[first : first + size]) for column in range(columns) for first in range(0, rows, size)]
