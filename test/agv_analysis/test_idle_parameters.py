"""What is called idle changes no run, to the last bit, and what is not called so changes one."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.compiled import functions as compiled
from agv_analysis.idle_parameters import idle_parameters
from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.simulation import parts
from agv_analysis.simulation.single import simulate

REPOSITORY = Path(__file__).parents[2]

SETTINGS = {
    "paper": ["relay.uplink.model=perfect"],
    "bernoulli": ["relay.uplink.model=bernoulli", "relay.uplink.p=0.3"],
    "outages": ["relay.uplink.model=gilbert_elliott", "relay.uplink.p=0.05", "relay.uplink.r=0.2"],
    "burst": ["relay.uplink.model=burst", "relay.uplink.n=3"],
    "late": ["relay.uplink.delay=0.03"],
    "predicted": [
        "relay.uplink.delay=0.03",
        "error_detector.policy=predict",
        "relay.uplink.lifetime=0.04",
        "plant.speed_scale=0.9",
    ],
    "jitter": ["relay.uplink.delay=0.03", "relay.uplink.jitter=0.02", "error_detector.policy=align"],
    "bicycle": ["plant.vehicle=bicycle", "error_detector.track=circle", "plant.slip_noise=0.1"],
    "other law": ["controller.law=state_feedback", "relay.uplink.model=bernoulli", "relay.uplink.p=0.3"],
    "reliable": ["relay.uplink.model=bernoulli", "relay.uplink.p=0.3", "relay.uplink.reliable=true"],
}

CHANGES = [
    "relay.uplink.p=0.45", "relay.uplink.r=0.1", "relay.uplink.h=0.4", "relay.uplink.k=0.9", "relay.uplink.n=5",
    "relay.uplink.start_step=40", "relay.uplink.lifetime=0.008", "relay.uplink.resend_after=0.03", "relay.seed=7",
    "relay.uplink.trace_window=1.0", "relay.uplink.margin=3.0", "relay.uplink.history=1",
    "plant.bicycle.wheelbase=0.6", "plant.track_width=0.9", "plant.ramp_time=0.05", "plant.seed=9",
    "error_detector.speed=0.7", "error_detector.corner=0.5", "error_detector.integration=arc",
    "error_detector.policy=hold", "controller.kx=12.0", "controller.state_feedback.kx=1.0",
    "controller.pure_pursuit.kx=1.0",
]  # fmt: skip


@functools.cache
def short(*settings: str) -> Scenario:
    paper = load_scenario(str(REPOSITORY / "config/paper.yaml"))
    return paper.with_settings(["plant.duration=1.0", *settings], "test")


def driven(scenario: Scenario) -> bytes:
    run = simulate(scenario)
    return np.ascontiguousarray(run.pose).tobytes() + np.ascontiguousarray(run.command).tobytes()


@pytest.fixture
def _as_plain_python(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """To compile a loop for each choice of parts takes longer than to drive it here."""
    for module in (compiled, parts):
        monkeypatch.setattr(module, "HAS_NUMBA", False)
    compiled._compiled.cache_clear()
    yield
    compiled._compiled.cache_clear()


@pytest.mark.usefixtures("_as_plain_python")
@pytest.mark.parametrize("name", SETTINGS)
def test_idle_is_what_changes_no_run(name: str) -> None:
    scenario = short(*SETTINGS[name])
    before, idle = driven(scenario), idle_parameters(scenario)
    wrong = {}
    for change in CHANGES:
        parameter = change.partition("=")[0]
        changed = scenario.with_settings([change], "test")
        if changed != scenario and (driven(changed) == before) is not (parameter in idle):
            wrong[change] = idle.get(parameter, "has an effect")
    assert wrong == {}
