"""The linear loop of a scenario over one lap of its track, and of a run over the steps that it has."""

from __future__ import annotations

import functools
import math

import numpy as np

from agv_analysis.run import Floats, Run
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.reference import reference_of
from agv_analysis.stability.derived_loop import linear_loop
from agv_analysis.stability.error_dynamics import NoNominalMotionError
from agv_analysis.stability.linear_loop import LinearLoop
from agv_cloud.reference.reference import lap_steps


def lap_of(scenario: Scenario) -> Floats:
    """X_r(k) and its speeds over one lap, of a track from a file over the run: x, y, theta, v_r, w_r, shape (N, 5).

    Raises TrackFileError if the track's file cannot be used.
    """
    steps = lap_steps(scenario.error_detector)
    if scenario.error_detector.track == "csv" and math.isfinite(scenario.plant.duration):
        steps = round(scenario.plant.duration / scenario.plant.ts)
    return reference_of(scenario.error_detector, max(1, steps))


def loop_on_lap(scenario: Scenario) -> LinearLoop:
    """The loop of a scenario over one lap.

    Raises TrackFileError if the track's file cannot be used, NoNominalMotionError if the loop does not settle even
    without losses.
    """
    return loop_along(scenario, lap_of(scenario))


@functools.lru_cache(maxsize=256)
def straight_loop_of(scenario: Scenario) -> LinearLoop | None:
    """The loop of a scenario on a straight track at 1 m/s; None if it does not settle there even without losses."""
    try:
        return linear_loop(scenario, np.array([1.0]), np.array([0.0]))
    except NoNominalMotionError:
        return None


def loop_of_run(run: Run) -> LinearLoop:
    """The loop of a run over its steps, which count as a lap. Raises NoNominalMotionError as `loop_on_lap`."""
    return loop_along(run.scenario, run.reference)


def loop_along(scenario: Scenario, reference: Floats) -> LinearLoop:
    """The loop along any lap, rows x, y, theta, v_r, w_r, shape (N, 5).

    A law that looks ahead is given the rows to come. Raises NoNominalMotionError as `loop_on_lap`.
    """
    ahead = scenario.controller.steps_ahead
    v_r, w_r = (np.roll(reference[:, column], -ahead) for column in (3, 4))
    return linear_loop(scenario, v_r, w_r)
