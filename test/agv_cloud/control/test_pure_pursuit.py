"""Pure pursuit against the geometry of its circle, and against the lines and circles that it must not leave."""

from __future__ import annotations

import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from agv_cloud.control.command import command, control_law
from agv_cloud.control.pure_pursuit import pure_pursuit
from agv_cloud.control.registry import CONTROL_LAWS
from agv_cloud.tracking_error import tracking_error
from agv_plant.vehicle.unicycle import arc_step
from agv_ros.substitution import replaced

place = st.floats(-5.0, 5.0)
speed = st.floats(-2.0, 2.0)


@given(place, place, st.floats(-3.0, 3.0), st.floats(0.1, 2.0), st.floats(0.01, 2.0), st.floats(0.1, 9.0))
def test_the_way_of_the_command_ends_at_the_point(
    x_e: float, y_e: float, theta_e: float, v_r: float, look_ahead: float, kx: float
) -> None:
    """On the circle of curvature w / v, after the arc whose length made v, be it driven forwards or backwards."""
    assume(math.hypot(x_e, y_e) > 0.1 and abs(x_e) > 1e-6)
    v, w = pure_pursuit(x_e, y_e, theta_e, v_r, 0.7, look_ahead, kx, 0.1)
    arc = (v - v_r) / kx + v_r * look_ahead
    assume(abs(v) > 1e-3)
    x, y, _ = arc_step(0.0, 0.0, 0.0, 1.0, w / v, arc)
    assert (x, y) == pytest.approx((x_e, y_e), abs=1e-7)
    assert math.copysign(1.0, arc) == math.copysign(1.0, x_e)
    assert abs(arc) >= math.hypot(x_e, y_e) * (1.0 - 1e-12)


@given(place, place, st.floats(0.1, 2.0))
def test_the_circle_touches_the_agv_and_meets_the_point(x_e: float, y_e: float, v_r: float) -> None:
    """Its centre is abeam of the AGV, as far from it as from the point."""
    assume(math.hypot(x_e, y_e) > 0.1 and abs(y_e) > 1e-3)
    v, w = pure_pursuit(x_e, y_e, 0.0, v_r, 0.0, 0.5, 2.0, 0.1)
    assume(abs(v) > 1e-3)
    radius = v / w
    assert math.hypot(x_e, y_e - radius) == pytest.approx(abs(radius), rel=1e-9)


@given(st.floats(0.05, 3.0), st.floats(-2.0, 2.0), st.floats(0.05, 1.0), st.floats(0.1, 50.0))
def test_on_a_line_or_a_circle_zero_error_is_an_equilibrium(
    v_r: float, w_r: float, look_ahead: float, kx: float
) -> None:
    """The AGV is where the reference is; the point ahead is as far on the circle as the reference comes meanwhile."""
    assume(v_r * look_ahead > 0.02 and abs(w_r) * look_ahead < 2.5)
    pose = (3.0, -1.0, 0.8)
    error = tracking_error(*arc_step(*pose, v_r, w_r, look_ahead), *pose)
    v, w = pure_pursuit(*error, v_r, w_r, look_ahead, kx, 0.001)
    assert (v, w) == pytest.approx((v_r, w_r), rel=1e-9, abs=1e-9)


def test_who_is_ahead_waits_and_who_is_behind_hurries() -> None:
    assert pure_pursuit(0.5, 0.0, 0.0, 1.0, 0.0, 0.5, 2.0) == (1.0, 0.0)
    assert pure_pursuit(0.4, 0.0, 0.0, 1.0, 0.0, 0.5, 2.0) == pytest.approx((0.8, 0.0))
    assert pure_pursuit(0.7, 0.0, 0.0, 1.0, 0.0, 0.5, 2.0) == pytest.approx((1.4, 0.0))


def test_a_point_behind_is_driven_to_backwards() -> None:
    v, w = pure_pursuit(-1.0, 0.0, 0.0, 1.0, 0.0, 0.5, 2.0)
    assert (v, w) == (-2.0, 0.0)
    v, w = pure_pursuit(-1.0, 0.5, 0.0, 1.0, 0.0, 0.5, 2.0)
    assert v < 0.0
    assert w == pytest.approx(v * 2.0 * 0.5 / 1.25)  # turns the rear towards the point


@pytest.mark.parametrize("share", [0.0, 0.3, 0.999])
def test_a_point_that_is_close_does_not_make_the_circle_tighter_than_at_its_limit(share: float) -> None:
    closest = 0.2
    for angle in (0.2, 1.2, -1.5):
        x_e, y_e = share * closest * math.cos(angle), share * closest * math.sin(angle)
        v, w = pure_pursuit(x_e, y_e, 0.0, 1.0, 0.0, 0.1, 2.0, closest)
        assert abs(w) <= abs(v) * 2.0 / closest
        assert w == pytest.approx(2.0 * v * y_e / closest**2)
        at_limit = pure_pursuit(closest * math.cos(angle), closest * math.sin(angle), 0.0, 1.0, 0.0, 0.1, 2.0, closest)
        within = pure_pursuit(
            0.999999 * closest * math.cos(angle), 0.999999 * closest * math.sin(angle), 0.0, 1.0, 0.0, 0.1, 2.0, closest
        )  # fmt: skip
        assert within == pytest.approx(at_limit, rel=1e-5)


@given(place, place, st.floats(0.1, 2.0))
def test_left_and_right_are_alike(x_e: float, y_e: float, v_r: float) -> None:
    v, w = pure_pursuit(x_e, y_e, 0.3, v_r, 0.0, 0.4)
    assert pure_pursuit(x_e, -y_e, -0.3, v_r, 0.0, 0.4) == (v, -w)


def test_it_is_given_the_look_ahead_of_the_node() -> None:
    law = CONTROL_LAWS.find("pure_pursuit")
    answer = replaced(command, {control_law: law.adapter})
    found = answer(1.0, 0.4, 0.2, 0.8, 0.1, (), (3.0, 0.2), 0.005, 0.6, math.inf)
    assert found == (*pure_pursuit(1.0, 0.4, 0.2, 0.8, 0.1, 0.6, 3.0, 0.2), ())
    assert answer(1.0, 0.4, 0.2, 0.8, 0.1, (), (3.0, 0.2), 0.005, 0.6, 0.5)[0] == 0.5
