"""The longest single outage in a corridor, against closed forms and against runs of the whole simulation."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.corridor.corridor import corridor
from agv_analysis.corridor.lap_loop import LapLoop, outage
from agv_analysis.corridor.shares import path_deviation
from agv_analysis.corridor.single_outage import single_outage
from agv_analysis.corridor.widths import Widths
from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.simulation import simulate

REPOSITORY = Path(__file__).parents[3]
A, TS = 0.125, 0.005  # K_x = 25


def scenario(*settings: str, lap: float = 10.0) -> Scenario:
    short = f"error_detector.lap_time={lap}"
    return load_scenario(str(REPOSITORY / "config/outages.yaml"), [short, *settings])


def loop(half_width: float, *settings: str) -> LapLoop:
    return LapLoop(scenario(*settings), Widths(half_width, math.inf, math.inf))


def on_a_line(n: int, speed: float = 1.0) -> float:
    """Deviation along a straight track after one outage under `hold`: a v T_s n (n + 1) / 2."""
    return A * speed * TS * n * (n + 1) / 2


@pytest.mark.parametrize("n", [5, 14, 28, 60])
def test_one_outage_on_a_line_has_a_closed_form(n: int) -> None:
    found, _ = loop(1.0, "error_detector.track=line").excursions(outage(n), every=50)
    assert found.along == pytest.approx(on_a_line(n), abs=1e-9)
    assert found.across == pytest.approx(0.0, abs=1e-9)
    assert set(found.after.tolist()) == {n + 1}


@pytest.mark.parametrize(("half_width", "speed"), [(0.25, 1.0), (0.07, 2.3), (1.3, 0.4)])
def test_the_longest_on_a_line_is_that_of_the_closed_form(half_width: float, speed: float) -> None:
    found = single_outage(loop(half_width, "error_detector.track=line", f"error_detector.speed={speed}"))
    expected = next(n for n in range(1000) if on_a_line(n + 1, speed) > half_width)
    assert found.n == expected
    assert found.deviation == pytest.approx(on_a_line(expected, speed), abs=1e-9)


def test_it_is_that_of_whole_runs_with_one_outage_each() -> None:
    """On the paper's track the worst place is where it is fastest; each step of its lap is one run."""
    chosen = scenario()
    found = single_outage(LapLoop(chosen, Widths(0.25, math.inf, math.inf)))
    assert found.n is not None
    plant = dataclasses.replace(chosen.plant, initial_pose=chosen.error_detector.track_start, duration=20.0)

    def farthest(n: int, step: int) -> float:
        channel = dataclasses.replace(chosen.relay.uplink, model="burst", n=n, start_step=step + 1)
        relay = dataclasses.replace(chosen.relay, uplink=channel)
        run = simulate(dataclasses.replace(chosen, plant=plant, relay=relay))
        return float(np.hypot(*path_deviation(run.pose, run.reference)).max())

    places = {*range(0, 2000, 100), found.step}
    assert max(farthest(found.n, step) for step in places) <= found.deviation <= 0.25
    assert farthest(found.n + 1, found.step) > 0.25


def test_policies_without_bias_survive_any_single_outage() -> None:
    for policy in ("align", "predict"):
        found = single_outage(loop(0.01, f"error_detector.policy={policy}"))
        assert found.n is None
        assert found.deviation < 1e-9


def test_a_corridor_may_be_longer_than_it_is_wide() -> None:
    """On a straight track an outage moves the AGV along it alone."""
    chosen = ["error_detector.track=line", "error_detector.corridor=0.001", "error_detector.corridor_along=0.25"]
    found = corridor(scenario(*chosen), laps=2)
    assert found is not None
    assert found.n_single == 27  # a v T_s n (n + 1) / 2 <= 0.25
    assert corridor(scenario("error_detector.track=line"), laps=2) is None


def test_a_loop_that_is_outside_without_any_outage_says_so() -> None:
    found = corridor(scenario("plant.speed_scale=0.5", "error_detector.corridor=0.02"), laps=2)
    assert found is not None
    assert (found.n_single, found.n_any) == (-1, -1)
    assert "without any outage" in found.notes[0]
    assert found.leaving.p_lap.value == 1.0
