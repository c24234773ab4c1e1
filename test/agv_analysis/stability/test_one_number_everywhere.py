"""Every place that shows a margin shows the same one: with a wrong speed, a lag, a delay and a predictor."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.explore.background_criteria import criteria_rows
from agv_analysis.explore.response import summary_rows
from agv_analysis.report.eigenvalues import lifted_multipliers
from agv_analysis.report.page import render
from agv_analysis.report.table import rows
from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.stability.analysis import Analysis, analyse
from agv_analysis.stability.margin_map import margin_map
from agv_analysis.stability.margin_map_points import LIMIT
from agv_analysis.stability.margins import margins
from agv_analysis.sweep.borders import margins as border_margins
from agv_analysis.sweep.plan import parse_axis

PAPER = str(Path(__file__).parents[3] / "config" / "paper.yaml")
LATE = ("error_detector.track=line", "plant.speed_scale=1.3", "relay.uplink.delay=0.05", "plant.duration=5.0")
SCENARIOS = {
    "held": LATE,
    "held and lagging": (*LATE, "plant.lag=0.05"),
    "predicted and lagging": (*LATE, "plant.lag=0.05", "error_detector.policy=predict"),
    "another law": (*LATE, "controller.law=state_feedback", "controller.state_feedback.kx=25.0"),
    "another vehicle": (*LATE, "plant.vehicle=bicycle", "plant.bicycle.steering_lag=0.1"),
}


def numbers_in(text: str) -> list[float]:
    return [float(word) for word in re.findall(r"-?\d+(?:\.\d+)?(?:e-?\d+)?", text)]


@pytest.fixture(scope="module", params=SCENARIOS)
def scenario(request: pytest.FixtureRequest) -> Scenario:
    return load_scenario(PAPER, SCENARIOS[request.param])


@pytest.fixture(scope="module")
def analysis(scenario: Scenario) -> Analysis:
    return analyse(simulate(scenario))


def test_the_growth_with_a_pose_that_is_always_that_old(scenario: Scenario, analysis: Analysis) -> None:
    """JSON, terminal, explorer, report and the eigenvalues that it draws."""
    radius, n = analysis.lifted_radius, analysis.n
    assert n == 10
    assert radius is not None
    assert analysis.to_json()["lifted_radius"] == radius
    assert dict(rows(analysis))[f"Pose always {n} steps old"].endswith(f"spectral radius {radius:.6g})")
    assert f"spectral radius {radius:.6g}" in render(analysis)
    at_once = dict(summary_rows(analysis.run))["Pose always that old"]
    assert numbers_in(at_once) == [pytest.approx(radius, abs=6e-5)]  # five digits
    assert at_once.startswith("stable" if radius < 1.0 else "unstable")
    if scenario.error_detector.policy == "hold":
        assert np.abs(lifted_multipliers(analysis)).max() == pytest.approx(radius, rel=1e-9)


def test_the_largest_n(scenario: Scenario, analysis: Analysis) -> None:
    """Margins, map, explorer and report; and the run's radius is on the side of it that they say."""
    found = margins(scenario)
    gains = scenario.controller.gains
    mapped = margin_map(scenario, ("kx", "ts"), np.array([gains[0]]), np.array([scenario.plant.ts]))
    n = LIMIT if found.n_lifted is None else found.n_lifted
    assert mapped.margins["n_lifted"].tolist() == [[n]]
    assert (n >= analysis.n) == analysis.lifted_stable
    shown = dict(found.rows())["Pose always n steps old"]
    assert shown.startswith(f"{n} steps" if found.n_lifted is not None else "no bound")
    assert dict(criteria_rows(scenario))["Pose always n steps old"] == shown
    assert shown in render(analysis)


def test_the_number_of_the_fault_that_was_seen() -> None:
    """A pose 10 steps old, 1.3 times as fast as commanded: 1.00570 and n = 9, by the dense lifted matrix."""
    analysis = analyse(simulate(load_scenario(PAPER, LATE)))
    a = 0.005 * 25.0 * 1.3
    companion = np.eye(11, k=-1)
    companion[0, 0], companion[0, 10] = 1.0, -a
    truth = float(np.abs(np.linalg.eigvals(companion)).max())
    assert truth == pytest.approx(1.00570, abs=5e-6)
    assert analysis.lifted_radius == pytest.approx(truth, rel=1e-9)
    assert margins(load_scenario(PAPER, LATE)).n_lifted == 9


def test_the_border_of_a_sweep_is_that_of_the_margins() -> None:
    """Mean square along a line at a true speed 1.3 times the commanded one: p* = (2 - a) / (2 + a)."""
    settings = ("error_detector.track=line", "plant.speed_scale=1.3", "relay.uplink.model=bernoulli")
    base = load_scenario(PAPER, settings)
    p = margins(base).p_mean_square
    a = 0.005 * 25.0 * 1.3
    assert p is not None
    assert p == pytest.approx((2.0 - a) / (2.0 + a), rel=1e-6)
    axis = (parse_axis("relay.uplink.p=0.1,0.9"),)
    below, above = border_margins(base, axis, [(p - 1e-5,), (p + 1e-5,)])["mean square"]
    assert below < 0.0 < above
    lagging = load_scenario(PAPER, [*settings, "plant.lag=0.05"])  # where theory along the track is silent
    assert np.isnan(border_margins(lagging, axis, [(0.5,)])["mean square"]).all()
