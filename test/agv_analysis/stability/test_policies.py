"""The criteria under the staleness policies, against the loop driven and against closed forms."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.link.markov_channel import bernoulli
from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.simulation import simulate, simulate_batch
from agv_analysis.stability import floquet, joint_spectral_radius, mean_square
from agv_analysis.stability.analysis import analyse
from agv_analysis.stability.linear_loop import LinearLoop, kanayama_loop
from agv_analysis.stability.linearisation import step_matrices
from agv_analysis.stability.margins import margins
from agv_analysis.stability.reception_maps import burst_maps
from agv_analysis.stability.scenario_loop import loop_on_lap
from agv_cloud.parameters import ControllerParameters

PAPER = str(Path(__file__).parents[3] / "config/paper.yaml")
TS = 0.005
ON_TRACK = "plant.initial_pose=[0.0, 0.0, 1.5707963267948966]"


def scenario(*settings: str) -> Scenario:
    return load_scenario(PAPER, [ON_TRACK, *settings])


def predicting(kx: float, delta: float) -> LinearLoop:
    """Along a line, behind a predictor that does not know that the true speed is 1 + delta times the commanded one."""
    return kanayama_loop(np.ones(1), np.zeros(1), ControllerParameters(kx=kx), TS, True, 1.0 + delta)


def along(a: float, delta: float, length: int) -> float:
    """Factor of the error along a straight track over a burst: 1 - (1 + delta) (1 - (1 - a)^L)."""
    return 1.0 - (1.0 + delta) * (1.0 - (1.0 - a) ** length)


@pytest.mark.parametrize("delta", [-0.3, 0.0, 0.1, 1.1])
def test_the_maps_of_a_predictor_along_a_line_are_the_closed_form(delta: float) -> None:
    for length, M in enumerate(burst_maps(predicting(25.0, delta), 60), start=1):
        assert M[0, 0, 0] == pytest.approx(along(0.125, delta, length), abs=1e-12)


@pytest.mark.parametrize(("kx", "delta"), [(25.0, 0.1), (25.0, 0.95), (25.0, 1.1), (300.0, 0.3), (300.0, 0.4)])
def test_every_outage_is_survived_within_the_bound_on_the_models_error(kx: float, delta: float) -> None:
    """|delta| a < 1 - |1 - a|, a = T_s K_x: the theory's; the criterion on arbitrary bursts says the same."""
    a = TS * kx
    within = abs(delta) * a < 1.0 - abs(1.0 - a)
    found, refuted = joint_spectral_radius.largest_n(predicting(kx, delta), limit=200)
    assert (found is None and refuted is None) == within
    if not within:
        assert refuted is not None
        assert abs(along(a, delta, refuted + 1)) > 1.0
        assert all(abs(along(a, delta, n + 1)) <= 1.0 for n in range(refuted))


def test_the_moments_behind_a_predictor_are_those_of_renewals() -> None:
    """E[f(L)^2] = 1 at the border, L the geometric length of a burst; speeds without curvature part the directions."""
    p = mean_square.critical_loss(predicting(25.0, 1.1))
    lengths = np.arange(1, 4000)
    square = np.sum((1.0 - p) * p ** (lengths - 1) * np.array([along(0.125, 1.1, n) ** 2 for n in lengths.tolist()]))
    assert square == pytest.approx(1.0, abs=1e-6)


def test_the_lap_and_the_operator_agree() -> None:
    """Two implementations: the recursion along a lap and the matrix of it."""
    gains = ControllerParameters(kx=60.0, ky=1.0, ktheta=4.0)  # no double eigenvalue, to which laps converge slowly
    chain = bernoulli(0.6)
    one = kanayama_loop(np.full(1, 1.2), np.full(1, 0.3), gains, TS, True, 1.4)
    radius = mean_square.spectral_radius(*mean_square.step_maps(one), chain)
    speeds = np.full(400, 1.2), np.full(400, 0.3)
    speeds[0][-1] = np.nextafter(1.2, 2.0)  # not constant, so that the lap is driven
    growth = mean_square.lap_growth(kanayama_loop(*speeds, gains, TS, True, 1.4), chain)
    assert growth / 400 == pytest.approx(math.log(radius), abs=1e-6)


def driven_behind_a_predictor(n: int, F: Floats, G: Floats, delta: float, steps: int) -> Floats:
    """The error e(k), each prediction made anew from e(k-n) and the commands since; shape (steps, m)."""
    error, thought = [np.ones(F.shape[-1])], list[Floats]()
    for k in range(steps):
        then = max(0, k - n)
        at_edge = error[then]
        for j in range(then, k):
            at_edge = F[j % len(F)] @ at_edge + G[j % len(F)] @ thought[j]
        thought.append(at_edge)
        true = G[k % len(F)].copy()
        true[:, 0] *= 1.0 + delta
        error.append(F[k % len(F)] @ error[k] + true @ at_edge)
    return np.array(error)


@pytest.mark.parametrize(("n", "delta", "kx"), [(3, 0.5, 60.0), (12, -0.7, 25.0), (12, 1.3, 100.0), (7, 2.2, 150.0)])
def test_a_constant_delay_behind_a_predictor_with_a_wrong_model(n: int, delta: float, kx: float) -> None:
    """Against the loop driven with predictions made anew at each step, on a lap whose speeds change all the time."""
    laps, gains, angle = 60, ControllerParameters(kx=kx, ky=4.0, ktheta=6.0), 2.0 * np.pi * np.arange(50) / 50
    v_r, w_r = 1.5 + 0.5 * np.sin(angle), 2.0 * np.cos(angle)
    F, G = step_matrices(v_r, w_r, gains, TS)
    error = np.linalg.norm(driven_behind_a_predictor(n, F, G, delta, 50 * laps), axis=1)
    growth = floquet.constant_delay(kanayama_loop(v_r, w_r, gains, TS, True, 1.0 + delta), n)
    peaks = error[1:].reshape(laps, 50).max(axis=1)
    assert math.log(peaks[-1] / peaks[20]) / (laps - 21) == pytest.approx(growth, rel=0.05, abs=0.02)


@pytest.mark.parametrize(("delta", "a"), [(0.5, 0.125), (0.99, 1.0), (1.2, 0.125), (3.0, 0.3)])
def test_the_longest_delay_behind_a_predictor_along_a_line(delta: float, a: float) -> None:
    """z^n (z - 1 + a) + a delta: all roots inside the unit circle up to n, not beyond; no bound for |delta| < 1."""

    def radius(n: int) -> float:
        return (
            float(np.abs(np.roots([1.0, a - 1.0, *[0.0] * (n - 1), a * delta])).max())
            if n
            else abs(1.0 - a - a * delta)
        )

    found = floquet.largest_constant_delay(predicting(a / TS, delta), limit=150)
    assert (found is None) == (delta < 1.0)
    if found is None:
        assert max(radius(n) for n in range(150)) < 1.0
    else:
        assert max(radius(n) for n in range(found + 1)) < 1.0 <= radius(found + 1)


@pytest.mark.parametrize(("scale", "n", "contracts"), [(1.1, 200, True), (2.1, 15, True), (2.1, 40, False)])
def test_twins_behind_a_predictor_confirm_the_bursts(scale: float, n: int, contracts: bool) -> None:
    wanted = scenario(
        "error_detector.policy=predict", "error_detector.track=line", f"plant.speed_scale={scale}",
        "relay.uplink.model=burst", f"relay.uplink.n={n}",
    )  # fmt: skip
    found = simulate_batch([wanted], [1], twins=True)["contraction"][0, 0]
    assert (found < 0.5) == contracts
    word = joint_spectral_radius.verdict(loop_on_lap(wanted), n).verdict
    assert (word == joint_spectral_radius.STABLE) == contracts


def test_an_exact_predictor_has_no_bound_and_says_why() -> None:
    found = margins(scenario("error_detector.policy=predict"))
    assert (found.n_lifted, found.n_bursts, found.p_mean_square, found.p_almost_sure) == (None, None, None, None)
    assert found.binding is None
    for name in ("n_max.lifted", "n_max.bursts", "p_max.mean_square", "p_max.almost_sure"):
        assert found.reasons[name].startswith("no bound")


def test_aligned_poses_have_the_margins_of_held_ones() -> None:
    held, aligned = margins(scenario()), margins(scenario("error_detector.policy=align"))
    assert dataclasses.asdict(aligned) == dataclasses.asdict(held)


def test_a_faster_plant_is_a_larger_gain() -> None:
    """To an edge that holds or aligns, a speed of twice the commanded one is twice K_x along the track.

    It settles at x_e = -1/50 m, where the gain of the heading is K_theta + K_y x_e: on curves a trace of it is left.
    """
    faster, higher = margins(scenario("plant.speed_scale=2.0")), margins(scenario("controller.kx=50.0"))
    assert (faster.n_lifted, faster.n_bursts) == (higher.n_lifted, higher.n_bursts)
    assert faster.p_mean_square == pytest.approx(higher.p_mean_square, abs=1e-7)


@pytest.mark.parametrize(("policy", "word"), [("hold", "unstable"), ("align", "unstable"), ("predict", "asymptotic")])
def test_the_verdict_knows_the_policy(policy: str, word: str) -> None:
    run = simulate(
        scenario(
            f"error_detector.policy={policy}", "relay.uplink.model=burst", "relay.uplink.n=16", "plant.duration=20.0"
        )
    )
    assert analyse(run).verdict.word == word


def test_held_is_the_default() -> None:
    loop = loop_on_lap(scenario())
    assert not loop.predicts
    assert loop.closed_form == scenario().controller
