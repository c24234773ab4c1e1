"""The border by simulated twins, against runs counted one loss probability at a time."""

from __future__ import annotations

import math
from pathlib import Path

from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.stability.twins_border import twins_border

PAPER = str(Path(__file__).parents[3] / "config/paper.yaml")


def scenario(*settings: str) -> Scenario:
    return load_scenario(PAPER, ["plant.duration=100.0", *settings])


def contracts(p: float, seed: int) -> bool:
    """Do two runs that begin a micrometre apart end closer?"""
    settings = ["relay.uplink.model=bernoulli", f"relay.uplink.p={p}", f"relay.seed={seed}"]
    one, other = (
        simulate(scenario(*settings, f"plant.initial_pose=[0.0, {5.0 + offset}, {math.pi / 2}]"))
        for offset in (0.0, 1e-6)
    )
    return len(one) == len(other) == 20_000 and math.dist(one.pose[-1], other.pose[-1]) < 1e-6


def test_the_paper_s_loop_below_its_linear_border() -> None:
    """K_x = 25: 45 of 60 laps contract at p = .93, 10 at .94, none at .95; the linear border is .957."""
    done: list[int] = []
    found = twins_border(scenario(), progress=done.append)
    assert found.value is not None
    assert 0.92 < found.value < 0.945
    assert done == list(range(1, len(done) + 1))
    assert sum(contracts(found.value - 0.03, seed) for seed in range(1, 6)) >= 3
    assert sum(contracts(found.value + 0.03, seed) for seed in range(1, 6)) <= 2


def test_a_loop_that_never_contracts_and_one_that_always_does() -> None:
    never = twins_border(scenario("controller.kx=401.0"), 3)
    assert never.value is None
    assert "even without losses" in never.reason
    always = twins_border(scenario("error_detector.policy=predict"), 3)
    assert always.value is None
    assert "no bound" in always.reason
