"""The derived linear loop against closed forms, and against loops written here and differentiated by differences."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import fsolve

from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.simulation.reference import reference_of
from agv_analysis.stability.derived_loop import derived_loop, linear_loop
from agv_analysis.stability.error_dynamics import NoNominalMotionError, derivatives_of_part
from agv_analysis.stability.linear_loop import LinearLoop
from agv_ros.parts import PartError

PAPER = str(Path(__file__).parents[3] / "config" / "paper.yaml")
TS = 0.005


def scenario_of(*settings: str) -> Scenario:
    return load_scenario(PAPER, settings)


def speeds(scenario: Scenario, steps: int = 20_000) -> tuple[Floats, Floats]:
    ahead = scenario.error_detector.steps_ahead
    reference = reference_of(scenario.error_detector, steps + ahead)[ahead:]
    return reference[:, 3], reference[:, 4]


def loop_of(*settings: str) -> LinearLoop:
    scenario = scenario_of(*settings)
    return derived_loop(scenario, *speeds(scenario))


# -- the paper's loop ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", ["hold", "align", "predict"])
@pytest.mark.parametrize("track", ["paper", "line", "circle", "eight", "warehouse"])
def test_for_the_paper_s_loop_the_derivatives_are_those_of_the_theory(track: str, policy: str) -> None:
    """F = R(-phi) [[1,0,0],[0,1,T_s v],[0,0,1]], G = -T_s R(-phi) [[K_x,0,0],[0,0,0],[0,v K_y,v K_theta]]."""
    scenario = scenario_of(f"error_detector.track={track}", f"error_detector.policy={policy}", "controller.kx=31.0")
    v, w = speeds(scenario)
    found = derived_loop(scenario, v, w)
    v, w = (v[:1], w[:1]) if len(found.F) == 1 else (v, w)
    kx, ky, ktheta = 31.0, 1.0, 2.0
    cos, sin, zero, one = np.cos(TS * w), np.sin(TS * w), np.zeros(len(v)), np.ones(len(v))
    R = np.moveaxis(np.array([[cos, sin, zero], [-sin, cos, zero], [zero, zero, one]]), 2, 0)
    moved = np.moveaxis(np.array([[one, zero, zero], [zero, one, TS * v], [zero, zero, one]]), 2, 0)
    fed = np.moveaxis(np.array([[kx * one, zero, zero], [zero, zero, zero], [zero, v * ky, v * ktheta]]), 2, 0)
    np.testing.assert_allclose(found.F, R @ moved, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found.G, -TS * R @ fed, rtol=0.0, atol=1e-12)
    if policy == "predict":
        assert found.H is not None
        np.testing.assert_allclose(found.H, found.F + found.G, rtol=0.0, atol=1e-12)
        assert found.is_exact
    else:
        assert found.H is None
    assert found.active_limits == found.not_differentiable == ()


def test_the_closed_form_is_taken_where_it_holds_and_nowhere_else() -> None:
    scenario = scenario_of()
    assert linear_loop(scenario, *speeds(scenario)).closed_form is not None
    for setting in (
        "plant.speed_scale=1.1", "plant.lag=0.1", "controller.v_max=1.2", "plant.integration=arc", "plant.slip=0.1",
        "controller.law=state_feedback", "plant.vehicle=bicycle", "plant.a_max=1.0", "plant.substeps=2",
    ):  # fmt: skip
        other = scenario_of(setting)
        assert linear_loop(other, *speeds(other)).closed_form is None, setting


# -- loops written anew ----------------------------------------------------------------------------------------------

Step = Callable[[Any, Any, float, float], list[float]]
"""(z, h, v_r, w_r) -> z a step later: state, error that the edge takes for the current one, reference's speeds."""


def error_after(z: Sequence[float], v: float, w: float, heading: float, v_r: float, w_r: float) -> list[float]:
    """The error by Euler's step, the AGV moving into the direction `heading` from its own, in complex numbers."""
    place = TS * v * complex(math.cos(heading), math.sin(heading))
    reference = complex(z[0], z[1]) + TS * v_r * complex(math.cos(z[2]), math.sin(z[2]))
    e = (reference - place) * complex(math.cos(-TS * w), math.sin(-TS * w))
    return [e.real, e.imag, z[2] + TS * (w_r - w)]


def kanayama_command(h: Sequence[float], v_r: float, w_r: float, gains: tuple[float, float, float]) -> list[float]:
    kx, ky, ktheta = gains
    return [v_r * math.cos(h[2]) + kx * h[0], w_r + v_r * (ky * h[1] + ktheta * math.sin(h[2]))]


def lagging(z: Sequence[float], h: Sequence[float], v_r: float, w_r: float) -> list[float]:
    """First-order lag of 0.1 s on both speeds, the true speed 1.2 times that of the drive; z = (e, v, w)."""
    v, w = kanayama_command(h, v_r, w_r, (25.0, 1.0, 2.0))
    left = math.exp(-TS / 0.1)
    v, w = (1.0 - left) * v + left * z[3], (1.0 - left) * w + left * z[4]
    return [*error_after(z, 1.2 * v, w, 0.0, v_r, w_r), v, w]


def steering(z: Sequence[float], h: Sequence[float], v_r: float, w_r: float) -> list[float]:
    """A bicycle of 0.8 m whose steering lags by 0.05 s, under linear state feedback; z = (e, steering angle)."""
    v, w = v_r + 2.0 * h[0], w_r + 1.5 * h[1] + 2.5 * h[2]
    left = math.exp(-TS / 0.05)
    angle = (1.0 - left) * math.atan(0.8 * w / v) + left * z[3]
    return [*error_after(z, v, v * math.tan(angle) / 0.8, 0.0, v_r, w_r), angle]


def slipping(z: Sequence[float], h: Sequence[float], v_r: float, w_r: float) -> list[float]:
    """Wheels that slip by 10 % and an AGV that skids by 0.05 s^2/m; z = e."""
    v, w = kanayama_command(h, v_r, w_r, (5.0, 3.0, 4.0))
    v, w = 0.9 * v, 0.9 * w
    return error_after(z, v, w, -0.05 * v * w, v_r, w_r)


LOOPS: dict[str, tuple[Step, int, tuple[str, ...]]] = {
    "lag and speed scale": (lagging, 5, ("plant.lag=0.1", "plant.speed_scale=1.2")),
    "bicycle and state feedback": (
        steering, 4,
        ("plant.vehicle=bicycle", "plant.bicycle.wheelbase=0.8", "plant.bicycle.steering_lag=0.05",
         "controller.law=state_feedback", "controller.state_feedback.kx=2.0", "controller.state_feedback.ky=1.5",
         "controller.state_feedback.ktheta=2.5"),
    ),
    "slip and skid": (
        slipping, 3,
        ("plant.slip=0.1", "plant.skid=0.05", "controller.kx=5.0", "controller.ky=3.0", "controller.ktheta=4.0"),
    ),
}  # fmt: skip


def differences(step: Step, z: Floats, v_r: float, w_r: float) -> tuple[Floats, Floats]:
    """F and G at a state, by central differences."""
    size, reach = len(z), 1e-6
    F, G = np.zeros((size, size)), np.zeros((size, 3))
    for i in range(size):
        moved = reach * np.eye(size)[i]
        F[:, i] = np.subtract(step(z + moved, z[:3], v_r, w_r), step(z - moved, z[:3], v_r, w_r)) / (2.0 * reach)
    for i in range(3):
        moved = reach * np.eye(3)[i]
        G[:, i] = np.subtract(step(z, z[:3] + moved, v_r, w_r), step(z, z[:3] - moved, v_r, w_r)) / (2.0 * reach)
    return F, G


@pytest.mark.parametrize("name", LOOPS)
def test_at_constant_speeds_the_fixed_point_and_the_derivatives_there(name: str) -> None:
    step, size, settings = LOOPS[name]
    found = loop_of("error_detector.track=circle", *settings)
    v_r, w_r = float(found.v_r[0]), float(found.w_r[0])
    guess = [0.0] * 3 + [v_r, w_r][: size - 3]
    z = fsolve(lambda z: np.subtract(step(z, z[:3], v_r, w_r), z), guess, xtol=1e-13)
    assert found.nominal is not None
    assert found.nominal[0, :3] == pytest.approx(z[:3], abs=1e-9)
    assert found.size == size
    F, G = differences(step, z, v_r, w_r)
    np.testing.assert_allclose(found.F[0], F, rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(found.G[0], G, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("name", LOOPS)
@pytest.mark.parametrize("track", ["paper", "eight"])
def test_over_a_lap_the_nominal_motion_and_the_derivatives_along_it(name: str, track: str) -> None:
    """The motion by driving laps until they repeat."""
    step, size, settings = LOOPS[name]
    found = loop_of(f"error_detector.track={track}", *settings)
    assert found.nominal is not None
    v_r, w_r = found.v_r.tolist(), found.w_r.tolist()
    z: Any = [0.0] * 3 + [v_r[-1], w_r[-1]][: size - 3]
    for _ in range(2):
        states = []
        for k in range(found.steps):
            states.append(z)
            z = step(z, z[:3], v_r[k], w_r[k])
    np.testing.assert_allclose(found.nominal[:, :3], np.array(states)[:, :3], rtol=0.0, atol=1e-9)
    for k in range(0, found.steps, 1237):
        F, G = differences(step, np.array(states[k]), v_r[k], w_r[k])
        np.testing.assert_allclose(found.F[k], F, rtol=0.0, atol=1e-7)
        np.testing.assert_allclose(found.G[k], G, rtol=0.0, atol=1e-7)


def test_a_wrong_speed_moves_the_fixed_point_and_the_gain_of_the_heading() -> None:
    """x_e = -delta v / ((1 + delta) K_x), and the heading's gain becomes K_theta + K_y x_e."""
    found = loop_of(
        "error_detector.track=line", "plant.speed_scale=1.3", "controller.kx=1.0", "controller.ky=64.0",
        "controller.ktheta=16.0", "error_detector.speed=2.0",
    )  # fmt: skip
    assert found.nominal is not None
    x_e = -0.3 * 2.0 / 1.3
    assert found.nominal[0, :3] == pytest.approx((x_e, 0.0, 0.0), abs=1e-10)
    # Heading and side of the AGV under the command about the fixed point, written out by hand.
    v, true = 2.0, 2.0
    across = np.array([
        [1.0 - TS * x_e * v * -64.0 * -1.0, TS * v - TS * x_e * -v * 16.0 * -1.0],
        [-TS * v * 64.0, 1.0 - TS * v * 16.0],
    ])  # fmt: skip
    assert true == v
    np.testing.assert_allclose((found.F + found.G)[0][1:, 1:], across, rtol=0.0, atol=1e-9)
    assert np.abs(np.linalg.eigvals(across)).max() > 1.0


def test_a_look_ahead_is_the_reference_of_later() -> None:
    """On a line pure pursuit sees the point 0.5 m ahead: v = v_r + k (s - v_r tau), w = 2 v y / d^2, all by hand."""
    found = loop_of(
        "error_detector.track=line", "controller.law=pure_pursuit", "controller.look_ahead=0.5",
        "controller.pure_pursuit.kx=3.0",
    )  # fmt: skip
    assert found.nominal is not None
    assert found.nominal[0, :3] == pytest.approx((0.5, 0.0, 0.0), abs=1e-12)
    # At (0.5, 0, 0): dv = k dx, dw = 2 v dy / d^2 = 8 dy. The error moves by F = [[1,0,0],[0,1,T_s],[0,0,1]] and by
    # -T_s (dv along, the turn about the AGV moves the point ahead by -x_e dw to the side, -dw of heading).
    G = -TS * np.array([[3.0, 0.0, 0.0], [0.0, 0.5 * 8.0, 0.0], [0.0, 8.0, 0.0]])
    np.testing.assert_allclose(found.F[0], [[1.0, 0.0, 0.0], [0.0, 1.0, TS], [0.0, 0.0, 1.0]], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found.G[0], G, rtol=0.0, atol=1e-10)


# -- no such motion --------------------------------------------------------------------------------------------------


def test_an_agv_that_is_slower_than_its_reference_has_no_nominal_motion() -> None:
    with pytest.raises(NoNominalMotionError, match=r"falls behind its reference by 0\.2 m/s forever"):
        loop_of("error_detector.track=line", "controller.v_max=0.8")


def test_on_a_closed_track_it_cuts_corners_and_the_limit_is_named() -> None:
    found = loop_of("error_detector.track=paper", "controller.v_max=1.2")
    (limit,) = found.active_limits
    assert limit.startswith("the limit controller.v_max = 1.2 is active at ")
    assert "of 20000 steps of the lap, first at step 1" in limit


def test_the_parked_and_the_unreachable_are_left_out() -> None:
    parked = loop_of("error_detector.track=line", "error_detector.speed=1e-300", "plant.lag=0.2")
    assert parked.size == 5  # any speed at all reaches all of the error
    warehouse = loop_of("error_detector.track=warehouse", "plant.lag=0.2")
    assert (warehouse.size, warehouse.outputs) == (5, 3)


@pytest.mark.parametrize("ky", [0.1, 0.01])
def test_a_slow_loop_that_begins_elsewhere_than_it_settles_has_its_nominal_motion(ky: float) -> None:
    """The bicycle's steering starts straight, on a circle: the error grows at first, and takes minutes to die out."""
    scenario = scenario_of(
        "error_detector.track=circle", "plant.vehicle=bicycle", "plant.bicycle.steering_lag=0.1",
        f"controller.ky={ky}", "plant.duration=400.0", "plant.initial_pose=[0.0, 0.0, 1.5707963267948966]",
    )  # fmt: skip
    found = derived_loop(scenario, *speeds(scenario, 20_000))
    assert found.nominal is not None
    np.testing.assert_allclose(found.nominal[:, :3], 0.0, rtol=0.0, atol=1e-9)
    run = simulate(scenario)
    distance = np.hypot(*(run.reference[:, :2] - run.pose[:, :2]).T)
    assert distance[-1] < 0.5 * distance[:4000].max()


def test_a_law_that_cannot_be_differentiated_is_refused_by_name() -> None:
    def through_text(x_e: float, y_e: float, theta_e: float, v_r: float, w_r: float) -> tuple[float, float]:
        return float(str(v_r + x_e)), w_r + y_e + 2.0 * theta_e

    with pytest.raises(PartError, match="control law through_text cannot be differentiated"):
        derivatives_of_part("control law through_text", through_text, [np.zeros(1)] * 5, [0, 1, 2])
