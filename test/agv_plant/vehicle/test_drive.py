"""The AGV's drive and what it does without a command, against closed forms."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agv_plant.downlink_policy import HOLD, RAMP, ZERO, share_of_command
from agv_plant.vehicle.drive import driven_speeds

number = st.floats(-1e3, 1e3)


def driven(
    v: float, w: float, steps: int, dt: float, w_max: float = math.inf, a_max: float = math.inf,
    j_max: float = math.inf, lag: float = 0.0,
) -> Iterator[tuple[float, float, float]]:  # fmt: skip
    """Speeds and acceleration, from rest and under one command."""
    now = (0.0, 0.0, 0.0)
    for _ in range(steps):
        now = driven_speeds(v, w, *now, dt, w_max, a_max, j_max, lag)
        yield now


@given(number, number, number, number, number)
def test_by_default_the_command_is_driven_to_the_last_bit(
    v: float, w: float, before: float, turn: float, a: float
) -> None:
    assert driven_speeds(v, w, before, turn, a, 0.005, math.inf, math.inf, math.inf, 0.0)[:2] == (v, w)


def test_a_lag_is_a_first_order_step_response() -> None:
    *_, (v, w, _) = driven(2.0, -3.0, 100, 0.005, lag=0.25)
    assert (v, w) == pytest.approx((2.0 * (1.0 - math.exp(-2.0)), -3.0 * (1.0 - math.exp(-2.0))), rel=1e-12)


def test_a_limited_acceleration_is_a_straight_ramp() -> None:
    *_, (v, w, a) = driven(-9.0, 5.0, 100, 0.01, w_max=1.5, a_max=2.0)
    assert (v, w, a) == pytest.approx((-2.0, 1.5, -2.0), rel=1e-12)


# -- jerk --------------------------------------------------------------------------------------------------------------


def double_s(v: float, a_max: float, j_max: float) -> tuple[float, float, float]:
    """Time [s] and way [m] from rest to speed v in the least time, and the largest acceleration [m/s^2] on the way.

    Biagiotti and Melchiorri, Trajectory Planning for Automatic Machines and Robots, 2008, eq. 3.30 ff.: the
    acceleration is a trapezium, or a triangle if a_max is not reached; symmetric, so the mean speed is v / 2.
    """
    time = 2.0 * math.sqrt(v / j_max) if v * j_max < a_max**2 else v / a_max + a_max / j_max
    return time, 0.5 * v * time, min(a_max, math.sqrt(v * j_max))


@pytest.mark.parametrize("a_max", [math.inf, 2.0], ids=["triangle", "trapezium"])
def test_a_limited_jerk_is_the_double_s_profile(a_max: float) -> None:
    dt, v, j_max = 1e-4, 3.0, 4.0
    time, way, peak = double_s(v, a_max, j_max)
    run = list(driven(v, 0.0, round(1.2 * time / dt), dt, a_max=a_max, j_max=j_max))
    arrival = next(i for i, (speed, _, _) in enumerate(run) if speed > v - 1e-9)
    assert arrival * dt == pytest.approx(time, abs=2.0 * dt)
    assert max(a for _, _, a in run) == pytest.approx(peak, abs=j_max * dt)
    assert dt * sum(speed for speed, _, _ in run[:arrival]) == pytest.approx(way, abs=2.0 * v * dt)


@given(
    st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=5), st.floats(0.1, 20.0), st.floats(0.1, 200.0),
    st.sampled_from([0.0, 0.1]), st.floats(1e-3, 0.05),
)  # fmt: skip
def test_limits_hold_whatever_is_commanded_and_a_constant_command_is_not_passed(
    commands: list[float], a_max: float, j_max: float, lag: float, dt: float
) -> None:
    v = w = a = 0.0
    for command in commands:
        for _ in range(20):
            before, (v, w, a) = a, driven_speeds(command, 0.0, v, w, a, dt, math.inf, a_max, j_max, lag)
            assert abs(a) <= a_max * (1.0 + 1e-12)
            assert abs(a - before) <= j_max * dt * (1.0 + 1e-9)
    from_rest = [speed for speed, _, _ in driven(commands[0], 0.0, 500, dt, a_max=a_max, j_max=j_max, lag=lag)]
    assert max(map(abs, from_rest)) <= abs(commands[0]) + 1e-9
    assert all(abs(after) > abs(before) - 1e-9 for before, after in itertools.pairwise(from_rest))


# -- without a command -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", [HOLD, ZERO, RAMP])
def test_a_command_of_now_is_obeyed_wholly(policy: int) -> None:
    assert share_of_command(0, policy, 4.0) == 1.0


def test_without_a_command_the_agv_goes_on_stands_or_slows_down() -> None:
    ages = (1, 2, 4, 9)
    assert [share_of_command(n, HOLD, 4.0) for n in ages] == [1.0, 1.0, 1.0, 1.0]
    assert [share_of_command(n, ZERO, 4.0) for n in ages] == [0.0, 0.0, 0.0, 0.0]
    assert [share_of_command(n, RAMP, 4.0) for n in ages] == [0.75, 0.5, 0.0, 0.0]
