"""The AGV's drive and what it does without a command, against closed forms."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agv_plant.actuator import driven_speeds
from agv_plant.downlink_policy import HOLD, RAMP, ZERO, share_of_command

number = st.floats(-1e3, 1e3)


@given(number, number, number, number)
def test_by_default_the_command_is_driven_to_the_last_bit(v: float, w: float, before: float, turn: float) -> None:
    assert driven_speeds(v, w, before, turn, 0.005, math.inf, math.inf, 0.0) == (v, w)


def test_a_lag_is_a_first_order_step_response() -> None:
    v = w = 0.0
    for _ in range(100):
        v, w = driven_speeds(2.0, -3.0, v, w, 0.005, math.inf, math.inf, 0.25)
    assert (v, w) == pytest.approx((2.0 * (1.0 - math.exp(-2.0)), -3.0 * (1.0 - math.exp(-2.0))), rel=1e-12)


def test_a_limited_acceleration_is_a_straight_ramp() -> None:
    v = w = 0.0
    for _ in range(100):
        v, w = driven_speeds(-9.0, 5.0, v, w, 0.01, 1.5, 2.0, 0.0)
    assert (v, w) == pytest.approx((-2.0, 1.5), rel=1e-12)


@pytest.mark.parametrize("policy", [HOLD, ZERO, RAMP])
def test_a_command_of_now_is_obeyed_wholly(policy: int) -> None:
    assert share_of_command(0, policy, 4.0) == 1.0


def test_without_a_command_the_agv_goes_on_stands_or_slows_down() -> None:
    ages = (1, 2, 4, 9)
    assert [share_of_command(n, HOLD, 4.0) for n in ages] == [1.0, 1.0, 1.0, 1.0]
    assert [share_of_command(n, ZERO, 4.0) for n in ages] == [0.0, 0.0, 0.0, 0.0]
    assert [share_of_command(n, RAMP, 4.0) for n in ages] == [0.75, 0.5, 0.0, 0.0]
