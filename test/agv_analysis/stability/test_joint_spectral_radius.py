"""Bursts in any order against explicit products of the steps' matrices, closed forms, and runs of the loop."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agv_analysis.run import Run
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.stability.criteria.criterion import RunFacts
from agv_analysis.stability.joint_spectral_radius import (
    STABLE,
    UNDECIDED,
    UNSTABLE,
    largest_n,
    largest_n_across,
    largest_n_along,
    verdict,
)
from agv_analysis.stability.linear_loop import LinearLoop, kanayama_loop
from agv_analysis.stability.linearisation import step_matrices
from agv_cloud.parameters import ControllerParameters

if TYPE_CHECKING:
    from test.conftest import Lap

CONFIG = str(Path(__file__).parents[3] / "config/paper.yaml")
TS = 0.005
Floats = NDArray[np.float64]


def constant(v: float, w: float, by: ControllerParameters) -> LinearLoop:
    return kanayama_loop(np.full(5, v), np.full(5, w), by, TS)


def burst_map(F: Floats, G: Floats, first: int, length: int) -> Floats:
    """Error after a burst, column by column: each step sees the error at `first`."""
    held = error = np.eye(3)
    for k in range(first, first + length):
        error = F[k % len(F)] @ error + G[k % len(F)] @ held
    return error


# -- acceptance ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("track", ["paper", "line", "circle", "eight", "warehouse"])
@pytest.mark.parametrize(("kx", "last"), [(5.0, 78), (25.0, 14), (250.0, 0)])
def test_the_canonical_scenario_whatever_the_track(lap: Lap, track: str, kx: float, last: int) -> None:
    assert largest_n(kanayama_loop(*lap(track)[1:], ControllerParameters(kx=kx), TS)) == (last, last + 1)


def separation(track: str, kx: float, n: int, steps: int) -> float:
    """Growth over a run of the distance between two runs under identical outages that begin a bit apart."""
    setting = [f"error_detector.track={track}", f"controller.kx={kx}", f"plant.duration={steps * TS}"]
    setting += ["relay.uplink.model=burst", f"relay.uplink.n={n}"]
    one, other = (
        simulate(load_scenario(CONFIG, [*setting, f"plant.initial_pose=[0.0, {y}, 1.5707963267948966]"]))
        for y in (0.0, 1e-6)
    )
    assert len(one) == len(other) == steps
    return float(np.linalg.norm(one.pose[-1] - other.pose[-1])) / 1e-6


@pytest.mark.parametrize("track", ["paper", "line", "eight"])
@pytest.mark.parametrize(("kx", "stable", "unstable"), [(5.0, 74, 90), (25.0, 14, 16), (250.0, 0, 1)])
def test_runs_on_both_sides_of_the_border(track: str, kx: float, stable: int, unstable: int) -> None:
    assert separation(track, kx, stable, 6000) < 1e-3
    assert separation(track, kx, unstable, 4000) > 1e2


@pytest.mark.parametrize("n", [13, 18])
def test_recorded_runs_of_the_nodes_on_both_sides_of_the_border(drive: Callable[..., Run], n: int) -> None:
    """K_x = 25, from 5 m ahead, 4 s: along a line each burst multiplies the error by 1 - (n + 1) / 8."""
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    setting = ["error_detector.track=line", "plant.duration=4.0", "relay.uplink.model=burst", f"relay.uplink.n={n}"]
    run = drive(*setting)
    assert run.n_ul.max() == n
    received = run.pose[run.n_ul == 0, 1] - run.reference[run.n_ul == 0, 1]
    settled = TS * n / 2.0  # p -> p + L T_s v_r + a sum of (r(k) - p) over the burst: ahead by the mean of its ages
    ratios = np.diff(received[:20] - settled)[1:] / np.diff(received[:20] - settled)[:-1]
    np.testing.assert_allclose(ratios, 1.0 - 0.125 * (n + 1), atol=1e-3)
    assert abs(received[-1]) < 0.1 if n == 13 else abs(received[-1]) > 100.0


@pytest.mark.parametrize(("n", "amplitude"), [(14, 0.0), (16, 0.24), (20, 0.37)])
def test_a_limit_on_speed_bounds_what_is_unstable(n: int, amplitude: float) -> None:
    """It oscillates forever; a stable loop is at most n T_s v_r ahead of its reference, v_r = 1 m/s."""
    setting = ["error_detector.track=line", "controller.v_max=6.0", "relay.uplink.model=burst", f"relay.uplink.n={n}"]
    run = simulate(load_scenario(CONFIG, setting))
    distance = np.hypot(*(run.reference[:, :2] - run.pose[:, :2]).T)
    assert distance[10_000:15_000].max() == pytest.approx(distance[15_000:].max(), abs=0.01)
    if amplitude:
        assert distance[15_000:].max() == pytest.approx(amplitude, abs=0.005)
    else:
        assert distance[15_000:].max() <= n * TS


# -- closed forms ----------------------------------------------------------------------------------------------------


@settings(deadline=None, derandomize=True)
@given(st.floats(1e-3, 5.0))
def test_along_the_track_every_factor_must_be_below_one(a: float) -> None:
    last = next(n for n in itertools.count(-1) if not abs(1.0 - a * (n + 2)) < 1.0)
    if abs(2.0 / a - round(2.0 / a)) > 1e-9:
        assert largest_n_along(a) == last


def test_the_marginal_burst_along_does_not_count() -> None:
    assert [largest_n_along(a) for a in (2.0, 1.0, 0.5, 0.125)] == [-1, 0, 2, 14]
    assert largest_n_along(0.0) is None


@settings(deadline=None, derandomize=True, max_examples=50)
@given(st.floats(0.5, 30.0), st.floats(0.05, 20.0), st.floats(0.05, 20.0))
def test_across_the_track_by_eigenvalues(v: float, ky: float, ktheta: float) -> None:
    F, G = step_matrices(np.array([v]), np.zeros(1), ControllerParameters(kx=25.0, ky=ky, ktheta=ktheta), TS)
    found = largest_n_across(v, ControllerParameters(kx=25.0, ky=ky, ktheta=ktheta), TS)
    assert found is not None

    def radius(n: int) -> float:
        return float(np.abs(np.linalg.eigvals(burst_map(F, G, 0, n + 1)[1:, 1:])).max())

    for n in {0, found // 2, found} if found >= 0 else ():
        assert radius(n) < 1.0 + 1e-7
    assert radius(found + 1) > 1.0 - 1e-7


def test_where_nothing_corrects_across() -> None:
    assert largest_n_across(1.0, ControllerParameters(kx=25.0, ky=0.0, ktheta=2.0), TS) == -1
    assert largest_n_across(1.0, ControllerParameters(kx=25.0, ky=1.0, ktheta=0.0), TS) == -1
    assert largest_n_across(0.0, ControllerParameters(), TS) == -1


# -- bounds and certificate ------------------------------------------------------------------------------------------

CASES = [(1.0, 0.0, 25.0, 1.0, 2.0, 12), (1.5, 0.6, 60.0, 4.0, 3.0, 4), (8.0, -2.0, 10.0, 2.0, 3.0, 6)]


@pytest.mark.parametrize(("v", "w", "kx", "ky", "ktheta", "n"), CASES)
def test_the_certificate_is_a_norm_that_every_burst_shrinks(
    v: float, w: float, kx: float, ky: float, ktheta: float, n: int
) -> None:
    loop = constant(v, w, ControllerParameters(kx=kx, ky=ky, ktheta=ktheta))
    found, F, G = verdict(loop, n), loop.F, loop.G
    assert found.verdict == STABLE
    P = found.certificate
    assert P is not None
    np.testing.assert_array_equal(P, P.T)
    assert np.linalg.eigvalsh(P)[0] > 0.0
    growth = []
    for length in range(1, n + 2):
        M = burst_map(F, G, 0, length)
        assert np.linalg.eigvalsh(M.T @ P @ M - P)[-1] < 0.0
        worst = np.max(np.linalg.eigvals(np.linalg.solve(P, M.T @ P @ M)).real)
        growth.append(math.sqrt(worst) ** (1.0 / length))
    assert found.upper == pytest.approx(max(growth), rel=1e-9)


@pytest.mark.parametrize(("v", "w", "kx", "ky", "ktheta", "n"), CASES)
def test_no_sequence_leaves_the_bounds(v: float, w: float, kx: float, ky: float, ktheta: float, n: int) -> None:
    """All products of up to four bursts of five lengths: their radius per step is below the upper bound."""
    loop = constant(v, w, ControllerParameters(kx=kx, ky=ky, ktheta=ktheta))
    found, F, G = verdict(loop, n), loop.F, loop.G
    lengths = sorted({1, 2, (n + 1) // 2, n, n + 1})
    maps = {length: burst_map(F, G, 0, length) for length in lengths}
    radii = {}
    for count in range(1, 5):
        for sequence in itertools.product(lengths, repeat=count):
            M = np.linalg.multi_dot([np.eye(3), *(maps[length] for length in sequence), np.eye(3)])
            radii[sequence] = float(np.abs(np.linalg.eigvals(M)).max()) ** (1.0 / sum(sequence))
    assert max(radii.values()) <= found.upper + 1e-9
    repeated = {length: radii[(length,)] for length in lengths}
    assert found.lower >= max(repeated.values()) - 1e-7
    assert found.lower == pytest.approx(
        float(np.abs(np.linalg.eigvals(burst_map(F, G, 0, found.worst + 1))).max()) ** (1.0 / (found.worst + 1)),
        abs=1e-7,
    )


def test_speeds_that_change_inside_a_burst(lap: Lap) -> None:
    """A lap of 60 steps with stops: random sequences of bursts, driven by hand, stay below the upper bound."""
    v_r, w_r = lap("warehouse", 60)[1:]
    v_r = 10.0 * v_r
    by, n = ControllerParameters(kx=20.0, ky=1.0, ktheta=2.0), 8
    found, (F, G) = verdict(kanayama_loop(v_r, w_r, by, TS), n), step_matrices(v_r, w_r, by, TS)
    assert found.verdict in (STABLE, UNDECIDED)
    random = np.random.default_rng(1)
    for _ in range(40):
        product, k, log_scale = np.eye(3), 0, 0.0
        while k < 6000:
            length = int(random.integers(1, n + 2))
            product, k = burst_map(F, G, k, length) @ product, k + length
            size = np.abs(product).max()
            product, log_scale = product / size, log_scale + math.log(size)
        assert math.exp(log_scale / k) <= found.upper + 2e-3


@pytest.mark.parametrize("n", [0, 2, 6, 9])
def test_the_lower_bound_drives_laps_whose_last_burst_is_cut_short(n: int) -> None:
    """Seven steps a lap: bursts of L steps from its first, the rest of 7 / L at its end."""
    random = np.random.default_rng(3)
    v_r, w_r, by = (
        random.uniform(0.0, 20.0, 7),
        random.uniform(-9.0, 9.0, 7),
        ControllerParameters(kx=80.0, ky=4.0, ktheta=3.0),
    )
    F, G = step_matrices(v_r, w_r, by, TS)
    radii = []
    for length in range(1, n + 2):
        lap_map = np.eye(3)
        for first in range(0, 7, length):
            lap_map = burst_map(F, G, first, min(length, 7 - first)) @ lap_map
        radii.append(float(np.abs(np.linalg.eigvals(lap_map)).max()) ** (1.0 / 7.0))
    found = verdict(kanayama_loop(v_r, w_r, by, TS), n)
    assert found.lower == pytest.approx(max(radii), rel=1e-9)
    assert found.worst == int(np.argmax(radii))


@pytest.mark.parametrize("n", [16, 20])
def test_an_unstable_verdict_names_a_burst_that_grows(n: int) -> None:
    found = verdict(constant(1.0, 0.0, ControllerParameters()), n)
    assert (found.verdict, found.worst, found.certificate) == (UNSTABLE, n, None)
    assert found.lower == pytest.approx(abs(1.0 - 0.125 * (n + 1)) ** (1.0 / (n + 1)), rel=1e-12)


def test_a_parked_agv_is_judged_by_what_it_can_reach() -> None:
    stopped = constant(0.0, 0.0, ControllerParameters())
    assert largest_n(stopped) == (14, 15)
    assert verdict(stopped, 14).certificate is not None


def test_bursts_that_bring_the_error_to_nothing() -> None:
    """1 / a is an integer: for a parked AGV M_8 = 0 at a = 1/8, and M_1 = 0 at a = 1."""
    assert verdict(constant(0.0, 0.0, ControllerParameters()), 7).verdict == STABLE
    found = verdict(constant(0.0, 0.0, ControllerParameters(kx=200.0)), 0)
    assert (found.verdict, found.lower, found.upper) == (STABLE, 0.0, 0.0)


def test_degenerate_gains(lap: Lap) -> None:
    def found(kx: float) -> tuple[int | None, int | None]:
        return largest_n(kanayama_loop(*lap("line")[1:], ControllerParameters(kx=kx), TS))

    assert found(0.0)[0] == -1  # what is off along the track stays off
    assert found(200.0) == (0, 1)  # deadbeat
    assert found(401.0) == (-1, 0)


def test_without_outages_there_is_one_sequence_and_no_norm_is_needed() -> None:
    """A lap on two steps: each alone grows in every common norm, their product does not."""
    up, down = np.diag([2.0, 0.25, 0.5]), np.diag([0.25, 2.0, 0.5])
    loop = LinearLoop(
        TS, np.ones(2), np.zeros(2), A=np.array([up, down]), B=np.zeros((2, 3, 2)), D=np.zeros((2, 3, 3)),
        L_h=np.zeros((2, 2, 3)), L_z=np.zeros((2, 2, 3)),
    )  # fmt: skip
    found = verdict(loop, 0)
    assert (found.verdict, found.certificate) == (STABLE, None)
    assert found.lower == found.upper == pytest.approx(math.sqrt(0.5), rel=1e-12)


def test_an_outage_of_a_whole_lap_is_refuted_by_a_shorter_one() -> None:
    """All maps of a lap for each of 20 000 lengths would take 28 GB."""
    loop = RunFacts(simulate(load_scenario(CONFIG, []))).loop
    found = verdict(loop, 19_999)
    assert (found.n_max, found.verdict) == (19_999, UNSTABLE)
    assert 14 < found.worst <= 500
    assert found.lower > 1.0


def test_behind_an_exact_predictor_no_outage_is_too_long() -> None:
    loop = RunFacts(simulate(load_scenario(CONFIG, ["error_detector.policy=predict"]))).loop
    assert loop.is_exact
    assert verdict(loop, 19_999).verdict == STABLE
    assert largest_n(loop, 19_999) == (None, None)
