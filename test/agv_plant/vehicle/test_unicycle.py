"""The plant against other ways to integrate a unicycle."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from agv_plant.vehicle.unicycle import STEPS, arc_step, euler_step

Step = Callable[[float, float, float, float, float, float], tuple[float, float, float]]

place = st.floats(-100.0, 100.0)
angle = st.floats(-50.0, 50.0)
v = st.floats(-30.0, 30.0)
w = st.floats(-20.0, 20.0)
period = st.floats(1e-6, 0.2)


@settings(deadline=None, derandomize=True)
@given(place, place, angle, v, w, period)
def test_euler_is_the_matrix_form_of_the_paper(x: float, y: float, theta: float, v: float, w: float, ts: float) -> None:
    # Equations 14 and 15: X(k+1) = X(k) + T_s J(k) u(k).
    J = np.array([[np.cos(theta), 0.0], [np.sin(theta), 0.0], [0.0, 1.0]])
    expected = np.array([x, y, theta]) + ts * (J @ np.array([v, w]))
    assert euler_step(x, y, theta, v, w, ts) == pytest.approx(tuple(expected), rel=1e-14, abs=1e-13)


@pytest.mark.parametrize(
    ("v", "w", "ts"),
    [
        (1.0, 0.5, 2.0),
        (-3.0, 4.0, 1.0),
        (6.0, -20.0, 0.5),
        (2.0, 0.0, 3.0),
        (0.0, 3.0, 1.0),
        (1.0, 1e-9, 1.0),
        (25.0, 1e-4, 1.9),
    ],
)
def test_the_arc_is_the_solution_of_the_differential_equation(v: float, w: float, ts: float) -> None:
    x0 = (3.0, -2.0, 0.7)
    solution = solve_ivp(
        lambda _, X: (v * math.cos(X[2]), v * math.sin(X[2]), w), (0.0, ts), x0, method="DOP853", rtol=1e-13, atol=1e-13
    )
    assert arc_step(*x0, v, w, ts) == pytest.approx(tuple(solution.y[:, -1]), abs=1e-11)


@settings(deadline=None, derandomize=True)
@given(place, place, angle, v, w, period, st.integers(1, 20))
def test_an_arc_in_parts_is_the_arc(
    x: float, y: float, theta: float, v: float, w: float, ts: float, parts: int
) -> None:
    posture = (x, y, theta)
    for _ in range(parts):
        posture = arc_step(*posture, v, w, ts / parts)
    assert posture == pytest.approx(arc_step(x, y, theta, v, w, ts), abs=1e-10)


@settings(deadline=None, derandomize=True)
@given(angle, v, w.filter(lambda w: abs(w) > 1e-3), period)
def test_an_arc_stays_on_its_circle(theta: float, v: float, w: float, ts: float) -> None:
    radius = v / w
    center = (-radius * math.sin(theta), radius * math.cos(theta))
    x, y, heading = arc_step(0.0, 0.0, theta, v, w, ts)
    assert math.hypot(x - center[0], y - center[1]) == pytest.approx(abs(radius), rel=1e-9)
    assert heading - theta == pytest.approx(w * ts, abs=1e-12)


@pytest.mark.parametrize("w", [0.0, 1e-300, 1e-12, 1.999e-4, 2e-4, 2.001e-4, 1e-3])
def test_the_arc_has_no_seam_where_it_becomes_straight(w: float) -> None:
    # sin(h)/h in decimals: 1 - h^2/6 + h^4/120.
    h = 0.5 * w
    chord = 1.0 - h * h / 6.0 + h**4 / 120.0
    x, y, _ = arc_step(0.0, 0.0, 0.0, 1.0, w, 1.0)
    assert math.hypot(x, y) == pytest.approx(chord, abs=1e-15)


@pytest.mark.parametrize("name", STEPS)
def test_a_full_circle_comes_back(name: str) -> None:
    step, steps = STEPS[name], 1000
    posture = (1.0, 2.0, 0.3)
    for _ in range(steps):
        posture = step(*posture, 2.0, 2.0 * math.pi / 10.0, 10.0 / steps)
    assert posture == pytest.approx((1.0, 2.0, 0.3 + 2.0 * math.pi), abs=1e-11)


def test_euler_approaches_the_arc_with_the_first_order() -> None:
    def distance(steps: int) -> float:
        posture = (0.0, 0.0, 0.0)
        for _ in range(steps):
            posture = euler_step(*posture, 1.0, 1.0, 1.0 / steps)
        exact = (math.sin(1.0), 1.0 - math.cos(1.0))
        return math.dist(posture[:2], exact)

    assert distance(1000) / distance(2000) == pytest.approx(2.0, rel=0.01)


@pytest.mark.parametrize("step", STEPS.values(), ids=STEPS)
def test_the_angle_counts_turns(step: Step) -> None:
    assert step(0.0, 0.0, 7.0 * math.pi, 0.0, 1.0, 0.5)[2] == 7.0 * math.pi + 0.5
    assert step(1.5, -2.5, 0.1, 0.0, 0.0, 0.005) == (1.5, -2.5, 0.1)
