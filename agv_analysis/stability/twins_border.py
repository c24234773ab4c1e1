"""Up to which independent losses do simulated twins of a scenario contract? The nonlinear border, by experiment.

The criteria ask of small errors. Under `hold` the bias of an outage throws the AGV out of the range in which errors are
small long before the linear border of almost sure convergence; what the loop itself does is simulated here.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

from agv_analysis.scenario import Scenario
from agv_analysis.simulation import simulate_batch
from agv_analysis.stability.criteria.criterion import Margin
from agv_analysis.stability.empirical import LONG_ENOUGH, left_without_losses, too_short
from agv_analysis.stability.repeated_run import settles_without_losses
from agv_ros.counted import counted

NAME, LABEL = "p_max.twins", "Independent losses, most simulated runs converge"

SEEDS = 20
"""Runs at each loss probability."""

_GRID = (0.0, 0.2, 0.4, 0.6, 0.7, 0.8, 0.85, 0.9, 0.93, 0.95, 0.97, 0.98, 0.99, 0.995, 0.999)

_NARROWED = 0.002
"""Width to which the border is narrowed; with so few runs a finer one would be chance."""


def twins_border(scenario: Scenario, seeds: int = SEEDS, progress: Callable[[int], None] = lambda done: None) -> Margin:
    """The loss probability up to which more than half of a scenario's twins contract, all else being as it is.

    The scenario must have an end. From 0 upwards on a grid, so that it is the first border, then by bisection.
    `progress` receives the number of probabilities done.
    """
    done = 0

    def contract(p: float) -> bool:
        nonlocal done
        uplink = dataclasses.replace(scenario.relay.uplink, model="bernoulli", p=p, schedule="")
        lossy = dataclasses.replace(scenario, relay=dataclasses.replace(scenario.relay, uplink=uplink))
        first, needed = scenario.relay.seed, seeds // 2 + 1

        def contracting(begin: int, end: int) -> int:
            found = simulate_batch([lossy], range(first + begin, first + end), twins=True)["contraction"][0]
            return int((found < 1.0).sum())

        count = contracting(0, needed)
        if count < needed <= count + seeds - needed:  # else the others cannot change it
            count += contracting(needed, seeds)
        done += 1
        progress(done)
        return count >= needed

    left = left_without_losses(scenario)
    if LONG_ENOUGH < left < math.inf and settles_without_losses(scenario):
        return Margin(NAME, LABEL, None, reason=f"no answer: {too_short(left)}")
    above = next((p for p in _GRID if not contract(p)), None)
    if above is None:
        return Margin(
            NAME, LABEL, None, reason=f"no bound: most of {counted(seeds, 'run')} contract at every p up to {_GRID[-1]}"
        )
    if above == 0.0:
        return Margin(NAME, LABEL, None, reason="not met: simulated runs do not converge even without losses")
    below = _GRID[_GRID.index(above) - 1]
    while above - below > _NARROWED:
        middle = 0.5 * (below + above)
        below, above = (middle, above) if contract(middle) else (below, middle)
    return Margin(
        NAME, LABEL, below, f"below {below:.3f}, by {counted(seeds, 'run')} at each of {done} loss probabilities"
    )
