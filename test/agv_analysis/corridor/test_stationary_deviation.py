"""RMS deviation by second moments, against the mean of simulated laps and a closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agv_analysis.corridor.lap_loop import LapLoop
from agv_analysis.corridor.leaving import leaving
from agv_analysis.corridor.stationary_deviation import StationaryDeviation, stationary_deviation
from agv_analysis.corridor.widths import Widths
from agv_analysis.link.markov_channel import chain_of
from agv_analysis.scenario import Scenario
from agv_analysis.stability.scenario_loop import loop_on_lap
from test.agv_analysis.corridor.test_single_outage import scenario

BERNOULLI = ["relay.uplink.model=bernoulli", "relay.uplink.p=0.5"]


def loop_of(chosen: Scenario) -> LapLoop:
    return LapLoop(chosen, Widths(1e3, math.inf, math.inf))


def of(chosen: Scenario) -> StationaryDeviation:
    chain = chain_of(chosen.relay.uplink)
    assert chain is not None
    return stationary_deviation(loop_of(chosen), loop_on_lap(chosen), chain)


@pytest.mark.parametrize(
    "settings",
    [
        [*BERNOULLI, "plant.noise_xy=0.01", "plant.noise_theta=0.01"],
        ["relay.uplink.p=0.1", "relay.uplink.r=0.4", "error_detector.track=line"],
        [*BERNOULLI, "error_detector.policy=predict", "plant.speed_scale=1.1", "error_detector.track=eight"],
    ],
    ids=["noise", "bursts", "predict"],
)
def test_it_is_that_of_simulated_laps(settings: list[str]) -> None:
    chosen = scenario(*settings, "error_detector.lap_time=40.0")
    simulated = leaving(loop_of(chosen), None, laps=40)
    assert of(chosen).rms == pytest.approx(simulated.rms, rel=0.05)


def test_on_a_line_one_lost_pose_in_two_has_a_closed_form() -> None:
    """A slot is received with q: h = x, or lost with p: h = h + c; then x = x - a h. In the long run E[h] = 0, and

    E[x] = -p c / q,   E[x h] = a E[h^2] / 2,   E[h^2] = E[x^2] + p c^2 / q,
    q E[x h] + p a E[h^2] = q E[x^2] + p c E[x].
    """
    a, c, p, q = 0.125, 0.005, 0.5, 0.5
    share = a * (q / 2.0 + p)
    square = (-p * c * p * c / q - share * p * c**2 / q) / (share - q)
    found = of(scenario(*BERNOULLI, "error_detector.track=line"))
    assert found.rms_along**2 == pytest.approx(square, rel=1e-6)
    assert found.rms_across < 1e-9


@pytest.mark.parametrize(("p", "r"), [(0.02, 0.2), (0.02, 0.05)])
def test_on_a_line_it_is_that_of_a_renewal_process(p: float, r: float) -> None:
    """Also near the border, where simulated laps hardly show the rare outages that make most of the mean square.

    From one reception to the next, L slots later, x -> (1 - a L) x - a c L (L - 1) / 2; the L are independent.
    """
    a, c, longest = 0.125, 0.005, 5000
    L, i = np.arange(1, longest), np.arange(longest - 1)
    chance = np.where(L == 1, 1.0 - p, p * r * (1.0 - r) ** np.maximum(L - 2, 0))
    m, b, m_i, b_i = 1.0 - a * L, -a * c * L * (L - 1) / 2, 1.0 - a * i, -a * c * i * (i - 1) / 2
    mean = chance @ b / (1.0 - chance @ m)
    square = (chance @ b**2 + 2.0 * (chance @ (m * b)) * mean) / (1.0 - chance @ m**2)
    sums = np.cumsum(m_i**2) * square + 2.0 * np.cumsum(m_i * b_i) * mean + np.cumsum(b_i**2)
    found = of(scenario(f"relay.uplink.p={p}", f"relay.uplink.r={r}", "error_detector.track=line"))
    assert found.rms_along == pytest.approx(math.sqrt(chance @ sums / (chance @ L)), rel=1e-5)


def test_without_losses_and_noise_there_is_none_and_beyond_the_border_no_end() -> None:
    assert of(scenario("relay.uplink.p=0.0")).rms < 1e-9
    assert math.isinf(of(scenario("relay.uplink.model=bernoulli", "relay.uplink.p=0.95")).rms)
