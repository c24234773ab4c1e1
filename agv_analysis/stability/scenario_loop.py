"""The linear loop of a scenario over one lap of its track, and of a run over the steps that it has."""

from __future__ import annotations

import math

import numpy as np

from agv_analysis.run import Floats, Run
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.reference import reference_of
from agv_analysis.stability.linear_loop import LinearLoop, kanayama_loop
from agv_cloud.reference.reference import lap_steps


def lap_of(scenario: Scenario) -> Floats:
    """X_r(k) and its speeds over one lap, of a track from a file over the run: x, y, theta, v_r, w_r, shape (N, 5).

    Raises TrackFileError if the track's file cannot be used.
    """
    steps = lap_steps(scenario.error_detector)
    if scenario.error_detector.track == "csv" and math.isfinite(scenario.plant.duration):
        steps = round(scenario.plant.duration / scenario.plant.ts)
    return reference_of(scenario.error_detector, max(1, steps))


def loop_of(scenario: Scenario) -> LinearLoop:
    """The loop of a scenario over one lap. Raises TrackFileError if the track's file cannot be used."""
    return loop_along(scenario, lap_of(scenario))


def straight_loop_of(scenario: Scenario) -> LinearLoop:
    """The loop of a scenario on a straight track at 1 m/s."""
    return loop_along(scenario, np.array([[0.0, 0.0, 0.0, 1.0, 0.0]]))


def loop_of_run(run: Run) -> LinearLoop:
    """The loop of a run over its steps."""
    return loop_along(run.scenario, run.reference)


def loop_along(scenario: Scenario, reference: Floats) -> LinearLoop:
    """The loop of a scenario along any reference, rows x, y, theta, v_r, w_r, shape (N, 5).

    To first order a predictor that integrates otherwise than the plant is exact.
    """
    return kanayama_loop(
        reference[:, 3], reference[:, 4], scenario.controller, scenario.plant.ts,
        predicts=scenario.error_detector.policy == "predict", speed_scale=scenario.plant.speed_scale,
    )  # fmt: skip
