"""The multiplier of a run with late poses: against the lifted system, a sawtooth's, and twins of the loop itself."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.stability.analysis import analyse
from agv_analysis.stability.floquet import drop_sequence
from agv_analysis.stability.kanayama_delay import spectral_radius
from agv_analysis.stability.linear_loop import kanayama_loop
from agv_analysis.stability.variable_delay import age_sequence
from agv_cloud.parameters import ControllerParameters
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import losses

TS, STEPS = 0.005, 4000
GAINS = ControllerParameters(kx=25.0, ky=1.0, ktheta=2.0)


@pytest.mark.parametrize("n", [0, 1, 5, 12, 13, 20])
def test_a_constant_age_grows_as_the_lifted_system(n: int) -> None:
    v, w = np.full(20_000, 1.2), np.full(20_000, 0.1)
    found = age_sequence(kanayama_loop(v, w, GAINS, TS), np.minimum(n, np.arange(20_000))) / 20_000
    # The beginning of a run, where no pose is older than the first, is n steps of 20 000.
    assert found == pytest.approx(math.log(spectral_radius(n, 1.2, 0.1, GAINS, TS)), abs=2e-5)


def test_a_sawtooth_is_the_sequence_of_its_drops() -> None:
    lost = losses(ChannelParameters(model="gilbert_elliott", p=0.05, r=0.2), 3, "uplink", STEPS)
    k = np.arange(STEPS)
    age = k - np.maximum.accumulate(np.where(lost, 0, k))
    v, w = 1.0 - 0.5 * np.cos(8.0 * np.pi * k / STEPS), 0.2 * (1.0 - np.cos(4.0 * np.pi * k / STEPS))
    loop = kanayama_loop(v, w, GAINS, TS)
    # Driven again and again, both begin with a fresh pose.
    assert age_sequence(loop, age) == pytest.approx(drop_sequence(loop, lost)[0], rel=1e-9)


@pytest.mark.parametrize(("jitter", "kx"), [(0.02, 5.0), (0.04, 5.0), (0.04, 25.0)])
def test_it_is_the_growth_between_twins_on_a_straight_track(jitter: float, kx: float) -> None:
    """A straight track at a constant speed and small errors: the loop is its linearisation, its twin an error."""
    scenario = load_scenario("config/paper.yaml", [
        "error_detector.track=line", f"relay.uplink.jitter={jitter}", f"relay.uplink.delay={jitter}",
        "relay.uplink.model=bernoulli", "relay.uplink.p=0.2", f"controller.kx={kx}", "controller.ky=0.0",
        "controller.ktheta=0.0", "error_detector.policy=align", "plant.duration=8.0",
    ])  # fmt: skip
    ends = []
    for y in (0.0, 1e-3):
        plant = dataclasses.replace(scenario.plant, initial_pose=(0.0, y, math.pi / 2.0))
        ends.append(simulate(dataclasses.replace(scenario, plant=plant)))
    one, twin = ends
    steps = len(one) - 1
    assert (one.n_ul > np.where(one.lost, one.n_ul, 0)).any()
    v, w = one.reference[:steps, 3], one.reference[:steps, 4]
    loop = kanayama_loop(v, w, scenario.controller, TS)
    apart = abs(twin.pose[-1, 1] - one.pose[-1, 1]) / 1e-3
    # Across the track and in its heading nothing moves without gains: 1 and 1; along it is the twins' distance.
    expected = max(0.0, math.log(apart))
    assert age_sequence(loop, one.n_ul[:steps]) == pytest.approx(expected, abs=1e-6)


def test_a_run_with_jitter_has_its_multiplier_and_the_word_of_its_ages() -> None:
    settings = ["relay.uplink.delay=0.02", "relay.uplink.jitter=0.01", "plant.duration=20.0"]
    found = analyse(simulate(load_scenario("config/paper.yaml", settings)))
    assert found.floquet is not None
    assert 0.9 < found.floquet < 1.0
    assert (found.contraction, found.verdict.word, found.verdict.criterion) == (None, "mean-square", "late_and_lost")
    both = analyse(simulate(load_scenario("config/paper.yaml", [*settings, "relay.downlink.delay=0.01"])))
    assert both.floquet is not None
    assert found.floquet < both.floquet < 1.0  # two slots more
    assert (both.verdict.word, both.verdict.criterion) == ("mean-square", "late_and_lost")
