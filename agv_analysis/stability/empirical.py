"""The empirical criterion: twins that begin apart, meet the same losses, and come together or not.

No theory goes in, so it is the judge of all others, and it knows what they leave out: the nonlinear loop far from its
reference, limits on speed, the downlink's losses, an actuator that lags. What it says holds for the runs that were
driven and no others.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from agv_analysis.run import Floats, Run
from agv_analysis.scenario import Scenario
from agv_analysis.simulation import simulate_batch
from agv_analysis.simulation.single import steps_of
from agv_analysis.stability.scenario_loop import lap_of
from agv_cloud.reference.reference import lap_steps
from agv_plant.parameters import RelayParameters
from agv_ros.errors import UserError

LONG_ENOUGH = 0.1
"""A run in which a perfect link leaves more than this of the distance of twins is shorter than the loop's transient."""

_FAR = 1e6
"""Twins that are this multiple of a micrometre apart are so for good, however short the run."""


@dataclass(frozen=True)
class Twins:
    """Distances of twins in (x, y, theta) [m, m, rad] at the end of a run, as multiples of those at its beginning."""

    contraction: Floats
    """One value a run, shape (runs,); inf if the loop is no longer finite."""
    different: int | None = None
    """How many of the runs differ from each other: 1 where nothing depends on the seed. None: unknown."""
    steps: int | None = None
    """Length of a run [steps], if it is known."""
    left_without_losses: float = 0.0
    """What a run without losses leaves of the distance, as of the function of this name."""

    @property
    def is_long_enough(self) -> bool:
        """Do runs last long enough for twins that do not come together to say anything against the loop?"""
        return self.left_without_losses <= LONG_ENOUGH

    @property
    def evidence(self) -> tuple[int, int] | None:
        """How many of how many runs contract; None where they are too short to say anything against the loop."""
        return (self.contracting, len(self.contraction)) if self.is_long_enough else None

    @property
    def contracting(self) -> int:
        """Number of runs whose twins ended closer to each other than they began."""
        return int(np.count_nonzero(self.contraction < 1.0))

    @property
    def mostly_contracting(self) -> bool:
        """Do nine in ten runs contract?"""
        return self.contracting >= 0.9 * len(self.contraction)

    @property
    def median(self) -> float:
        """The contraction that half of the runs reach."""
        return float(np.median(self.contraction))

    def to_json(self) -> dict[str, Any]:
        """The figures by name; JSON has no infinity."""
        median = self.median if math.isfinite(self.median) else None
        return {"runs": len(self.contraction), "contracting": self.contracting, "median_contraction": median}


def too_short(left: float) -> str:
    """That runs are shorter than the transient, with what a run without losses leaves of the distance of twins."""
    return f"the runs are too short to say: without losses, too, {left:.0%} of the distance are left at their end"


def with_an_end(scenario: Scenario) -> Scenario:
    """The scenario, ended after one lap of its track if it has no end."""
    if math.isfinite(scenario.plant.duration):
        return scenario
    duration = lap_steps(scenario.error_detector) * scenario.plant.ts
    return replace(scenario, plant=replace(scenario.plant, duration=duration))


def simulated_twins(scenario: Scenario, seeds: Sequence[int]) -> Twins:
    """Twins of a scenario under each seed, a micrometre and a microradian apart at first, by simulation.

    Of a measured link with times that is longer than the run each seed is another part. A contraction of 1e-9 or so is
    rounding: they have met. Raises UserError if the run has no end.
    """
    runs = simulate_batch([scenario], seeds, twins=True)[0]
    return Twins(
        runs["contraction"], len({run.tobytes() for run in runs}), steps_of(scenario), left_without_losses(scenario)
    )


def is_unstable(contraction: float, left: float) -> bool | None:
    """Is a run unstable, by how far its twins are apart at its end and by what a run without losses leaves?

    It is if they are not closer than they began. None where the run is shorter than the transient, so that this says
    nothing, unless they are a metre apart by then.
    """
    if contraction < 1.0:
        return False
    return None if left > LONG_ENOUGH and contraction < _FAR else True


def left_without_losses(scenario: Scenario) -> float:
    """Distance of twins at the end of a run without losses, as a multiple of that at its beginning.

    0 where the reference never moves: what the commands do not reach stays forever, however long the run.
    """
    relay = RelayParameters(ts=scenario.relay.ts, start_time=scenario.relay.start_time)
    return _left(replace(scenario, relay=relay))  # the same whatever the links are


@functools.lru_cache(maxsize=1024)
def _left(scenario: Scenario) -> float:
    if not lap_of(scenario)[:, 3:].any():
        return 0.0
    return float(simulate_batch([scenario], [scenario.relay.seed], workers=1, twins=True)["contraction"][0, 0])


def distances(run: Run, twin: Run) -> Floats:
    """Distance of two recorded runs in (x, y, theta) [m, m, rad] at each step, shape (N,).

    Raises UserError unless both have the same steps and met the same losses on both links.
    """
    for name in ("k", "lost", "downlink_lost"):
        if not np.array_equal(getattr(run, name), getattr(twin, name)):
            raise UserError(f"{run.source} and {twin.source} are not twins: they differ in {name}")
    return np.asarray(np.linalg.norm(run.pose - twin.pose, axis=1))
