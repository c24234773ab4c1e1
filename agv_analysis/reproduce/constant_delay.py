"""The loop with a pose that is always n steps old, as a relay that delays each pose makes it.

Outages make the age n_ul a sawtooth; the lifted system asks for a constant one.
"""

from __future__ import annotations

import dataclasses
import math

from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.batch import TWIN_OFFSET
from agv_analysis.simulation.single import simulate, steps_of
from agv_cloud.reference.reference import Reference
from agv_plant.parameters import ChannelParameters


def poses(scenario: Scenario, n: int, offset: float = 0.0) -> Floats:
    """X_c(k) of a run whose pose at the edge is always X_c(k - n), of X_c(0) for k < n; shape (steps, 3).

    The AGV starts `offset` [m, m, rad] away from the scenario's initial pose. Fewer rows than steps if a pose
    is no longer finite.
    """
    late = ChannelParameters(delay=n * scenario.plant.ts)
    x, y, theta = (value + offset for value in scenario.plant.initial_pose)
    plant = dataclasses.replace(scenario.plant, initial_pose=(x, y, theta))
    relay = dataclasses.replace(scenario.relay, uplink=late, downlink=ChannelParameters())
    return simulate(dataclasses.replace(scenario, plant=plant, relay=relay)).pose


def final_error(scenario: Scenario, n: int) -> float:
    """Distance between AGV and reference at the end of such a run [m]."""
    driven = poses(scenario, n)
    reference = Reference(scenario.error_detector)[len(driven) - 1]
    return math.hypot(reference.x - driven[-1, 0], reference.y - driven[-1, 1])


def contraction(scenario: Scenario, n: int) -> float:
    """Distance of twins at the end of such a run, as a multiple of that at its beginning; inf if one diverged.

    The largest of the last hundredth of the run: a distance that oscillates may be small at any one step.
    """
    run, twin = poses(scenario, n), poses(scenario, n, TWIN_OFFSET)
    if len(run) != len(twin) or len(run) < steps_of(scenario):
        return math.inf
    apart = [math.hypot(*moved) for moved in (twin - run).tolist()]
    return max(apart[-max(1, len(apart) // 100) :]) / apart[0]
