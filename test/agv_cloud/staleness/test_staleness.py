"""Staleness policies: the predictor against the plant itself."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.simulation import simulate
from agv_cloud.reference.point import ReferencePoint
from agv_cloud.staleness.estimate import PoseEstimator
from agv_cloud.staleness.registry import PREDICT, STALENESS_POLICIES
from agv_plant.vehicle.unicycle import STEPS
from agv_ros.pose import Pose

PAPER = str(Path(__file__).parents[3] / "config/paper.yaml")

speeds = st.floats(-5.0, 5.0)


def predictor(model: str, ts: float) -> PoseEstimator:
    return PoseEstimator(STALENESS_POLICIES.find("predict"), PREDICT, (), ts, model == "arc")


def standing(_: int) -> ReferencePoint:
    return ReferencePoint(0.0, 0.0, 0.0, 0.0, 0.0)


commands = st.lists(st.tuples(speeds, speeds), min_size=1, max_size=40)


@given(commands, st.data(), st.sampled_from(sorted(STEPS)))
def test_a_prediction_is_where_the_plant_is(sent: list[tuple[float, float]], data: st.DataObject, model: str) -> None:
    """Whenever poses come and however old they are, to the last bit."""
    true, prediction, taken = [Pose(1.0, 2.0, 0.3)], predictor(model, 0.01), 0
    for k, (v, w) in enumerate(sent):
        taken = data.draw(st.integers(taken, k))
        assert prediction.at(k, taken, true[taken], standing).held == true[k]
        prediction.add_command(k, v, w)
        true.append(Pose(*STEPS[model](*true[k], v, w, 0.01)))


def test_a_step_without_command_goes_on_with_the_one_before() -> None:
    prediction = predictor("euler", 0.5)
    prediction.add_command(0, 2.0, 0.0)
    assert prediction.at(3, 0, Pose(0.0, 0.0, 0.0), standing).held == (3.0, 0.0, 0.0)
    assert prediction.has_command(0)
    assert not prediction.has_command(3)


def scenario(*settings: str) -> Scenario:
    return load_scenario(PAPER, [*settings, "plant.duration=20.0"])


@pytest.mark.parametrize("n", [1, 13, 200])
def test_with_an_exact_model_outages_do_not_matter(n: int) -> None:
    outages = ("relay.uplink.model=burst", f"relay.uplink.n={n}")
    lossy = simulate(scenario(*outages, "error_detector.policy=predict"))
    np.testing.assert_allclose(lossy.pose, simulate(scenario()).pose, rtol=0.0, atol=1e-12)


def test_aligned_zero_error_is_an_equilibrium() -> None:
    outages = ("relay.uplink.model=burst", "relay.uplink.n=9")
    start = "plant.initial_pose=[0.0, 0.0, 1.5707963267948966]"
    run = simulate(scenario(start, *outages, "error_detector.policy=align"))
    assert np.array_equal(run.pose, run.reference[:, :3])


@pytest.mark.parametrize(("scale", "settles"), [(1.1, True), (1.9, True), (2.1, False)])
def test_a_predictor_with_a_wrong_speed_is_stable_below_its_bound(scale: float, settles: bool) -> None:
    """On a line with a = T_s K_x = 0.125: stable for every n if |delta| a < 1 - |1 - a|, that is |delta| < 1."""
    run = simulate(
        scenario(
            "error_detector.policy=predict", f"plant.speed_scale={scale}", "error_detector.track=line",
            "relay.uplink.model=burst", "relay.uplink.n=200",
        )
    )  # fmt: skip
    residual = abs(scale - 1.0) * 1.0 * 200 * 0.005
    last = np.abs(run.reference[-400:, 1] - run.pose[-400:, 1]).max()
    assert (last < 20.0 * residual) == settles
    if scale == 1.1:
        assert last == pytest.approx(residual, rel=0.15)
    assert math.isfinite(last)
