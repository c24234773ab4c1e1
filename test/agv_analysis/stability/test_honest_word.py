"""The word on loops and recordings that were once called stable: they drift, change, or were hardly seen."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agv_analysis.link.heavy_tail import tail_is_heavy
from agv_analysis.link.reception_intervals import reception_intervals
from agv_analysis.report.verdict_sentence import sentence
from agv_analysis.run import ParameterChange, Run, Timing
from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.simulation import simulate, simulate_batch
from agv_analysis.stability.analysis import Analysis, analyse
from agv_analysis.stability.confidence.link_confidence import link_confidence
from agv_analysis.stability.evidence import evidence_of_scenario
from agv_analysis.stability.scenario_loop import loop_of_run
from agv_analysis.stability.verdict import GREEN, decide
from agv_analysis.sweep.collect import collect
from agv_analysis.sweep.execute import on_this_machine
from agv_analysis.sweep.plan import Sweep, axis_of
from agv_analysis.sweep.verdicts import with_verdicts

PAPER, LINE = str(Path(__file__).parents[3] / "config/paper.yaml"), "error_detector.track=line"

BEHIND = (LINE, "controller.v_max=0.8")
"""Slower than the reference: it falls behind by 0.2 m/s forever."""

SWINGS = (
    LINE, "plant.speed_scale=1.3", "controller.kx=1.0", "controller.ky=64.0", "controller.ktheta=16.0",
    "error_detector.speed=2.0",
)  # fmt: skip

HEAVY = (
    "controller.v_max=2.0", "plant.a_max=1.5", "plant.j_max=10.0", "plant.lag=0.05", "plant.noise_xy=0.005",
    "plant.noise_theta=0.005",
)  # fmt: skip
"""The heavy AGV of docs/plant.md: its limit on the jerk makes it swing by 1.2 m without any loss."""

BERNOULLI = (LINE, "relay.uplink.model=bernoulli")
UNSTABLE_GILBERT = (LINE, "relay.uplink.model=gilbert_elliott", "relay.uplink.p=0.001", "relay.uplink.r=0.01")
"""Mean age 9.09 steps, where K_x = 25 allows 7.5."""


def scenario_of(*settings: str) -> Scenario:
    return load_scenario(PAPER, settings)


def of(*settings: str) -> Analysis:
    return analyse(simulate(scenario_of(*settings)))


@pytest.mark.parametrize("settings", [BEHIND, SWINGS, HEAVY], ids=["falls behind", "swings", "heavy"])
def test_a_loop_that_does_not_settle_without_losses_is_not_green_anywhere(settings: tuple[str, ...]) -> None:
    assert of(*settings).verdict.word not in GREEN
    sweep = Sweep(scenario_of(*settings, "plant.duration=20.0"), (axis_of("plant.noise_xy", [0.0]),), 2)
    rows, _ = collect(sweep, None, lambda parts: on_this_machine(sweep, parts), lambda done: None)
    assert [row["unstable"] for row in rows] == [2]
    assert with_verdicts(sweep, rows)[0]["verdict"] not in GREEN


def test_the_reason_says_how_an_agv_that_is_too_slow_moves() -> None:
    found = of(*BEHIND)
    assert found.verdict.word == "infeasible"
    assert "falls behind its reference by 0.2 m/s" in found.verdict.reason


def test_a_limit_on_the_turn_rate_under_long_bursts() -> None:
    found = of("plant.w_max=0.1", "error_detector.policy=predict", "relay.uplink.model=burst", "relay.uplink.n=200")
    assert found.convergence.position.peak > 1000.0
    assert found.verdict.word == "unstable"


def test_a_link_that_changes_is_judged_by_its_worst_part() -> None:
    found = of(*BERNOULLI, "relay.uplink.schedule=0: p=0.05; 70: p=0.97")
    assert found.verdict.word == "unstable"
    assert "the link changed" in found.verdict.reason
    figures = found.to_json()
    (change,) = figures["stationarity"]["change_points"]
    assert change == pytest.approx(14_000, abs=20)
    assert figures["confidence"] < 0.05


def test_too_little_seen_of_an_unstable_link_is_seldom_green() -> None:
    words = [of(*UNSTABLE_GILBERT, f"relay.seed={seed}", "plant.duration=10.0").verdict.word for seed in range(12)]
    assert sum(word in GREEN for word in words) <= 1
    assert "undecided" in words


def test_a_link_that_was_hardly_seen_says_how_much_longer_to_record() -> None:
    found = of(*UNSTABLE_GILBERT, "relay.uplink.p=0.0005", "relay.uplink.r=0.1", "plant.duration=5.0")
    assert found.verdict.word == "undecided"
    assert found.to_json()["record_seconds_more"] > 1.0


def test_outages_by_the_clock_are_no_gilbert_channel() -> None:
    """0.2 s of every 1 s: E[L^2]/E[L] = (160 + 41^2) / 201 = 9.2 steps, below 2/a = 16."""
    found = of(LINE, "relay.uplink.schedule=0: outage=0.2 every 1")
    assert found.verdict.word in GREEN
    assert found.to_json()["stationarity"] is not None


@pytest.mark.parametrize(("outage", "period", "kx"), [(0.2, 20.0, 25.0), (0.055, 0.065, 25.0), (0.2, 0.23, 25.0)])
def test_a_schedule_of_outages_is_known_however_few_a_lap_shows(outage: float, period: float, kx: float) -> None:
    """The growth is that of the product of the steps of one period on the line, with matrices written out."""
    rotation, ts = np.eye(3), 0.005
    rotation[1, 2] = ts
    held = -ts * np.array([[kx, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 2.0]])
    product = np.eye(3)
    lost, slots = round(outage / ts), round(period / ts)
    for k in range(slots - lost):
        interval = np.eye(3)
        together = np.zeros((3, 3))
        for _ in range(lost + 1 if k == 0 else 1):
            together = rotation @ together + held
            interval = rotation @ interval
        product = (interval + together) @ product
    growth = 2.0 * np.log(np.abs(np.linalg.eigvals(product)).max()) / slots
    scenario = scenario_of(LINE, f"relay.uplink.schedule=0: outage={outage} every {period}", f"controller.kx={kx}")
    found = evidence_of_scenario(scenario)
    assert found.growth == pytest.approx(growth, abs=1e-9)
    assert (decide(found).word in GREEN) == (growth < 0.0)
    assert found.n == lost


@pytest.mark.parametrize(("n", "is_stable"), [(10, True), *((n, False) for n in (16, 200, 999, 20_000, 10**6))])
def test_outages_that_repeat_are_judged_by_their_own_length_however_long_they_are(n: int, is_stable: bool) -> None:
    """Along the line an outage of n slots multiplies the error by 1 - (n + 1) / 8; at n = 15 by -1."""
    settings = (LINE, "relay.uplink.model=burst", f"relay.uplink.n={n}")
    found = decide(evidence_of_scenario(scenario_of(*settings), with_margin=False))
    assert (found.word in GREEN) == is_stable


def test_a_run_that_ends_in_an_outage_is_not_judged_as_if_it_never_ended() -> None:
    run = simulate(scenario_of(*BERNOULLI, "relay.uplink.p=0.0", "plant.duration=10.0"))
    lost = np.zeros(len(run), dtype=np.bool_)
    lost[-30:] = True
    found = analyse(dataclasses.replace(run, lost=lost, n_ul=np.where(lost, np.arange(len(run)) - len(run) + 31, 0)))
    assert found.verdict.word == "undecided"


def test_intervals_that_no_gilbert_channel_makes(tmp_path: Path) -> None:
    """An outage follows 25 % of receptions, 5 % of these last 60 slots, the others 1: E[(1 - aL)^2] = 1.256."""
    rng = np.random.default_rng(3)
    slots: list[int] = []
    while len(slots) < 20_000:
        outage = (60 if rng.random() < 0.05 else 1) if rng.random() < 0.25 else 0
        slots += [0, *[1] * outage]
    trace = tmp_path / "trace.csv"
    trace.write_text("lost\n" + "\n".join(map(str, slots)) + "\n")
    assert of(LINE, "relay.uplink.model=trace", f"relay.uplink.trace_file={trace}").verdict.word not in GREEN


# -- what was driven --------------------------------------------------------------------------------------------------


def with_kx(run: Run, kx: float) -> Run:
    """A run whose K_x is said to be another than that which was driven."""
    controller = dataclasses.replace(run.scenario.controller, kx=kx)
    return dataclasses.replace(run, scenario=dataclasses.replace(run.scenario, controller=controller))


def test_commands_of_other_gains_are_not_judged_by_the_parameters() -> None:
    found = analyse(with_kx(simulate(scenario_of("controller.kx=50.0", "plant.duration=20.0")), 25.0))
    assert found.verdict.word == "unknown"
    assert "K_x = 50.0, not 25.0" in found.verdict.reason


def test_each_part_between_changes_of_a_parameter_is_judged_and_the_worst_decides() -> None:
    """K_x = 500 has a = 2.5 > 2: it diverges without any loss."""
    begun = simulate(scenario_of(LINE, "plant.duration=20.0"))
    x, y, theta = begun.pose[-1]
    start = ["plant.duration=0.1", LINE, "controller.kx=500.0"]
    start += [f"plant.initial_pose=[{x}, {y + 0.01}, {theta}]"]
    ended = simulate(scenario_of(*start))
    later = dataclasses.replace(ended, reference=begun.reference[-1] + 0.0 * ended.reference)
    names = ("pose", "reference", "error", "command", "n_ul", "lost", "downlink_lost", "n_dl")
    rows: dict[str, Any] = {name: np.concatenate((getattr(begun, name), getattr(later, name))) for name in names}
    change = ParameterChange(len(begun), "controller", "kx", 25.0, 500.0)
    k = np.arange(len(begun) + len(ended))
    run = dataclasses.replace(begun, k=k, **rows, uplink=None, downlink=None, parameter_changes=(change,))
    found = analyse(run)
    assert found.verdict.word not in GREEN
    assert "parameters were changed, and from 20 s" in found.verdict.reason


def test_an_agv_that_strays_further_than_its_simulation() -> None:
    run = simulate(scenario_of(LINE, "plant.duration=20.0"))
    aside = np.where(run.time > 10.0, 0.3, 0.0)
    found = analyse(dataclasses.replace(run, pose=run.pose + aside[:, None] * [1.0, 0.0, 0.0]))
    assert found.verdict.word == "unknown"
    assert "in the simulation under the same losses" in found.verdict.reason


def test_messages_that_are_missing_prove_nothing() -> None:
    run = simulate(scenario_of(LINE, "plant.duration=20.0"))
    assert analyse(dataclasses.replace(run, unexplained={"/edge/pose": 4})).verdict.word == "unknown"


# -- when messages came -----------------------------------------------------------------------------------------------


def test_poses_that_wait_and_arrive_together_are_not_judged_as_if_they_had_come_at_once() -> None:
    """Nothing is lost, but for 5 of every 6 s poses wait, as over a reliable connection that stalls."""
    run = simulate(scenario_of(LINE, "plant.duration=30.0"))
    age = np.maximum(run.k % 1200 - 200, 0)
    found = analyse(dataclasses.replace(run, timing=Timing(is_late=True, command_age=age)))
    assert found.n == 999
    assert found.verdict.word not in GREEN


def test_missed_deadlines_without_a_record_of_when_messages_came() -> None:
    run = simulate(scenario_of(LINE, "plant.duration=20.0"))
    ages = np.zeros(len(run), dtype=np.int64)
    timing = Timing(False, ages, deadlines=1200, missed_deadlines=153, unknown="log times are the stamps")
    found = analyse(dataclasses.replace(run, timing=timing))
    assert found.verdict.word == "unknown"
    assert "153 deadlines were missed" in found.verdict.reason


@pytest.mark.parametrize(("delay", "word"), [(0.06, "asymptotic"), (0.065, "unstable")])
def test_late_commands_are_judged_by_the_age_of_the_pose_behind_them(delay: float, word: str) -> None:
    """At K_x = 25 a pose that is always 12 steps old is survived, 13 are not, wherever it waits."""
    scenario = scenario_of(LINE, f"relay.downlink.delay={delay}", "plant.duration=20.0")
    assert (simulate_batch([scenario], [1], twins=True)["contraction"][0, 0] < 1.0) == (word == "asymptotic")
    found = analyse(simulate(scenario))
    assert found.verdict.word == word
    assert f"{round(delay / 0.005)} steps old when its command acts" in found.verdict.reason
    assert f"poses up to {round(delay / 0.005)} steps ({delay * 1e3:g} ms) old" in sentence(found)


def test_late_commands_behind_a_predictor_are_not_judged() -> None:
    found = of(LINE, "relay.downlink.delay=0.03", "error_detector.policy=predict", "plant.duration=20.0")
    assert (found.verdict.word, found.verdict.reason) == ("unknown", "commands were late, which no criterion covers")


@pytest.mark.parametrize(("n", "kx", "word"), [(5, 25.0, "mean-square"), (40, 100.0, "unstable")])
def test_outcomes_that_repeat_exactly_are_judged_by_simulation_where_no_criterion_is(
    n: int, kx: float, word: str
) -> None:
    lossy = ("relay.downlink.model=burst", f"relay.downlink.n={n}", "plant.downlink_policy=ramp")
    scenario = scenario_of(LINE, *lossy, f"controller.kx={kx}", "plant.duration=20.0", "plant.ramp_time=3.0")
    contracts = simulate_batch([scenario], [1], twins=True)["contraction"][0, 0] < 1.0
    found = analyse(simulate(scenario))
    assert (found.verdict.word, contracts) == (word, word == "mean-square")
    assert found.verdict.criterion == "simulation"


@pytest.mark.parametrize("first", [1, 5])
def test_behind_an_exact_predictor_a_link_that_stays_silent_is_not_green(first: int) -> None:
    """A few poses, and none after them: an open loop."""
    silent = "relay.uplink.model=burst", f"relay.uplink.start_step={first}", "relay.uplink.n=100000"
    found = of(LINE, "error_detector.policy=predict", *silent)
    assert found.verdict.word == "undecided"
    assert f"nothing was received in the last {20_000 - first} of 20000 slots" in found.verdict.reason


# -- two links --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("share", "word"), [(1.0, "mean-square"), (0.0, "unstable")])
def test_links_that_fail_together_are_easier_to_bear(share: float, word: str) -> None:
    """Half of all lost on both links, K_x = 130: with one fate for both E[e^2] dies out, with two it grows (THEORY)."""
    links = [f"relay.{link}.{setting}" for link in ("uplink", "downlink") for setting in ("model=bernoulli", "p=0.5")]
    settings = ("error_detector.track=circle", "controller.kx=130.0", *links, f"relay.downlink.correlation={share}")
    assert of(*settings).verdict.word == word
    assert decide(evidence_of_scenario(scenario_of(*settings))).word == word


def test_an_agv_that_settles_elsewhere_from_elsewhere_is_not_called_unstable() -> None:
    """Beside the line, and turned, pure pursuit drives the track backwards: another steady motion, not a swing."""
    ahead = [f"{node}.look_ahead=0.5" for node in ("error_detector", "controller", "plant", "relay")]
    assert of(LINE, "controller.law=pure_pursuit", *ahead).verdict.word == "asymptotic"


def test_a_steady_drift_is_called_one() -> None:
    """A slip of 10 % of 1.05 m/s leaves 0.945 m/s for a reference of 1 m/s."""
    found = of(LINE, "controller.v_max=1.05", "plant.slip=0.1")
    assert found.verdict.word == "infeasible"
    assert "falls behind its reference by 0.055 m/s" in found.verdict.reason


def test_a_limit_below_the_reference_s_speed_is_one_thing_on_all_closed_tracks() -> None:
    """At 0.8 m/s on a circle of 100 m at 1 m/s it settles, slowly, on one of 80 m: 8.09 m behind its reference."""
    for track in ("circle", "eight"):
        found = of(f"error_detector.track={track}", "controller.v_max=0.8")
        assert found.verdict.word == "asymptotic"
        last = slice(-len(found.run) // 4, None)
        away = np.hypot(*(found.run.pose - found.run.reference[:, :3])[last, :2].T).max()
        assert found.evidence.beside_reference == pytest.approx(away, rel=0.1)
        assert f"even without losses it drives up to {found.evidence.beside_reference:.3g} m" in found.verdict.reason


def test_a_limit_on_the_jerk_does_not_unsettle_a_steady_speed() -> None:
    """A circle of 200 m at 2 m/s, driven at 1.6: it settles on one of 160 m, 18.2 m behind its reference, slowly."""
    slow = (
        "error_detector.track=circle", "error_detector.speed=2.0", "controller.v_max=1.6", "controller.kx=0.65",
        "controller.ky=0.56", "controller.ktheta=0.64", "plant.a_max=2.0", "plant.j_max=20.0", "plant.lag=0.3",
    )  # fmt: skip
    run = simulate(scenario_of(*slow, "plant.duration=600.0"))
    away = np.hypot(*(run.pose - run.reference[:, :3])[-20_000:, :2].T)
    assert np.ptp(away) < 1e-3
    found = evidence_of_scenario(scenario_of(*slow))
    assert decide(found).word == "asymptotic"
    assert found.beside_reference == pytest.approx(away.mean(), abs=1e-3)


def test_a_limit_of_just_the_reference_s_speed_never_makes_up_for_what_was_lost() -> None:
    assert of(LINE, "controller.v_max=1.0").verdict.word == "bounded"
    assert of(LINE, "controller.v_max=1.05").verdict.word == "asymptotic"


def test_a_noisy_run_is_no_contradiction_to_its_own_simulation() -> None:
    found = of(LINE, "plant.noise_theta=0.5", "plant.noise_xy=5.0", "plant.duration=20.0")
    assert found.verdict.word == "asymptotic"
    assert "noise and slip are left out of this: simulated with them the AGV is up to" in found.verdict.reason


def test_the_reason_of_an_unstable_word_is_no_reason_for_doubt() -> None:
    """Pareto's outages, far too long for K_x = 100: with or without a mean square of their lengths the error grows."""
    run = simulate(scenario_of(LINE, "controller.kx=100.0"))
    rng = np.random.default_rng(5)
    lost = np.concatenate([[False, *[True] * int(3.0 / rng.random() ** (1.0 / 1.5))] for _ in range(5000)])[: len(run)]
    assert tail_is_heavy(reception_intervals(run.k, lost).outages)
    found = link_confidence(loop_of_run(run), run.k, lost, run.ts)
    assert found.probability_stable < 0.05
    assert "may not exist" not in found.reason


@pytest.mark.parametrize("delay", [0.005, 0.01, 0.02])
def test_a_known_channel_behind_a_delay_is_not_judged_by_the_one_lap_that_it_was_simulated_for(delay: float) -> None:
    """Mean age 9.6 slots without the delay, where K_x = 25 allows 7.5; most laps of 100 s see two or three outages."""
    r, rate = 1.0 / 300.0, 0.032
    link = ("relay.uplink.model=gilbert_elliott", f"relay.uplink.p={r * rate / (1.0 - rate)}", f"relay.uplink.r={r}")
    assert rate * 300.0 > 1.0 / 0.125 - 0.5
    assert decide(evidence_of_scenario(scenario_of(*link, f"relay.uplink.delay={delay}"))).word not in GREEN


def test_a_late_recording_with_hardly_an_outage_is_as_undecided_as_one_in_time() -> None:
    few = ("relay.uplink.model=gilbert_elliott", "relay.uplink.p=0.0001", "relay.uplink.r=0.0033")
    in_time, late = of(*few), of(*few, "relay.uplink.delay=0.01")
    assert in_time.outages.uplink.count == late.outages.uplink.count <= 2
    assert in_time.verdict.word == late.verdict.word == "undecided"
