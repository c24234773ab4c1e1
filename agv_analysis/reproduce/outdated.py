"""The loop with a pose that is always n steps old.

Outages make the age n_ul a sawtooth; the lifted system asks for a constant one, which no channel of the relay makes.
Here it is simulated, by the same functions of a slot.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled import compiled, numbers
from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.batch import TWIN_OFFSET
from agv_analysis.simulation.loop import Loop, Rows, Settings, answer, at_rest, goes_on, obey, received
from agv_analysis.simulation.single import settings_of, steps_of
from agv_cloud.reference import Reference


def poses(scenario: Scenario, n: int, offset: float = 0.0) -> Floats:
    """X_c(k) of a run whose pose at the edge is always X_c(k - n), of X_c(0) for k < n; shape (steps, 3).

    The AGV starts `offset` [m, m, rad] away from the scenario's initial pose. Fewer rows than steps if the loop left
    the range of numbers.
    """
    reference = Reference(scenario.error_detector).first(steps_of(scenario))
    rows = np.empty((len(reference), 3))
    start = at_rest(*(value + offset for value in scenario.plant.initial_pose))
    return rows[: compiled(drive)(numbers(reference), start, settings_of(scenario), n, rows)]


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


def drive(reference: Rows, start: Loop, settings: Settings, n: int, rows: NDArray[np.float64]) -> int:
    """One run, written down: X_c(k) into rows[k]; returns the number of slots until it ended."""
    loop = start
    for k in range(len(reference)):
        x_r, y_r, theta_r, v_r, w_r = reference[k]
        rows[k, 0], rows[k, 1], rows[k, 2] = loop.x, loop.y, loop.theta
        then = max(0, k - n)
        x, y, theta = rows[then]
        x_then, y_then, theta_then, _, _ = reference[then]
        held = received(loop, x, y, theta, x_then, y_then, theta_then, k - then)
        sent = answer(held, x_r, y_r, theta_r, v_r, w_r, settings)
        loop = obey(held, sent, False, 0.0, 0.0, v_r, w_r, settings)
        if not goes_on(loop, sent):
            return k + 1
    return len(reference)
