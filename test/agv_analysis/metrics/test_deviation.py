"""How far a run strays: against the closed form of one outage, and against counting by hand."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.metrics.convergence import convergence
from agv_analysis.metrics.deviation import SMALLEST, deviation
from agv_analysis.metrics.order_statistics import not_exceeded
from agv_analysis.run import Run
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate, simulate_batch

CONFIG = Path(__file__).parents[3] / "config"
TS, KX = 0.005, 25.0


def run_of(*settings: str, config: str = "paper") -> Run:
    return simulate(load_scenario(str(CONFIG / f"{config}.yaml"), settings))


def line_with_outages(*outages: tuple[float, int]) -> Run:
    """A line at 1 m/s, from the reference on, with outages of so many slots that begin at these times [s]."""
    schedule = "; ".join(f"{at:g}: outage={slots * TS:g}" for at, slots in outages)
    return run_of(
        "error_detector.track=line", "plant.initial_pose=[0.0, 0.0, 1.5707963267948966]", "plant.duration=30.0",
        f"controller.kx={KX}", f"relay.uplink.schedule={schedule}",
    )  # fmt: skip


@pytest.mark.parametrize("slots", [5, 14, 28, 60])
def test_one_outage_on_a_line(slots: int) -> None:
    run = line_with_outages((20.0, slots))
    found = deviation(run, convergence(run).initial)
    farthest = TS * KX * TS * slots * (slots + 1) / 2
    assert found.largest == pytest.approx(farthest, rel=1e-9)
    peak = found.worst[0]
    assert peak.distance == pytest.approx(farthest, rel=1e-9)
    assert peak.seconds == pytest.approx(20.0 + slots * TS)
    assert (peak.along, peak.across) == pytest.approx((farthest, 0.0), abs=1e-9)
    assert peak.from_lossless == pytest.approx(farthest, rel=1e-9)
    assert peak.outage is not None
    assert (peak.outage.link, peak.outage.slots, peak.outage.k) == ("uplink", slots, 4000)
    assert peak.outage.cause == "outage"
    # It speeds up during the outage, and goes back after it.
    assert found.speed == pytest.approx(max(1.0 + KX * TS * slots, KX * farthest - 1.0), rel=1e-9)


def test_peaks_are_told_apart_and_ranked() -> None:
    run = line_with_outages((5.0, 10), (12.0, 30), (20.0, 20))
    worst = deviation(run, convergence(run).initial).worst
    assert [peak.outage.slots for peak in worst if peak.outage is not None] == [30, 20, 10]
    assert [peak.seconds for peak in worst] == pytest.approx([12.15, 20.1, 5.05])


def test_figures_of_a_lap_by_counting() -> None:
    run = run_of(config="outages")
    found = deviation(run, convergence(run).initial)
    e = [math.dist(a, b) for a, b in zip(run.pose[:, :2].tolist(), run.reference[:, :2].tolist(), strict=True)]
    seen = sorted(e[47:])  # the initial error of 5 m has settled to 1 cm at step 47
    assert found.since_seconds == pytest.approx(47 * TS)
    assert found.largest == seen[-1] == found.worst[0].distance
    assert found.p99 == seen[math.ceil(0.99 * len(seen)) - 1]
    assert found.rms == pytest.approx(math.sqrt(math.fsum(d * d for d in seen) / len(seen)), rel=1e-12)
    assert found.speed == np.abs(run.command[:, 0]).max() == 124.5
    assert found.worst[0].outage is not None
    assert found.worst[0].outage.slots == 28
    row = simulate_batch([run.scenario], [run.scenario.relay.seed])[0, 0]
    assert float(row["deviation_max"]) == pytest.approx(found.largest, rel=1e-9)
    assert float(row["deviation_p99"]) == pytest.approx(found.p99, rel=1e-9)
    assert float(row["deviation_rms"]) == pytest.approx(found.rms, rel=1e-9)
    assert float(row["speed_max"]) == pytest.approx(found.speed, rel=1e-9)


def test_a_delayed_run_in_a_batch_has_the_same_figures() -> None:
    run = run_of("relay.uplink.delay=0.02", "plant.duration=20.0", config="outages")
    found = deviation(run, convergence(run).initial)
    row = simulate_batch([run.scenario], [run.scenario.relay.seed])[0, 0]
    assert float(row["deviation_max"]) == found.largest
    assert float(row["deviation_p99"]) == pytest.approx(found.p99, rel=1e-12)
    assert float(row["deviation_rms"]) == pytest.approx(found.rms, rel=1e-12)


@pytest.mark.parametrize(
    "values", [[0.0] * 5, [3.0], [1.0] * 99 + [2.0], [1.0] * 98 + [2.0, 3.0], [0.0] * 999 + [1.0], [*range(1000)]]
)
def test_what_a_share_does_not_exceed_is_counted(values: list[float]) -> None:
    shuffled = np.random.default_rng(1).permutation(np.array(values, dtype=np.float64))
    assert not_exceeded(shuffled, 0.99) == sorted(values)[math.ceil(0.99 * len(values)) - 1]
    assert not_exceeded(np.array([1.0, math.nan]), 0.99) == math.inf


def test_without_losses_there_is_nothing_to_list() -> None:
    run = line_with_outages()
    found = deviation(run, convergence(run).initial)
    assert found.largest < SMALLEST
    assert found.worst == ()
    assert found.reason == ""


def test_a_loop_that_diverges_has_no_peaks() -> None:
    run = run_of("controller.kx=250.0", "relay.uplink.model=burst", "relay.uplink.n=10")
    found = deviation(run, convergence(run).initial)
    assert found.is_diverged
    assert found.to_json()["deviation"]["diverged"] is True
    assert found.worst == ()


def test_what_has_not_settled_is_counted_from_the_start_and_says_so() -> None:
    run = run_of("controller.kx=0.001", "plant.duration=10.0")
    found = deviation(run, convergence(run).initial)
    assert found.largest == pytest.approx(5.0, rel=0.1)
    assert (found.since_seconds, bool(found.reason)) == (0.0, True)


def test_a_recording_without_a_twin_counts_from_its_first_centimetre() -> None:
    run = run_of(config="outages")
    moved = dataclasses.replace(run, pose=run.pose + np.array([0.0, 1e-4, 0.0]))  # no longer what the simulation gives
    found = deviation(moved, convergence(moved).initial)
    assert "not known" in found.reason or found.reason == ""
    assert found.worst[0].from_lossless is None
    assert found.largest == pytest.approx(0.37245, abs=2e-4)
