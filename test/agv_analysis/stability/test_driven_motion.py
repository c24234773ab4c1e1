"""Displacements of whole runs about the motion that was driven, against numerical derivatives."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.run import Floats, Run
from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.stability.driven_motion import displacement_growths, pose_derivatives
from agv_analysis.stability.paper import matrices
from agv_cloud.control.command import limit_speed
from agv_cloud.control.kanayama import kanayama
from agv_cloud.parameters import ControllerParameters
from agv_cloud.tracking_error import tracking_error
from agv_plant.vehicle.unicycle import euler_step

CONFIG = str(Path(__file__).parents[3] / "config" / "paper.yaml")
PAPER = load_scenario(CONFIG)
TS = 0.005


# -- about any motion ------------------------------------------------------------------------------------------------


def step(pose: Floats, held: Floats, reference: Floats, by: ControllerParameters) -> Floats:
    x_r, y_r, theta_r, v_r, w_r = reference.tolist()
    error = tracking_error(x_r, y_r, theta_r, *held.tolist())
    v, w = kanayama(*error, v_r, w_r, by.kx, by.ky, by.ktheta)
    x, y, theta = pose.tolist()
    return np.array(euler_step(x, y, theta, limit_speed(v, by.v_max), w, TS))


@pytest.mark.parametrize("v_max", [math.inf, 6.0])
def test_derivatives_of_the_loop_far_from_its_reference(v_max: float) -> None:
    random, by, h = np.random.default_rng(8), ControllerParameters(kx=8.0, ky=1.5, ktheta=2.5, v_max=v_max), 1e-6
    pose, held = random.uniform(-2.0, 2.0, (2, 60, 3))
    reference = random.uniform(-2.0, 2.0, (60, 5))
    scenario = dataclasses.replace(PAPER, controller=by)
    now, outdated = pose_derivatives(scenario, pose, held, reference[:, :3], reference[:, 3:])
    limited = 0
    for k in range(60):
        answers = [step(pose[k], held[k] + d, reference[k], by) for d in h * np.vstack((np.eye(3), -np.eye(3)))]
        np.testing.assert_allclose(
            outdated[k], np.array([answers[i] - answers[i + 3] for i in range(3)]).T / (2 * h), atol=1e-8
        )
        answers = [step(pose[k] + d, held[k], reference[k], by) for d in h * np.vstack((np.eye(3), -np.eye(3)))]
        np.testing.assert_allclose(
            now[k], np.array([answers[i] - answers[i + 3] for i in range(3)]).T / (2 * h), atol=1e-8
        )
        limited += not outdated[k, :2].any()
    assert limited == 0 if math.isinf(v_max) else 5 < limited < 55


def test_a_of_the_paper_is_their_sum_at_zero_error() -> None:
    random = np.random.default_rng(9)
    held = random.uniform(-2.0, 2.0, (40, 3))
    pose, speeds = random.uniform(-2.0, 2.0, (40, 3)), random.uniform(-2.0, 2.0, (40, 2))
    now, outdated = pose_derivatives(PAPER, pose, held, held, speeds)
    np.testing.assert_allclose(
        now + outdated, matrices(pose[:, 2], held[:, 2], speeds[:, 0], ControllerParameters(), TS), atol=1e-14
    )


# -- the motion that was driven --------------------------------------------------------------------------------------


def scenario_of(v_max: float, model: str) -> Scenario:
    setting = [f"relay.uplink.{model}", "relay.uplink.p=0.4", "relay.uplink.n=5", "plant.duration=0.505"]
    return load_scenario(CONFIG, [*setting, "error_detector.lap_time=1.0", f"controller.v_max={v_max}"])


def started(scenario: Scenario, pose: Floats) -> Run:
    x, y, theta = pose.tolist()
    return simulate(
        dataclasses.replace(scenario, plant=dataclasses.replace(scenario.plant, initial_pose=(x, y, theta)))
    )


@pytest.mark.parametrize("v_max", [math.inf, 6.0])
@pytest.mark.parametrize("model", ["model=perfect", "model=bernoulli", "model=burst"])
def test_a_run_by_its_numerical_derivative(v_max: float, model: str) -> None:
    """100 steps far off the reference, each column of dX_c(100) / dX_c(0) from two displaced runs."""
    scenario, start, h = scenario_of(v_max, model), np.array([0.3, 0.6, 1.2]), 1e-6
    run = started(scenario, start)
    derivative = np.column_stack([
        (started(scenario, start + h * unit).pose[100] - started(scenario, start - h * unit).pose[100]) / (2.0 * h)
        for unit in np.eye(3)
    ])  # fmt: skip
    truth = np.sort(np.log(np.abs(np.linalg.eigvals(derivative))))[::-1]
    found = displacement_growths(scenario, run.pose[:100], run.reference[:100], run.lost[:100])
    np.testing.assert_allclose(found[:2], truth[:2], atol=1e-5)
    assert found[2] == pytest.approx(truth[2], abs=0.05)  # of 1e-9: what differences of 1e-6 can tell
