"""The initial error apart from what outages do, against loops in plain Python and closed forms."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.metrics.convergence import convergence
from agv_analysis.metrics.initial_error import (
    FARTHER,
    ON_REFERENCE,
    TURNED,
    TWIN,
    UNTIL_FIRST_OUTAGE,
    first_outage,
    overshoot,
    until_forgotten,
)
from agv_analysis.recordings.recording import read_run
from agv_analysis.report.table import convergence_rows
from agv_analysis.run import Run, Timing
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate, simulate_batch
from agv_analysis.stability.analysis import observe
from agv_analysis.sweep.summary import quantiles

ROOT = Path(__file__).parents[3]
TS = 0.005
ON_TRACK = "plant.initial_pose=[0.0, 0.0, 1.5707963267948966]"
BESIDE = "plant.initial_pose=[0.3, 0.0, 1.5707963267948966]"
Posture = tuple[float, float, float]


def run_of(*settings: str, config: str = "outages") -> Run:
    return simulate(load_scenario(str(ROOT / f"config/{config}.yaml"), settings))


def naive(start: Posture, run: Run, kx: float, v_max: float) -> tuple[list[Posture], list[float]]:
    """The paper's loop under the losses of a run, from its equations alone: X_c(k), and v(k)."""
    x, y, theta = start
    held, poses, speeds = start, [], []
    for lost, (x_r, y_r, theta_r, v_r, w_r) in zip(run.lost.tolist(), run.reference.tolist(), strict=True):
        poses.append((x, y, theta))
        held = held if lost else (x, y, theta)
        dx, dy, theta_e = x_r - held[0], y_r - held[1], theta_r - held[2]
        x_e = math.cos(held[2]) * dx + math.sin(held[2]) * dy
        y_e = math.cos(held[2]) * dy - math.sin(held[2]) * dx
        v = max(-v_max, min(v_max, v_r * math.cos(theta_e) + kx * x_e))
        w = w_r + v_r * (y_e + 2.0 * math.sin(theta_e))
        speeds.append(v)
        x, y, theta = x + TS * v * math.cos(theta), y + TS * v * math.sin(theta), theta + TS * w
    return poses, speeds


def settles(sizes: Sequence[float], band: float) -> int | None:
    last = max((k for k, size in enumerate(sizes) if size >= band), default=-1)
    return last + 1 if last + 1 < len(sizes) else None


def damping_class(d: Sequence[float], v: Sequence[float], v_max: float) -> str:
    band = 0.02 * max(map(abs, d))
    if any(value > band for value in d) and any(value < -band for value in d):
        return "under"
    settled = settles([abs(value) for value in d], band)
    assert settled is not None
    free = max((k for k in range(settled) if abs(v[k]) >= v_max), default=0)
    return "critical" if TS * (settled - free) <= 0.25 else "over"


LOSSES = {
    "gilbert": ("relay.uplink.p=0.02",),
    "bernoulli": ("relay.uplink.model=bernoulli", "relay.uplink.p=0.5"),
    "from step 1 on": ("relay.uplink.model=burst", "relay.uplink.n=6", "relay.uplink.start_step=1"),
    "always": ("relay.uplink.model=burst", "relay.uplink.n=3"),
    "none": ("relay.uplink.model=perfect",),
}


@pytest.mark.parametrize("losses", LOSSES.values(), ids=LOSSES)
@pytest.mark.parametrize("start", [(0.0, 5.0, math.pi / 2), (1.0, -2.0, 2.0)], ids=["ahead", "anyhow"])
@pytest.mark.parametrize(("kx", "v_max"), [(5.0, math.inf), (25.0, 6.0), (60.0, math.inf)])
def test_it_is_the_difference_of_two_loops_in_plain_python(
    losses: tuple[str, ...], start: Posture, kx: float, v_max: float
) -> None:
    limit = () if math.isinf(v_max) else (f"controller.v_max={v_max}",)
    settings = (*losses, *limit, f"plant.initial_pose={list(start)}", f"controller.kx={kx}", "plant.duration=20.0")
    run = run_of(*settings)
    found = convergence(run)
    (poses, v), (ideal, v_ideal) = (naive(at, run, kx, v_max) for at in (start, (0.0, 0.0, math.pi / 2)))
    left = [(o[0] - p[0], o[1] - p[1], p[2]) for p, o in zip(poses, ideal, strict=True)]
    sizes = [math.hypot(dx, dy) for dx, dy, _ in left]
    assert found.initial.of == TWIN
    assert found.settle_1cm_steps == settles(sizes, 0.01)
    assert found.settle_2pct_steps == settles(sizes, 0.02 * sizes[0])
    along = [math.cos(turn) * dx + math.sin(turn) * dy for dx, dy, turn in left]
    across = [math.cos(turn) * dy - math.sin(turn) * dx for dx, dy, turn in left]
    beyond = [
        max(-value / one[0] for value in one) * abs(one[0]) for one in (along, across) if abs(one[0]) > 0.02 * sizes[0]
    ]
    forgotten = 0.01 * min(0.01, 0.02 * sizes[0])  # of which no more is looked at
    assert found.overshoot == pytest.approx(max(0.0, *beyond) / sizes[0], rel=1e-6, abs=forgotten / sizes[0])
    if start[0] == 0.0:
        d = [one - other for one, other in zip(v, v_ideal, strict=True)]
        assert found.damping == damping_class(d, v, v_max)
    (row,) = simulate_batch([run.scenario], [1])[0]
    assert (row["settle_1cm_steps"], row["settle_2pct_steps"]) == (found.settle_1cm_steps, found.settle_2pct_steps)
    assert row["overshoot"] == pytest.approx(found.overshoot, rel=1e-9, abs=1e-12)


OVER_LINKS = {
    "late": ("relay.uplink.model=perfect", "relay.uplink.delay=0.02", "relay.downlink.delay=0.01"),
    "jitter": ("relay.uplink.jitter=0.03", "relay.downlink.model=bernoulli", "relay.downlink.p=0.2"),
    "noise, slip": ("plant.noise_xy=0.005", "plant.noise_theta=0.002", "plant.slip_noise=0.02"),
    "lag, predict": ("plant.lag=0.05", "error_detector.policy=predict", "plant.integration=arc"),
}  # fmt: skip


@pytest.mark.parametrize("settings", OVER_LINKS.values(), ids=OVER_LINKS)
def test_a_batch_says_what_the_history_says(settings: tuple[str, ...]) -> None:
    run = run_of(*settings, "controller.kx=10.0", "plant.duration=10.0")
    found = convergence(run)
    (row,) = simulate_batch([run.scenario], [run.scenario.relay.seed], twins=True)[0]
    assert found.initial.of == TWIN
    assert found.settle_1cm_steps is not None
    assert (row["settle_1cm_steps"], row["settle_2pct_steps"]) == (found.settle_1cm_steps, found.settle_2pct_steps)
    assert row["overshoot"] == pytest.approx(found.overshoot, rel=1e-9, abs=1e-12)


def test_noise_is_no_part_of_it() -> None:
    quiet, noisy = (
        convergence(run_of("controller.kx=10.0", "plant.duration=10.0", *noise))
        for noise in ((), ("plant.noise_xy=0.02",))
    )
    assert noisy.excursion is not None
    assert noisy.excursion.seconds > 5.0  # the noise alone keeps it from staying within 1 cm
    assert quiet.settle_1cm_steps is not None
    assert noisy.settle_1cm_steps == pytest.approx(quiet.settle_1cm_steps, abs=2)


def test_beside_its_track_it_settles_as_the_critically_damped_error_does() -> None:
    # K_theta^2 = 4 K_y at 1 m/s: y_e = 0.3 (1 + t) exp(-t); the error in y of the map is next to nothing.
    found = convergence(run_of(BESIDE, "error_detector.track=line", "plant.duration=20.0", config="paper"))
    y, theta, last = 0.3, 0.0, 0
    for k in range(4000):
        last = k if abs(y) >= 0.01 else last
        y, theta = y + TS * math.sin(theta), theta - TS * (y + 2.0 * math.sin(theta))
    assert found.settle_1cm_steps == pytest.approx(last + 1, rel=0.02)
    t = TS * (found.settle_1cm_steps or 0)
    assert 0.3 * (1.0 + t) * math.exp(-t) == pytest.approx(0.01, rel=0.05)
    assert found.overshoot == 0.0
    assert found.y.peak < 0.05


@pytest.mark.parametrize("seed", range(1, 13))
def test_a_low_gain_is_over_damped_whatever_the_outages(seed: int) -> None:
    found = convergence(run_of("controller.kx=5.0", f"relay.seed={seed}", "plant.duration=20.0"))
    assert found.damping == "over"
    assert found.settle_1cm_steps == pytest.approx(246, abs=15)


def test_the_demo_settles_at_once_and_is_disturbed_until_its_end() -> None:
    run = run_of()
    found = convergence(run).to_json()
    assert found["settle_1cm_steps"] == math.ceil(math.log(0.01 / 5.0) / math.log(0.875)) == 47
    assert (found["convergence_of"], found["convergence_reason"]) == ("twin", None)
    away = [math.hypot(*(r[:2] - p[:2])) >= 0.01 for r, p in zip(run.reference, run.pose, strict=True)]
    last = max(k for k, is_away in enumerate(away) if is_away)
    assert found["last_excursion_seconds"] == pytest.approx((last + 1) * TS) == 99.75
    first = max(k for k in range(last) if not away[k]) + 1
    lengths, length = [], 0  # of the outages that are felt from then on
    for k, lost in enumerate(run.lost.tolist()):
        length = length + 1 if lost else 0
        if lost and (k + 1 == len(run) or not run.lost[k + 1]) and k >= first - 1 and k - length + 1 < last:
            lengths.append(length)
    assert found["last_excursion_after"] == max(lengths) == 11
    assert (found["initial_error"], found["max_error"]) == (5.0, 5.0)
    assert found["max_error_after_settling"] == pytest.approx(
        max(math.hypot(*(r[:2] - p[:2])) for r, p in zip(run.reference[47:], run.pose[47:], strict=True))
    )
    rows = dict(convergence_rows(convergence(run), 1e3 * TS))
    assert rows["Last excursion above 1 cm"] == "99.75 s, after an outage of 11 slots"
    assert rows["Error"] == "5 m at the start, 0.0137 mm at the end"


@pytest.mark.parametrize(
    ("kx", "v_max", "settled", "damped"),
    [
        (5.0, math.inf, 246, "over"), (25.0, math.inf, 47, "critical"), (250.0, math.inf, 5, "under"),
        (5.0, 6.0, 307, "over"), (25.0, 6.0, 171, "critical"), (250.0, 6.0, 154, "under"),
    ],
)  # fmt: skip
def test_without_outages_the_papers_numbers_are_what_they_were(
    kx: float, v_max: float, settled: int, damped: str
) -> None:
    limit = () if math.isinf(v_max) else (f"controller.v_max={v_max}",)
    found = convergence(run_of(f"controller.kx={kx}", *limit, "plant.duration=10.0", config="paper"))
    assert (found.settle_1cm_steps, found.damping) == (settled, damped)
    assert found.excursion is not None
    assert (found.excursion.is_initial_error, found.excursion.after) == (True, None)
    if kx == 250.0 and math.isinf(v_max):
        assert found.overshoot == pytest.approx(0.25, abs=1e-12)


def test_an_error_that_had_settled_is_not_blamed_for_a_later_excursion() -> None:
    found = convergence(run_of("controller.kx=300.0", "relay.uplink.p=0.2"))
    assert found.settle_1cm_steps == 63
    assert found.excursion is not None
    assert (found.excursion.is_over, found.excursion.is_initial_error, found.excursion.after) == (False, False, 26)


# -- what cannot be said -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("config", ["paper", "outages"])
def test_without_an_initial_error_nothing_settles(config: str) -> None:
    run = run_of(ON_TRACK, "plant.duration=20.0", config=config)
    found = convergence(run)
    assert (found.settle_1cm_steps, found.settle_2pct_steps, found.overshoot) == (None, None, None)
    assert found.initial.reason == ON_REFERENCE
    assert found.max_error_after_settling == found.position.peak
    assert dict(convergence_rows(found, 5.0))["Settling"] == ON_REFERENCE
    (row,) = simulate_batch([run.scenario], [1])[0]
    assert (row["settle_1cm_steps"], row["settle_2pct_steps"]) == (-1, -1)
    assert np.isnan(row["overshoot"])


def test_an_error_of_heading_alone_has_no_share() -> None:
    found = convergence(run_of("plant.initial_pose=[0.0, 0.0, 2.0]", "plant.duration=20.0", config="paper"))
    assert found.settle_1cm_steps is not None
    assert found.settle_1cm_steps > 100
    assert (found.settle_2pct_steps, found.overshoot, found.initial.reason) == (None, None, TURNED)


def test_a_run_that_ends_too_early_says_so() -> None:
    found = convergence(run_of("controller.kx=5.0", "plant.duration=1.0", config="paper"))
    assert found.settle_1cm_steps is None
    assert found.settle_2pct_steps == 155
    assert found.initial.reason == "the run ends before its initial error has settled"
    assert found.max_error_after_settling is None
    rows = dict(convergence_rows(found, 5.0))
    assert rows["Settling"] == f"155 steps (0.775 s) to 2 %, not to 1 cm; {found.initial.reason}"


def test_where_twins_part_it_never_settles() -> None:
    found = convergence(run_of("relay.uplink.model=burst", "relay.uplink.n=20", "plant.duration=5.0"))
    assert (found.initial.of, found.settle_1cm_steps) == (TWIN, None)


# -- recordings --------------------------------------------------------------------------------------------------------


def test_a_recording_that_the_simulation_reproduces_has_a_twin() -> None:
    run = read_run(ROOT / "bags/sample")
    found = convergence(run)
    assert (found.initial.of, found.settle_1cm_steps, found.settle_2pct_steps) == (TWIN, 47, 30)
    assert found.damping == "critical"


def another_robots(*lost: int, initial: float = -5.0, ratio: float = 0.9, steps: int = 400) -> Run:
    """A run of which no simulation knows anything: its error along the track is a geometric series."""
    run = run_of("error_detector.track=line", f"plant.duration={steps * TS}", config="paper")
    pose = run.reference[:, :3].copy()
    pose[:, 1] -= initial * ratio ** np.arange(steps)
    outcomes = np.isin(np.arange(steps), lost)
    n_ul = np.where(outcomes, 1, 0)
    return dataclasses.replace(run, pose=pose, lost=outcomes, n_ul=n_ul, gains_known=False)


def test_without_a_twin_the_first_outage_is_the_end() -> None:
    at = math.ceil(math.log(0.002) / math.log(0.9))
    whole, after, before = (convergence(another_robots(*lost)) for lost in ((), (at, 200), (at - 1, 200)))
    for found in (whole, after):
        assert (found.initial.of, found.settle_1cm_steps, found.overshoot) == (UNTIL_FIRST_OUTAGE, at, 0.0)
        assert found.initial.reason == ""
    assert before.settle_1cm_steps is None
    assert before.settle_2pct_steps == math.ceil(math.log(0.02) / math.log(0.9))
    assert f"first outage, at step {at - 1}, came before" in before.initial.reason
    assert "gains are not known" in before.initial.reason


def test_poses_that_came_late_end_it_as_lost_ones_do() -> None:
    """Nothing is lost, but from step 150 on poses wait, and the AGV goes 0.1 m astray: not its initial error."""
    run = another_robots()
    pose, age = run.pose.copy(), np.where(run.k >= 150, run.k - 150, 0)
    pose[160:200, 1] += 0.1
    found = convergence(dataclasses.replace(run, pose=pose, timing=Timing(is_late=True, command_age=age)))
    assert found.settle_1cm_steps == math.ceil(math.log(0.002) / math.log(0.9))
    assert found.initial.of == UNTIL_FIRST_OUTAGE


@pytest.mark.parametrize("step", [0, 1])
def test_an_outage_at_the_very_beginning_leaves_nothing_to_say(step: int) -> None:
    run = another_robots(step)
    assert first_outage(run) == step
    found = convergence(run)
    assert (found.settle_1cm_steps, found.settle_2pct_steps, found.overshoot) == (None, None, None)
    assert found.damping is None
    assert f"at step {step}, came before" in found.initial.reason
    figures = observe(run).to_json()
    assert (figures["convergence_of"], figures["convergence_reason"]) == (UNTIL_FIRST_OUTAGE, found.initial.reason)


def test_an_error_that_comes_later_is_not_the_initial_one() -> None:
    run = another_robots(initial=-0.012)
    pose = run.pose.copy()
    pose[100:, 1] -= 0.12  # ten times the initial error, on its other side, whatever the cause
    found = convergence(dataclasses.replace(run, pose=pose))
    assert (found.settle_1cm_steps, found.settle_2pct_steps, found.overshoot) == (None, None, None)
    assert "begins 0.012 m away from its reference and is up to 0.12 m away later" in found.initial.reason
    assert FARTHER * 0.012 < 0.12


def test_a_pose_that_is_not_the_simulations_has_no_twin() -> None:
    run = run_of("plant.duration=2.0")
    pose = run.pose.copy()
    pose[100:, 0] += 0.001
    found = convergence(dataclasses.replace(run, pose=pose))
    assert found.initial.of == UNTIL_FIRST_OUTAGE
    assert first_outage(run) == int(np.flatnonzero(run.lost)[0])
    assert found.settle_1cm_steps == 47  # the first outage comes after
    early = run_of("plant.duration=2.0", "relay.uplink.model=burst", "relay.uplink.n=2")
    found = convergence(dataclasses.replace(early, pose=pose))
    assert "not what its parameters give in the simulation" in found.initial.reason
    late = dataclasses.replace(
        run,
        **{name: getattr(run, name)[9:] for name in ("k", "reference", "error", "command", "n_ul")},
        pose=run.pose[9:], lost=run.lost[9:], downlink_lost=run.downlink_lost[9:], n_dl=None,
    )  # fmt: skip
    assert convergence(late).initial.of == UNTIL_FIRST_OUTAGE


# -- pieces ------------------------------------------------------------------------------------------------------------


def test_what_was_forgotten_for_forty_steps_does_not_come_back() -> None:
    left = np.zeros((200, 3))
    left[:10, 0] = 5.0
    left[60:, 0] = 1.0  # of an unstable loop: after 50 steps within 1 % of 1 cm
    assert not until_forgotten(left)[10:].any()
    left[30, 0] = 2e-4  # after 20 only
    assert until_forgotten(left)[60:, 0].all()
    left[:, 0] = 0.0
    left[:, 2] = 1.0  # turned: not together
    assert until_forgotten(left) is left


def test_the_other_side_is_that_of_a_component_that_has_one() -> None:
    left = np.array([[3.0, 4.0, 0.0], [-0.75, 4.0, 0.0], [0.0, 1.0, 0.0]])
    assert overshoot(left) == 0.15
    left = np.array([[5.0, 0.05, 0.0], [1.0, -2.0, 0.0], [0.0, 0.0, 0.0]])  # it began 1 % across
    assert overshoot(left) == 0.0


def test_quantiles_tell_never_from_nothing_to_settle() -> None:
    assert quantiles(np.array([3.0, -1.0, -1.0]), settling=True) == (math.inf, math.inf)
    assert all(math.isnan(value) for value in quantiles(np.array([3.0, math.nan]), settling=True))
