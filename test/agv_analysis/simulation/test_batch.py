"""Batches: the same numbers whatever the number of workers, and outcomes that are those of the relay."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.simulation import STATISTICS, simulate, simulate_batch
from agv_analysis.simulation.batch import _Batch
from agv_analysis.simulation.channel_outcomes import ChannelRealisation
from agv_analysis.simulation.lanes import VECTOR
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import losses
from agv_ros.errors import UserError

OUTAGES = str(Path(__file__).parents[3] / "config" / "outages.yaml")


ONE = [load_scenario(OUTAGES)]


def scenarios(*gains: float, duration: float = 2.0) -> list[Scenario]:
    return [load_scenario(OUTAGES, [f"controller.kx={kx}", f"plant.duration={duration}"]) for kx in gains]


@pytest.mark.parametrize(
    "channel",
    [
        ChannelParameters(),
        ChannelParameters(model="bernoulli", p=0.37),
        ChannelParameters(model="bernoulli", p=1.0),
        ChannelParameters(model="gilbert_elliott", p=0.02, r=0.2),
        ChannelParameters(model="gilbert_elliott", p=0.3, r=0.1, h=0.25, k=0.9),
        ChannelParameters(model="burst", n=14),
        ChannelParameters(model="burst", n=0),
        ChannelParameters(model="burst", n=9, start_step=4090),
    ],
    ids=lambda channel: f"{channel.model} {channel.p:g} {channel.n}",
)
def test_outcomes_are_those_of_the_relay(channel: ChannelParameters) -> None:
    for seed, stream in ((1, "uplink"), (2**62, "downlink")):
        expected = losses(channel, seed, stream, 9000)  # more than two of the relay's blocks
        assert np.array_equal(ChannelRealisation(seed, 9000).outcomes(channel, stream), expected)


def test_the_number_of_workers_changes_nothing() -> None:
    many = scenarios(5.0, 25.0, 60.0, 250.0, 390.0)
    alone = simulate_batch(many, range(5), workers=1)
    assert alone.shape == (5, 5)
    for workers in (2, 7):
        assert simulate_batch(many, range(5), workers=workers).tobytes() == alone.tobytes()


def test_seeds_are_columns_and_paired() -> None:
    table = simulate_batch(scenarios(25.0, 60.0), [3, 8])
    assert (table["n_ul_mean"][0] == table["n_ul_mean"][1]).all()  # the same outages for either gain
    assert table["n_ul_mean"][0, 0] != table["n_ul_mean"][0, 1]
    (scenario,) = scenarios(60.0)
    run = simulate(dataclasses.replace(scenario, relay=dataclasses.replace(scenario.relay, seed=8)))
    assert table["final"][1, 1] == pytest.approx(run.reference[-1, 1] - run.pose[-1, 1], rel=1e-9)


def test_scenarios_of_different_length_and_track_go_together() -> None:
    short, long = *scenarios(25.0, duration=1.0), *scenarios(25.0, duration=3.0)
    line = load_scenario(OUTAGES, ["error_detector.track=line", "plant.duration=1.0"])
    table = simulate_batch([short, line, long, short, line], [1, 2], workers=1)
    assert table["steps"].tolist() == [[200, 200], [200, 200], [600, 600], [200, 200], [200, 200]]
    assert table[0].tobytes() == table[3].tobytes()
    assert table[1].tobytes() == table[4].tobytes()
    assert table["final"][0, 0] != table["final"][1, 0]
    assert table[:1].tobytes() == simulate_batch([short], [1, 2]).tobytes()


def test_a_diverged_run_ends_early_and_has_not_settled() -> None:
    wild = ["plant.ts=10.0", "error_detector.lap_time=1000.0", "plant.duration=5000.0", "controller.kx=1.0"]
    row = simulate_batch([load_scenario(OUTAGES, [*wild, "relay.uplink.model=perfect"])], [1])[0, 0]
    assert row["steps"] < 500
    assert (row["settle_1cm_steps"], row["settle_2pct_steps"]) == (-1, -1)
    assert row["position_peak"] > 1e290


def test_without_an_initial_error_there_is_no_share_of_it() -> None:
    start = ["plant.initial_pose=[0.0, 0.0, 1.5707963267948966]", "relay.uplink.model=perfect"]
    row = simulate_batch([load_scenario(OUTAGES, start)], [1])[0, 0]
    assert (row["settle_1cm_steps"], row["settle_2pct_steps"], row["peak"]) == (-1, -1, 0.0)
    assert np.isnan(row["overshoot"])


LINE = (
    "error_detector.track=line", "relay.uplink.model=perfect", "plant.initial_pose=[0.0, 0.0, 1.5707963267948966]",
    "plant.duration=10.0",
)  # fmt: skip


@pytest.mark.parametrize("kx", [1.0, 25.0, 300.0])
def test_twins_on_a_line_come_together_as_the_poles_of_the_loop_say(kx: float) -> None:
    # On a line at 1 m/s every step multiplies the error along it by 1 - T_s K_x, that across it, of y and theta, by
    # [[1, T_s], [-T_s K_y, 1 - T_s K_theta]].
    scenario = load_scenario(OUTAGES, [*LINE, f"controller.kx={kx}"])
    (row,) = simulate_batch([scenario], [1], twins=True)[0]
    across = np.linalg.matrix_power(np.array([[1.0, 0.005], [-0.005, 0.99]]), 2000) @ [-1.0, 1.0]
    along = (1.0 - 0.005 * kx) ** 2000
    assert row["contraction"] == pytest.approx(np.hypot(along, np.linalg.norm(across)) / 3**0.5, rel=0.01)
    (alone,) = simulate_batch([scenario], [1])[0]
    assert np.isnan(alone["contraction"])
    assert alone.tobytes()[:-8] == row.tobytes()[:-8]  # all but the contraction


def test_twins_part_where_the_loop_is_unstable() -> None:
    unstable = [load_scenario(OUTAGES, [*LINE, f"controller.kx={kx}"]) for kx in (401.0, 500.0)]  # 1 - T_s K_x < -1
    assert (simulate_batch(unstable, [1], twins=True)["contraction"] > 1e3).all()


def test_nothing_to_do_is_done() -> None:
    assert simulate_batch([], [1]).shape == (0, 1)
    assert simulate_batch(scenarios(25.0), []).shape == (1, 0)
    assert simulate_batch([], []).dtype == STATISTICS


def test_progress_counts_runs() -> None:
    told: list[int] = []
    simulate_batch(scenarios(5.0, 25.0, 60.0), range(4), progress=told.append)
    assert told[-1] == 12
    assert told == sorted(told)


def test_what_cannot_be_run_is_refused_before_anything_is() -> None:
    endless = load_scenario(OUTAGES, ["plant.duration=inf"])
    with pytest.raises(UserError, match=r"plant\.duration is inf"):
        simulate_batch([*scenarios(25.0), endless], [1])


@given(rows=st.integers(0, 40), columns=st.integers(0, 20), workers=st.integers(1, 16))
@settings(deadline=None, derandomize=True)
def test_work_is_parted_without_gap_or_overlap(rows: int, columns: int, workers: int) -> None:
    units = _Batch(ONE * rows, range(columns), twins=False).units(workers)
    assert sorted(job for unit in units for job in unit) == [(i, j) for i in range(rows) for j in range(columns)]
    assert len(units) >= min(rows * columns // VECTOR, workers)  # fewer runs would take as long


def test_a_track_file_that_has_changed_is_read_again(tmp_path: Path) -> None:
    file = tmp_path / "track.csv"
    settings = ["error_detector.track=csv", f"error_detector.track_file={file}", "plant.duration=1.0"]
    file.write_text("t,v,w\n0,1,0\n100,1,0\n")
    scenario = load_scenario(OUTAGES, settings)
    slow = simulate_batch([scenario], [1])["final"][0, 0]
    file.write_text("t,v,w\n0,2.5,0\n100,2.5,0\n")
    fast = simulate_batch([scenario], [1])["final"][0, 0]
    run = simulate(scenario)
    assert fast == pytest.approx(run.reference[-1, 1] - run.pose[-1, 1], rel=1e-9) != slow
