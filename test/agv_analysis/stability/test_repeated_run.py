"""What the nonlinear loop does under the losses of a run, again and again, against a loop in plain Python."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.run import Run
from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.stability.analysis import analyse
from agv_analysis.stability.repeated_run import RepeatedRun, repeated_run, settles_without_losses
from agv_analysis.stability.scenario_loop import loop_of_run

PAPER, LINE = str(Path(__file__).parents[3] / "config/paper.yaml"), "error_detector.track=line"
CYCLE = (
    LINE, "plant.speed_scale=1.3", "controller.kx=1.0", "controller.ky=64.0", "controller.ktheta=16.0",
    "error_detector.speed=2.0",
)  # fmt: skip
"""THEORY: with a true speed of 1.3 times the commanded one the heading gain is negative: it swings forever."""

TURNED = (
    LINE, "controller.ky=64.0", "controller.ktheta=16.0", "relay.uplink.model=burst", "relay.uplink.n=30",
    "plant.initial_pose=[0.0, 0.3, 1.5707963]",
)  # fmt: skip
"""The AGV turns around between two poses, and drives away at its largest speed."""


def scenario_of(*settings: str) -> Scenario:
    return load_scenario(PAPER, ("plant.duration=20.0", *settings))


def repeated(*settings: str) -> tuple[Run, RepeatedRun]:
    run = simulate(scenario_of(*settings))
    found = repeated_run(run, loop_of_run(run))
    assert found is not None
    return run, found


def deviations(scenario: Scenario, lost: list[bool], seconds: float) -> np.ndarray:
    """Kanayama's law on a line along y at the scenario's speed, written anew: distance from the reference [m]."""
    gains, plant, ts = scenario.controller, scenario.plant, scenario.plant.ts
    v_r = scenario.error_detector.speed
    x, y, theta = plant.initial_pose
    held, found = (x, y, theta), []
    for k in range(round(seconds / ts)):
        y_r = k * ts * v_r
        if not lost[k % len(lost)]:
            held = (x, y, theta)
        dx, dy, th = -held[0], y_r - held[1], held[2]
        x_e, y_e = math.cos(th) * dx + math.sin(th) * dy, -math.sin(th) * dx + math.cos(th) * dy
        theta_e = math.pi / 2.0 - th
        v = v_r * math.cos(theta_e) + gains.kx * x_e
        v = plant.speed_scale * max(-gains.v_max, min(gains.v_max, v))
        w = v_r * (gains.ky * y_e + gains.ktheta * math.sin(theta_e))
        found.append(math.hypot(x, y_r - y))
        x, y, theta = x + ts * v * math.cos(theta), y + ts * v * math.sin(theta), theta + ts * w
    return np.array(found)


def test_a_loop_that_settles_under_its_losses() -> None:
    run, found = repeated(LINE, "relay.uplink.model=gilbert_elliott", "relay.uplink.p=0.02", "relay.uplink.r=0.2")
    assert found.is_stable
    assert found.seconds == pytest.approx(600.0)
    expected = deviations(run.scenario, run.lost.tolist(), 600.0)
    last, first = len(expected) - len(run), slice(len(run) // 2, len(run))
    assert found.largest_deviation == pytest.approx(expected[last:].max(), rel=1e-6)
    assert found.largest_in_run == pytest.approx(expected[first].max(), rel=1e-6)


def test_a_swing_without_losses_is_no_settling() -> None:
    run, found = repeated(*CYCLE)
    swing = deviations(run.scenario, [False], 60.0)[-4000:]
    assert np.ptp(swing) > 0.01
    assert not found.settles
    assert not found.meets
    assert not settles_without_losses(run.scenario)


@pytest.mark.parametrize("v_max", [1.02, 1.3])
def test_a_limit_on_the_speed_does_not_keep_an_agv_that_turns_around(v_max: float) -> None:
    run, found = repeated(*TURNED, f"controller.v_max={v_max}")
    drift = deviations(run.scenario, run.lost.tolist(), 400.0)
    assert drift[-1] > 1.8 * drift[len(drift) // 2] > 300.0
    assert not found.stays


@pytest.mark.parametrize("v_max", [1.05, 6.0])
def test_an_agv_that_stays_by_symmetry_alone_is_not_bounded(v_max: float) -> None:
    """Exactly on its line, ahead of its reference, it never turns; 1 mm beside, the same loop drives away for ever."""
    on_line = (*TURNED, f"plant.initial_pose=[0.0, 5.0, {math.pi / 2}]", f"controller.v_max={v_max}")
    run, found = repeated(*on_line)
    assert np.hypot(*(run.pose - run.reference[:, :3])[-2000:, :2].T).max() < 1.0
    beside = dataclasses.replace(run.scenario.plant, initial_pose=(1e-3, 5.001, math.pi / 2 + 1e-3))
    drift = deviations(dataclasses.replace(run.scenario, plant=beside), run.lost.tolist(), 400.0)
    assert drift[-1] > 1.8 * drift[len(drift) // 2] > 300.0
    assert not found.stays
    assert analyse(run).verdict.word == "unstable"


def test_a_loop_that_falls_behind_does_not_settle() -> None:
    behind = scenario_of(LINE, "controller.v_max=0.8")
    drift = deviations(behind, [False], 100.0)
    assert drift[-1] == pytest.approx(0.2 * (100.0 - 2.0) - 0.0, abs=2.0)
    assert not settles_without_losses(behind)
    assert settles_without_losses(dataclasses.replace(behind, controller=scenario_of(LINE).controller))


def test_messages_that_are_late_by_always_the_same_are_driven_so() -> None:
    """A pose 12 steps old contracts, 13 steps old it does not (K_x = 25)."""
    assert repeated(LINE, "relay.uplink.delay=0.06")[1].is_stable
    assert not repeated(LINE, "relay.uplink.delay=0.065")[1].meets


def test_a_run_with_missing_steps_cannot_be_repeated() -> None:
    run = simulate(scenario_of(LINE))
    rest = run.part(slice(1000, None))
    whole = dataclasses.replace(rest, k=np.concatenate((run.k[1000:2000], run.k[2000:] + 5)))
    assert repeated_run(whole, loop_of_run(whole)) is None
    assert repeated_run(rest, loop_of_run(rest)) is not None
