"""How often the corridor is left, against theory and against laps that are simulated one by one."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.corridor.corridor import corridor
from agv_analysis.corridor.lap_loop import LapLoop
from agv_analysis.corridor.leaving import Leaving, is_random, leaving
from agv_analysis.corridor.rare_leaving import leaving_rate
from agv_analysis.corridor.shares import path_deviation
from agv_analysis.corridor.single_outage import single_outage
from agv_analysis.corridor.widths import Widths
from agv_analysis.link.markov_channel import gilbert_elliott
from agv_analysis.simulation import simulate
from test.agv_analysis.corridor.test_single_outage import scenario


def of(half_width: float, *settings: str, laps: int = 100) -> Leaving:
    loop = LapLoop(scenario(*settings), Widths(half_width, math.inf, math.inf))
    return leaving(loop, single_outage(loop), laps)


def test_laps_are_those_of_the_simulation() -> None:
    chosen = scenario("plant.noise_xy=0.01", "relay.downlink.model=bernoulli", "relay.downlink.p=0.1")
    plant = dataclasses.replace(chosen.plant, initial_pose=chosen.error_detector.track_start, duration=10.0)
    farthest = []
    for seed in range(1, 9):
        run = simulate(
            dataclasses.replace(
                chosen, plant=dataclasses.replace(plant, seed=seed), relay=dataclasses.replace(chosen.relay, seed=seed)
            )
        )
        farthest.append(np.hypot(*path_deviation(run.pose, run.reference)).max())
    loop = LapLoop(chosen, Widths(0.2, math.inf, math.inf))
    np.testing.assert_allclose(leaving(loop, None, laps=8).largest * 0.2, farthest, rtol=1e-6)


def test_splitting_gives_what_simulated_laps_give() -> None:
    """On a line the shortest outage that leaves 0.25 m has 28 slots; the rate of such outages is known."""
    loop = LapLoop(scenario("error_detector.track=line"), Widths(0.25, math.inf, math.inf))
    rate = leaving_rate(loop, gilbert_elliott(0.02, 0.2), 27, seed=1).per_slot
    assert rate.high < 1.5 * rate.low
    of_long_outages = 0.02 * 0.2 / 0.22 * 0.8**27  # others end in the wake of one that was nearly long enough
    assert 0.75 * of_long_outages < rate.value < 1.1 * of_long_outages
    laps = of(0.25, "error_detector.track=line", laps=400)
    p = -math.expm1(-rate.value * 2000)
    assert laps.p_lap.low <= p <= laps.p_lap.high


def test_rare_events_are_asked_of_splitting() -> None:
    found = of(0.6, "error_detector.track=line")
    assert "splitting" in found.method
    assert found.p_lap.value == pytest.approx(0.02 * 0.2 / 0.22 * 0.8**43 * 2000, rel=0.3)
    assert found.p_lap.low < found.p_lap.value < found.p_lap.high
    assert found.p_hour.value == pytest.approx(1.0 - (1.0 - found.p_lap.value) ** 360, rel=1e-6)
    assert found.mean_time is not None
    assert found.mean_time.value == pytest.approx(10.0 / found.p_lap.value, rel=0.01)


def test_the_mean_time_is_known_as_well_as_the_departures_are_many() -> None:
    """Also where nearly each lap leaves, so that how many do hardly says how soon."""
    laps = 60
    found = of(0.05, "error_detector.track=line", laps=laps)
    mean, left = found.mean_time, found.p_lap.value * laps
    assert mean is not None
    assert 0.8 < found.p_lap.value < 1.0
    assert mean.value == pytest.approx(-10.0 / math.log1p(-found.p_lap.value), rel=0.25)
    for end, sign in ((mean.high, 1.0), (mean.low, -1.0)):  # of a sum of so many exponential times, roughly
        assert end / mean.value == pytest.approx(math.exp(sign * 1.96 / math.sqrt(left)), rel=0.03)


def test_what_is_not_random_is_asked_of_one_lap() -> None:
    perfect = of(0.25, "relay.uplink.model=perfect")
    assert (perfect.p_lap.high, perfect.p_hour.high, perfect.mean_time) == (0.0, 0.0, None)
    never = of(0.25, "relay.uplink.model=bernoulli", "relay.uplink.p=1.0", "error_detector.track=line")
    assert (never.p_lap.low, never.p_hour.low) == (1.0, 1.0)
    assert never.mean_time is not None
    assert never.mean_time.value == pytest.approx(29 * 0.005)  # the 28th loss in a row leads outside
    delayed = of(0.02, "relay.uplink.model=perfect", "relay.uplink.delay=0.05", "error_detector.track=line")
    assert delayed.p_lap.low == 1.0  # v n T_s = 5 cm off forever


def test_laps_are_parts_of_a_long_measured_link(tmp_path: Path) -> None:
    """Of five laps' time of a measurement the fourth holds an outage of 30 slots, which leads outside."""
    trace = tmp_path / "link.csv"
    trace.write_text("time,lost\n" + "".join(f"{0.05 * i:.2f},{int(700 <= i < 703)}\n" for i in range(1001)))
    settings = ("error_detector.track=line", "relay.uplink.model=trace", f"relay.uplink.trace_file={trace}")
    found = of(0.25, *settings)
    assert found.method == "5 simulated laps, 1 of which left it"
    assert np.flatnonzero(found.largest > 1.0).tolist() == [3]


def test_a_channel_that_never_loses_leaves_nothing_to_chance() -> None:
    assert not is_random(scenario("relay.uplink.p=0.0"))
    assert is_random(scenario())


def test_a_parked_agv_stays_whatever_is_lost() -> None:
    parked = "error_detector.track=line", "error_detector.speed=1e-300", "error_detector.corridor=0.25"
    found = corridor(scenario(*parked), laps=2, proved=False)
    assert found is not None
    assert (found.n_single, found.n_any) == (None, None)
    assert found.leaving.p_lap.value == 0.0
