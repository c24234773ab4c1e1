"""Twins: against powers of the linearised loop, and on both sides of each border, simulated and recorded."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.stability.empirical import distances, simulated_twins
from agv_analysis.stability.linearisation import step_matrices
from agv_analysis.stability.margins import left_out, margins
from agv_ros.errors import UserError

if TYPE_CHECKING:
    from test.conftest import Drive

PAPER = str(Path(__file__).parents[3] / "config/paper.yaml")
LINE = ("error_detector.track=line", f"plant.initial_pose=[0.0, 0.0, {math.pi / 2}]")  # on the track
MOVED = f"plant.initial_pose=[0.001, -0.001, {math.pi / 2 + 0.001}]"


def scenario(*settings: str) -> Scenario:
    return load_scenario(PAPER, [*LINE, *settings])


def test_without_outages_twins_approach_by_the_power_of_the_loop() -> None:
    wanted = scenario("plant.duration=0.5")
    F, G = step_matrices(np.ones(1), np.zeros(1), wanted.controller, 0.005)
    apart = np.linalg.matrix_power(F[0] + G[0], 100) @ [1.0, -1.0, 1.0]  # the track heads north
    found = simulated_twins(wanted, range(3))
    assert found.contraction == pytest.approx(np.linalg.norm(apart) / math.sqrt(3.0), rel=1e-4)
    assert found.to_json() == {"runs": 3, "contracting": 3, "median_contraction": found.median}


def test_twins_that_diverge_have_no_figure_in_json() -> None:
    found = simulated_twins(
        load_scenario(PAPER, ["relay.uplink.model=burst", "relay.uplink.n=20", "controller.kx=250.0"]), [1, 2]
    )
    assert (found.contracting, found.median) == (0, math.inf)
    assert found.to_json()["median_contraction"] is None


def test_runs_that_met_different_losses_are_no_twins() -> None:
    lossy = ("relay.uplink.model=bernoulli", "relay.uplink.p=0.5", "plant.duration=1.0")
    run, twin, other = (simulate(scenario(*lossy, setting)) for setting in ("relay.seed=1", MOVED, "relay.seed=2"))
    assert distances(run, twin)[0] == pytest.approx(0.001 * math.sqrt(3.0))
    with pytest.raises(UserError, match="differ in lost"):
        distances(run, other)


# K_x = 25: bursts of 14 contract by 7/8, of 16 grow by 9/8. Independent losses: below 0.88 the mean square dies out,
# above 0.96 almost every run grows. Between these two, and under bursts of a given loss rate, it takes many runs to see
# the mean square grow, since almost each contracts: that is judged by simulation alone. A predictor whose model lacks a
# factor of 2.1 survives bursts of 15 and not of 40.
BORDERS = [
    (("relay.uplink.model=burst", "relay.uplink.n=14"), True),
    (("relay.uplink.model=burst", "relay.uplink.n=16"), False),
    (("relay.uplink.model=bernoulli", "relay.uplink.p=0.8"), True),
    (("relay.uplink.model=bernoulli", "relay.uplink.p=0.98"), False),
    (("relay.uplink.model=gilbert_elliott", "relay.uplink.p=0.5", "relay.uplink.r=0.2"), True),
    (("relay.uplink.model=gilbert_elliott", "relay.uplink.p=0.9", "relay.uplink.r=0.02"), False),
    (
        ("relay.uplink.model=burst", "relay.uplink.n=15", "error_detector.policy=predict", "plant.speed_scale=2.1"),
        True,
    ),
    (
        ("relay.uplink.model=burst", "relay.uplink.n=40", "error_detector.policy=predict", "plant.speed_scale=2.1"),
        False,
    ),
]


@pytest.mark.parametrize(("settings", "contracts"), BORDERS)
def test_simulated_twins_on_both_sides_of_each_border(settings: tuple[str, ...], contracts: bool) -> None:
    found = simulated_twins(scenario(*settings, "plant.duration=20.0"), range(1, 21))
    assert found.contracting == (20 if contracts else 0)


@pytest.mark.no_cover
@pytest.mark.parametrize(("settings", "contracts"), BORDERS)
def test_recorded_twins_on_both_sides_of_each_border(
    drive: Drive, tmp_path: Path, settings: tuple[str, ...], contracts: bool
) -> None:
    run = drive(*LINE, *settings, "plant.duration=10.0", bag=tmp_path / "run")
    twin = drive(*LINE, *settings, "plant.duration=10.0", MOVED, bag=tmp_path / "twin")
    apart = distances(run, twin)
    late = apart[-len(apart) // 4 :].max()
    assert late < 0.5 * apart[0] if contracts else late > 2.0 * apart[0]


# -- what the other criteria do not know -------------------------------------------------------------------------------


def test_what_is_left_out_of_the_margins() -> None:
    assert left_out(scenario()) == ()
    assert left_out(scenario("plant.speed_scale=1.1", "plant.duration=3.0", "error_detector.policy=predict")) == ()
    assert left_out(scenario("plant.lag=0.1")) == ()  # a state of the loop
    assert margins(scenario("plant.noise_xy=0.01")).to_json()["left_out"] == ["plant.noise_xy is 0.01"]
