"""The paper's eigenvalue test against numpy, against finite differences of the loop, and against what the loop does."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agv_analysis.scenario import load_scenario
from agv_analysis.stability import almost_sure
from agv_analysis.stability.linear_loop import kanayama_loop
from agv_analysis.stability.paper import largest_n, matrices, spectral_radii
from agv_cloud.control.kanayama import kanayama
from agv_cloud.parameters import ControllerParameters
from agv_cloud.reference.reference import Reference
from agv_cloud.tracking_error import tracking_error
from agv_plant.vehicle.unicycle import euler_step

if TYPE_CHECKING:
    from test.conftest import Lap

CONFIG = str(Path(__file__).parents[3] / "config/paper.yaml")
TS = 0.005
Floats = NDArray[np.float64]


def step(pose: Floats, held: Floats, reference: Floats, by: ControllerParameters) -> Floats:
    """X_c(k+1) of the loop for the poses X_c(k) and X_c(k-n)."""
    x_r, y_r, theta_r, v_r, w_r = reference.tolist()
    error = tracking_error(x_r, y_r, theta_r, *held.tolist())
    command = kanayama(*error, v_r, w_r, by.kx, by.ky, by.ktheta)
    x, y, theta = pose.tolist()
    return np.array(euler_step(x, y, theta, *command, TS))


angle, speed = st.floats(-4.0, 4.0), st.floats(-3.0, 3.0)


@settings(deadline=None, derandomize=True, max_examples=60)
@given(angle, angle, speed, st.floats(0.0, 300.0), st.floats(0.0, 20.0), st.floats(0.0, 20.0))
def test_a_is_the_sum_of_both_derivatives_of_the_loop_at_zero_error(
    theta: float, held: float, v: float, kx: float, ky: float, ktheta: float
) -> None:
    by = ControllerParameters(kx=kx, ky=ky, ktheta=ktheta)
    now, then = np.array([3.0, -2.0, theta]), np.array([1.0, 2.0, held])
    reference = np.array([*then, v, 0.3])
    h = 1e-5
    numeric = np.empty((3, 3))
    for column, unit in enumerate(np.eye(3)):
        ahead = step(now + h * unit, then, reference, by) - step(now - h * unit, then, reference, by)
        ahead = ahead + step(now, then + h * unit, reference, by) - step(now, then - h * unit, reference, by)
        numeric[:, column] = ahead / (2.0 * h)
    found = matrices(np.array([theta]), np.array([held]), np.array([v]), by, TS)[0]
    # X_c(k) appears in both terms, so the identity of Euler's step is counted once.
    np.testing.assert_allclose(found, numeric, atol=1e-8)


@pytest.mark.parametrize("literal", [False, True])
def test_spectral_radii_are_those_of_numpy(literal: bool) -> None:
    random = np.random.default_rng(5)
    shape = 4000
    theta, held = random.uniform(-4.0, 4.0, (2, shape))
    v = random.uniform(0.0, 3.0, shape) * (random.random(shape) > 0.05)
    nu = random.uniform(-30.0, 30.0, shape) if literal else None
    for kx, ky, ktheta in [(5.0, 1.0, 2.0), (25.0, 1.0, 2.0), (250.0, 30.0, 1.0), (200.0, 0.0, 2.0), (0.0, 5.0, 0.0)]:
        by = ControllerParameters(kx=kx, ky=ky, ktheta=ktheta)
        truth = np.abs(np.linalg.eigvals(matrices(theta, held, v, by, TS, nu))).max(axis=1)
        error = np.abs(spectral_radii(theta, held, v, by, TS, nu) - truth)
        assert np.quantile(error, 0.9) < 1e-12
        assert error.max() < 1e-5  # where roots coincide, numpy's are good to the cube root of 1e-16


def test_the_printed_form_differs_in_one_entry() -> None:
    theta, held, v, nu = (np.array([value]) for value in (0.4, 0.1, 1.5, -24.5))
    difference = matrices(theta, held, v, ControllerParameters(), TS, nu) - matrices(
        theta, held, v, ControllerParameters(), TS
    )
    assert difference[0, 2, 1] == pytest.approx(-TS * np.cos(0.1) * (-24.5 - 1.5))
    difference[0, 2, 1] = 0.0
    assert not difference.any()


# -- how many outages it allows --------------------------------------------------------------------------------------


def holds(n: int, theta: Floats, v: Floats, by: ControllerParameters) -> bool:
    """The test for a constant n at every step of a lap, by numpy; X_c(0) for k < n."""
    held = np.maximum(np.arange(len(theta)) - n, 0)
    A = matrices(theta, theta[held], v[held], by, TS)
    return bool(np.abs(np.linalg.eigvals(A)).max() < 1.0)


@pytest.mark.parametrize("kx", [5.0, 25.0, 250.0])
@pytest.mark.parametrize("track", ["paper", "circle", "eight"])
def test_on_a_curve_the_last_n_holds_and_the_next_does_not(lap: Lap, track: str, kx: float) -> None:
    theta, v = lap(track)[:2]
    found = largest_n(theta, v, ControllerParameters(kx=kx), TS)
    assert found is not None
    assert found > (1800 if track == "eight" else 2000)
    assert holds(found, theta, v, ControllerParameters(kx=kx))
    assert not holds(found + 1, theta, v, ControllerParameters(kx=kx))


@pytest.mark.parametrize("track", ["paper", "eight"])
@pytest.mark.parametrize("kx", [5.0, 150.0, 390.0])
def test_a_short_lap_against_every_n(lap: Lap, track: str, kx: float) -> None:
    theta, v = lap(track, 240)[:2]
    broken = next(
        (n for n in range(240) if not holds(n, theta, v, ControllerParameters(kx=kx, ky=1.0, ktheta=2.0))), None
    )
    found = largest_n(theta, v, ControllerParameters(kx=kx, ky=1.0, ktheta=2.0), TS)
    assert found == (None if broken is None else broken - 1)


@settings(deadline=None, derandomize=True, max_examples=200)
@given(st.lists(st.floats(-2.0, 2.0), min_size=1, max_size=25), st.lists(st.floats(0.1, 3.0), min_size=25, max_size=25))
def test_any_headings_against_every_n(headings: list[float], speeds: list[float]) -> None:
    theta, v, by = np.array(headings), np.array(speeds[: len(headings)]), ControllerParameters(kx=150.0)
    later, earlier = np.tril_indices(len(theta))
    radii = np.abs(np.linalg.eigvals(matrices(theta[later], theta[earlier], v[earlier], by, TS))).max(axis=1)
    assume(np.all(np.abs(radii - 1.0) > 1e-9))  # nearer, numpy's rounding decides
    gaps = (later - earlier)[radii > 1.0]
    assert largest_n(theta, v, by, TS) == (gaps.min() - 1 if len(gaps) else None)


@settings(deadline=None, derandomize=True, max_examples=200)
@given(st.floats(0.1, 900.0), st.floats(0.01, 3e4), st.floats(0.1, 900.0), speed)
def test_it_fails_at_once_where_an_eigenvalue_of_a_fresh_pose_is_outside(
    kx: float, ky: float, ktheta: float, v: float
) -> None:
    by, theta, speeds = ControllerParameters(kx=kx, ky=ky, ktheta=ktheta), np.array([0.7]), np.array([v])
    radius = np.abs(np.linalg.eigvals(matrices(theta, theta, speeds, by, TS)[0])).max()
    assume(abs(radius - 1.0) > 1e-9)  # nearer, numpy's rounding decides
    assert (largest_n(theta, speeds, by, TS) == -1) == (radius > 1.0)


@pytest.mark.parametrize("kx", [5.0, 25.0, 250.0])
def test_on_a_line_it_is_blind(lap: Lap, kx: float) -> None:
    assert largest_n(*lap("line")[:2], ControllerParameters(kx=kx), TS) is None


def test_a_parked_agv_fails_it_at_once(lap: Lap) -> None:
    """At v_r = 0 an eigenvalue is 1, whatever the gains."""
    assert spectral_radii(np.array([0.3]), np.array([0.3]), np.zeros(1), ControllerParameters(), TS)[0] == 1.0
    assert largest_n(*lap("warehouse")[:2], ControllerParameters(), TS) == -1


def test_deadbeat_passes_it() -> None:
    """K_x = 1 / T_s has the eigenvalue 0, which the printed 0 < |lambda| would refuse."""
    theta = np.array([np.pi / 2])
    values = np.linalg.eigvals(matrices(theta, theta, np.ones(1), ControllerParameters(kx=200.0), TS)[0])
    assert np.abs(values).min() < 1e-15
    assert spectral_radii(theta, theta, np.ones(1), ControllerParameters(kx=200.0), TS)[0] == pytest.approx(
        0.995, abs=1e-7
    )


# -- the counterexample ----------------------------------------------------------------------------------------------


def end_of_line(n: int, steps: int, by: ControllerParameters) -> float:
    """Distance to the reference [m] after some steps on a line, begun on it; the pose is always `n` steps old."""
    line = Reference(load_scenario(CONFIG, ["error_detector.track=line"]).error_detector).first(steps + 1)
    poses = [line[0, :3]]
    for k in range(steps):
        poses.append(step(poses[k], poses[max(0, k - n)], line[k], by))
    return float(np.hypot(*(line[-1, :2] - poses[-1][:2])))


def test_a_loop_that_diverges_although_every_eigenvalue_is_inside() -> None:
    theta = np.full(1, np.pi / 2)
    values = np.linalg.eigvals(matrices(theta, theta, np.ones(1), ControllerParameters(), TS)[0])
    assert sorted(np.abs(values)) == pytest.approx([0.875, 0.995, 0.995], abs=1e-7)
    assert end_of_line(13, 4000, ControllerParameters()) == pytest.approx(
        2.526e5, rel=1e-3
    )  # p(k+1) = p(k) + T_s [v_r + K_x (r(k) - p(k-13))]
    assert end_of_line(11, 4000, ControllerParameters()) < 0.06  # it settles n T_s v_r = 0.055 m ahead


# -- the table of the docs -------------------------------------------------------------------------------------------


def rows_of_the_docs() -> list[list[str]]:
    page = (Path(CONFIG).parents[1] / "docs/stability.md").read_text()
    table = page[page.index("<!-- acceptance:begin -->") : page.index("<!-- acceptance:end -->")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[3:]]


@pytest.mark.parametrize("track", ["paper", "line", "circle", "eight", "warehouse"])
def test_the_table_of_the_docs(track: str) -> None:
    """What the other columns say is held by the tests of their criteria."""
    reference = Reference(load_scenario(CONFIG, [f"error_detector.track={track}"]).error_detector).first(20_000)
    theta, v, w = reference[:, 2], reference[:, 3], reference[:, 4]
    rows = [row for row in rows_of_the_docs() if row[0] == track]
    others = [["62", "78", "0.97531"], ["12", "14", "0.88235"], ["0", "0", "0.23077"]]
    assert [[row[1], *row[3:6]] for row in rows] == [
        [kx, *row] for kx, row in zip(("5", "25", "250"), others, strict=True)
    ]
    for _, kx, of_paper, *_, p_almost_surely in rows:
        assert largest_n(theta, v, ControllerParameters(kx=float(kx)), TS) == (
            None if of_paper == "all" else int(of_paper)
        )
        if (track, kx) in (("paper", "25"), ("paper", "250"), ("line", "25"), ("line", "250")):
            found = almost_sure.critical_loss(kanayama_loop(v, w, ControllerParameters(kx=float(kx)), TS))
            assert found == pytest.approx(float(p_almost_surely), abs=2e-3)
