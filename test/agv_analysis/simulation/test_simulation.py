"""The simulation against the paper's numbers, against theory, and at the limits of what a run can be."""

from __future__ import annotations

import csv
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from agv_analysis.cli import main
from agv_analysis.commands.simulate import write_csv
from agv_analysis.metrics.convergence import convergence
from agv_analysis.run import Run
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate
from agv_plant.radio.channel import Channel
from agv_ros.errors import UserError

PAPER = str(Path(__file__).parents[3] / "config" / "paper.yaml")


def run_of(*settings: str) -> Run:
    return simulate(load_scenario(PAPER, settings))


# -- the canonical scenario --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kx", "v_max", "settled", "damping"),
    [
        ("5.0", "inf", 246, "over"),
        ("25.0", "inf", 47, "critical"),
        ("250.0", "inf", 5, "under"),
        ("5.0", "6.0", 307, "over"),
        ("25.0", "6.0", 171, "critical"),
        ("250.0", "6.0", 154, "under"),
    ],
)
def test_the_paper_settles_and_damps_as_it_says(kx: str, v_max: str, settled: int, damping: str) -> None:
    found = convergence(run_of(f"controller.kx={kx}", f"controller.v_max={v_max}"))
    assert (found.settle_1cm_steps, found.damping) == (settled, damping)


def test_the_paper_starts_at_24_5_meters_per_second_backwards() -> None:
    command = run_of("controller.kx=5.0").command
    assert command[0, 0] == pytest.approx(-24.5, abs=1e-12)
    assert command[1, 0] == pytest.approx(-23.875, abs=1e-6)  # 0.5 - 25 * 0.975; v_r has risen by 4e-7


def test_the_largest_gain_overshoots_by_a_quarter() -> None:
    overshoot = convergence(run_of("controller.kx=250.0")).overshoot  # |1 - T_s K_x| = 0.25
    assert overshoot == pytest.approx(0.25, abs=5e-5)


# -- tracks ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("track", ["paper", "line", "circle", "eight", "warehouse"])
def test_on_the_reference_with_a_perfect_channel_the_error_is_zero_to_the_last_bit(track: str) -> None:
    run = run_of(
        f"error_detector.track={track}", "plant.initial_pose=[0.0, 0.0, 1.5707963267948966]", "plant.duration=100.005"
    )
    assert len(run) == 20_001
    assert np.array_equal(run.pose, run.reference[:, :3])
    assert not run.error.any()
    distance = np.hypot(*(run.pose[-1, :2] - run.pose[0, :2]))  # after a lap, step N
    assert distance == pytest.approx(100.0 if track == "line" else 0.0, abs=1e-9)


# -- outages -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "grows"), [(14, False), (16, True)])
def test_bursts_contract_or_grow_as_the_switched_system_says(n: int, grows: bool) -> None:
    # Along the track a burst multiplies the error by 1 - a L, L = n + 1: -0.875 and -1.125 for a = T_s K_x = 0.125.
    run = run_of("relay.uplink.model=burst", f"relay.uplink.n={n}", "plant.duration=20.0")
    bursts = np.abs(run.reference[:, 1] - run.pose[:, 1])[:: n + 1]
    if grows:
        assert bursts[30] / bursts[20] == pytest.approx(1.125**10, rel=0.02)
        assert np.max(bursts) > 100.0 * bursts[0]
    else:
        # The error that is left is the bias of the outdated pose, v_r n T_s at most for each factor 1 / (1 - 0.875).
        assert bursts[-1] < 1.5 * 14 * 0.005


def test_a_wide_miss_is_a_bounded_cycle_once_the_speed_is_limited() -> None:
    run = run_of("relay.uplink.model=burst", "relay.uplink.n=40", "controller.v_max=6.0")
    assert len(run) == 20_000
    assert np.max(np.abs(run.pose)) < 100.0
    assert np.max(np.abs(run.command[:, 0])) == 6.0


def test_outcomes_are_those_of_the_relay() -> None:
    run = run_of(
        "relay.uplink.model=gilbert_elliott", "relay.uplink.p=0.1", "relay.uplink.r=0.3", "relay.uplink.h=0.2",
        "relay.downlink.model=bernoulli", "relay.downlink.p=0.3", "relay.seed=9", "plant.duration=5.0",
    )  # fmt: skip
    for lost, stream in ((run.lost, "uplink"), (run.downlink_lost, "downlink")):
        channel = Channel(getattr(run.scenario.relay, stream), 9, stream)
        assert lost.tolist() == [channel.lost(k) for k in range(1000)]
        assert 0 < lost.sum() < 1000


def test_a_seed_is_a_run_and_another_seed_another() -> None:
    lossy = ("relay.uplink.model=bernoulli", "relay.uplink.p=0.3", "plant.duration=2.0")
    first, again, other = run_of(*lossy), run_of(*lossy), run_of(*lossy, "relay.seed=2")
    assert first.pose.tobytes() == again.pose.tobytes()
    assert first.pose.tobytes() != other.pose.tobytes()


# -- at the limits -----------------------------------------------------------------------------------------------------


DIVERGING = (
    "plant.ts=10.0", "plant.duration=5000.0", "error_detector.track=line", "error_detector.lap_time=1000.0",
    "controller.kx=1.0", "controller.ky=0.0", "controller.ktheta=0.0",
)  # fmt: skip


def test_a_loop_that_leaves_the_range_of_numbers_ends_there_and_says_so() -> None:
    run = run_of(*DIVERGING)
    assert np.isfinite(run.pose).all()
    # The error grows by |1 - T_s K_x| = 9 a step, from 5 m to where ten times it, the way of one step, is not a number.
    assert len(run) == math.ceil(math.log(sys.float_info.max / 50.0) / math.log(9.0)) + 1
    assert run.notes == (f"the loop diverged: after step {len(run) - 1} of 500 the AGV's pose is no longer finite",)
    found = convergence(run)
    assert (found.settle_1cm_steps, found.damping, found.y.ise) == (None, "under", math.inf)


def test_a_command_beyond_the_range_of_numbers_is_refused_and_the_one_before_goes_on() -> None:
    far = "plant.initial_pose=[0.0, 1e305, 1.5707963267948966]"
    run = run_of(far, "controller.kx=1000000.0", "plant.duration=1.0")
    assert np.isinf(run.command[:, 0]).all()
    assert (run.pose == run.pose[0]).all()  # there is none before: the AGV stands still
    assert run.notes == ("200 commands were not finite and were refused, the first at step 0",)


def test_an_error_beyond_the_range_of_numbers_has_no_command() -> None:
    run = run_of("plant.initial_pose=[1.7e308, 1.7e308, 0.7853981633974483]")
    assert len(run) == 1
    assert np.isnan(run.command).all()
    assert run.notes


def test_a_run_of_one_step() -> None:
    run = run_of("plant.duration=0.001")
    assert len(run) == 1
    assert run.pose.tolist() == [[0.0, 5.0, 1.5707963267948966]]


def test_a_run_without_an_end_is_refused() -> None:
    with pytest.raises(UserError, match=r"plant\.duration is inf.*--set plant\.duration"):
        run_of("plant.duration=inf")


def test_real_time_is_not_simulated_and_the_run_says_so() -> None:
    assert "lockstep" in run_of("plant.clock=realtime", "plant.duration=0.1").notes[0]


# -- the file ----------------------------------------------------------------------------------------------------------


def test_the_csv_file_has_every_number_in_full(tmp_path: Path) -> None:
    run = run_of("relay.uplink.model=bernoulli", "relay.uplink.p=0.5", "plant.duration=1.0")
    write_csv(tmp_path / "run.csv", run)
    with open(tmp_path / "run.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 200
    assert [float(row["y_c"]) for row in rows] == run.pose[:, 1].tolist()
    assert [float(row["theta_r"]) for row in rows] == run.reference[:, 2].tolist()
    assert [float(row["w"]) for row in rows] == run.command[:, 1].tolist()
    assert [row["lost"] == "1" for row in rows] == run.lost.tolist()
    assert [int(row["n_ul"]) for row in rows] == run.n_ul.tolist()
    assert math.isclose(float(rows[-1]["t"]), 199 * 0.005)
    assert [row["cause"] for row in rows] == ["bernoulli" if lost else "" for lost in run.lost.tolist()]
    assert {(row["n_dl"], row["gain"], row["downlink_cause"]) for row in rows} == {("0", "nan", "")}


# -- the command -------------------------------------------------------------------------------------------------------


def test_the_command_says_and_writes_what_analyse_does(tmp_path: Path) -> None:
    done = CliRunner().invoke(
        main, ["simulate", PAPER, "--set", "controller.kx=250.0", "--json", str(tmp_path / "run.json")]
    )
    assert done.exit_code == 0, done.output
    assert "under" in done.output
    found = json.loads((tmp_path / "run.json").read_text())
    assert {name: found[name] for name in ("loss_rate", "n_ul_max", "settle_1cm_steps", "damping")} == {
        "loss_rate": 0.0, "n_ul_max": 0, "settle_1cm_steps": 5, "damping": "under",
    }  # fmt: skip
    assert found["overshoot"] == pytest.approx(0.25)
    assert {"settle_2pct_steps", "paper_stable", "lifted_stable", "bursts_stable"} <= found.keys()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["missing.yaml"], "missing.yaml: cannot be read"),
        ([PAPER, "--set", "plant.duration=inf"], "plant.duration is inf"),
        ([PAPER, "--set", "controller.kx=nan"], "controller.kx must be"),
        ([PAPER, "--set", "plant.duration=0.1", "--csv", "/nowhere/run.csv"], "/nowhere/run.csv: cannot be written"),
    ],
)
def test_what_the_command_cannot_do_is_one_line_and_status_1(arguments: list[str], said: str) -> None:
    done = CliRunner().invoke(main, ["simulate", *arguments])
    assert done.exit_code == 1
    assert said in done.output
    assert "Traceback" not in done.output
