"""The bicycle against the circle that it drives, the continuous model, and how others obey a command."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from agv_plant.parameters import PlantParameters
from agv_plant.vehicle.bicycle import bicycle, steering_angle
from agv_plant.vehicle.motion import Motion, move, vehicle_parameters, vehicle_step
from agv_plant.vehicle.registry import VEHICLES
from agv_plant.vehicle.unicycle import unicycle
from agv_ros.substitution import replaced

BICYCLE = VEHICLES.find("bicycle")
MOVE = replaced(move, {vehicle_step: BICYCLE.adapter})


def driven(
    plant: PlantParameters, v: float, w: float, steps: int, begin: Motion | None = None
) -> Motion:  # fmt: skip
    """An AGV after so many periods under one command, from the origin."""
    motion = begin or Motion(0.0, 0.0, 0.0, states=(0.0,))
    for _ in range(steps):
        motion = MOVE(motion, v, w, 0.0, 0.0, vehicle_parameters(plant))
    return motion


def plant_of(**bicycle_parameters: float) -> PlantParameters:
    """A plant with a bicycle that is integrated along arcs."""
    from agv_ros.parameters import build

    own = {f"bicycle.{name}": value for name, value in bicycle_parameters.items() if name in DEFAULTS}
    others = {name: value for name, value in bicycle_parameters.items() if name not in DEFAULTS}
    return build(PlantParameters, {"vehicle": "bicycle", "integration": "arc", **own, **others})


DEFAULTS = {known.name: known.default for known in BICYCLE.parameters}


# -- circles -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("v", [2.0, -2.0])
@pytest.mark.parametrize("angle", [0.05, -0.3, 0.6])
def test_a_constant_angle_is_a_circle_of_radius_wheelbase_over_its_tangent(v: float, angle: float) -> None:
    """Seen from the centre of that circle: always at its radius, and all the way round in the time that it takes."""
    wheelbase = 1.7
    radius = wheelbase / math.tan(angle)
    plant = plant_of(wheelbase=wheelbase, ts=0.01)
    period = 2.0 * math.pi * abs(radius) / abs(v)
    for share in (0.1, 0.37, 0.9):
        motion = driven(plant, v, v / radius, round(share * period / plant.ts))
        assert math.hypot(motion.x, motion.y - radius) == pytest.approx(abs(radius), rel=1e-12)
        assert motion.theta == pytest.approx(round(share * period / plant.ts) * plant.ts * v / radius, rel=1e-12)
        assert motion.states[0] == pytest.approx(angle, rel=1e-12)


@given(st.floats(-3.0, 3.0), st.floats(-5.0, 5.0), st.floats(0.2, 3.0), st.booleans())
def test_within_its_limits_and_at_once_it_goes_where_a_unicycle_goes(
    v: float, w: float, wheelbase: float, arc: bool
) -> None:
    if abs(steering_angle(v, w, wheelbase)) > 1.4 or v == 0.0:
        return
    expected = unicycle(1.0, -2.0, 0.5, v, w, 0.01, arc)
    found = bicycle(1.0, -2.0, 0.5, 0.0, v, w, 0.01, arc, v, w, wheelbase, 1.5)
    assert found[:3] == pytest.approx(expected, rel=1e-9, abs=1e-12)


# -- the angle that a command asks for ---------------------------------------------------------------------------------


@pytest.mark.parametrize("v", [1.5, 0.2, -0.7])
@pytest.mark.parametrize("w", [0.0, 0.4, -2.0])
def test_the_angle_is_that_of_ros2_controllers(v: float, w: float) -> None:
    """Of its steering_controllers_library: convert_twist_to_steering_angle, atan(omega wheelbase / v), 0 if NaN."""
    assert steering_angle(v, w, 1.3) == math.atan(w * 1.3 / v)


def test_standing_still_it_steers_as_far_as_it_goes_and_does_not_turn() -> None:
    """Their turn in place is +-pi/2, too; nobody turns without moving."""
    assert steering_angle(0.0, 0.0, 1.0) == 0.0
    assert steering_angle(0.0, 1e-9, 1.0) == math.pi / 2.0
    assert steering_angle(0.0, -3.0, 1.0) == -math.pi / 2.0
    for w, angle in ((2.0, 0.7), (-2.0, -0.7)):
        motion = driven(plant_of(), 0.0, w, 50)
        assert motion[:3] == (0.0, 0.0, 0.0)
        assert motion.states == (angle,)


def test_beyond_its_largest_angle_it_drives_its_tightest_circle() -> None:
    plant = plant_of(max_steering_angle=0.4, wheelbase=1.2, ts=0.01)
    motion, radius = driven(plant, 1.0, 9.0, 200), 1.2 / math.tan(0.4)
    assert motion.theta == pytest.approx(2.0 / radius, rel=1e-12)
    assert math.hypot(motion.x, motion.y - radius) == pytest.approx(radius, rel=1e-12)
    backwards = driven(plant, -1.0, 9.0, 200)
    assert backwards.theta == pytest.approx(2.0 / radius, rel=1e-12)
    assert backwards.states == (-0.4,)


# -- steering that takes its time --------------------------------------------------------------------------------------


def continuous(v: float, wanted: float, wheelbase: float, lag: float, rate: float, time: float) -> list[float]:
    """x, y, theta and steering angle of the kinematic bicycle in continuous time, integrated by Runge-Kutta 8(5,3).

    d(steering)/dt = (wanted - steering) / lag, limited to +-rate; without lag the steering goes at the limited rate.
    """

    def slope(_: float, state: list[float]) -> list[float]:
        _, _, theta, steering = state
        missing = wanted - steering
        change = missing / lag if lag > 0.0 else math.copysign(rate, missing) if abs(missing) > 1e-12 else 0.0
        change = min(max(change, -rate), rate)
        return [v * math.cos(theta), v * math.sin(theta), v * math.tan(steering) / wheelbase, change]

    ends, state = [time], [0.0, 0.0, 0.0, 0.0]
    if lag == 0.0 and abs(wanted) / rate < time:  # the slope jumps where the angle is reached
        ends = [abs(wanted) / rate, time]
    begin = 0.0
    for end in ends:
        solved = solve_ivp(slope, (begin, end), state, method="DOP853", rtol=1e-12, atol=1e-13, max_step=0.01)
        state, begin = solved.y[:, -1].tolist(), end
    return state


@pytest.mark.parametrize(
    ("lag", "rate"), [(0.3, math.inf), (0.0, 0.8), (0.3, 0.8)], ids=["lag", "rate", "lag and rate"]
)
def test_with_many_substeps_it_is_the_continuous_bicycle_to_first_order(lag: float, rate: float) -> None:
    v, wanted, wheelbase, time = 1.5, 0.5, 1.1, 1.2
    truth = continuous(v, wanted, wheelbase, lag, rate, time)
    errors = []
    for substeps in (8, 16, 32, 64):
        plant = plant_of(
            wheelbase=wheelbase, steering_lag=lag, steering_rate=rate, ts=0.05, substeps=substeps,
        )  # fmt: skip
        motion = driven(plant, v, v * math.tan(wanted) / wheelbase, round(time / plant.ts))
        errors.append(np.abs(np.array([*motion[:3], *motion.states]) - truth).max())
    assert errors[-1] < 2e-3
    ratios = np.array(errors[:-1]) / errors[1:]
    assert ratios == pytest.approx(2.0, rel=0.15)


def test_a_lag_alone_is_exact_in_the_steering_angle() -> None:
    motion = driven(plant_of(steering_lag=0.25, ts=0.01), 2.0, 1.0, 100)
    assert motion.states[0] == pytest.approx(math.atan(0.5) * (1.0 - math.exp(-4.0)), rel=1e-12)


def test_a_limited_rate_is_a_straight_ramp_up_to_the_angle() -> None:
    plant = plant_of(steering_rate=0.5, ts=0.01)
    assert driven(plant, 2.0, 1.0, 40).states[0] == pytest.approx(0.2, rel=1e-12)
    assert driven(plant, 2.0, 1.0, 200).states[0] == pytest.approx(math.atan(0.5), rel=1e-12)
    turned = driven(plant, 2.0, -1.0, 40, Motion(0.0, 0.0, 0.0, states=(0.3,)))
    assert turned.states[0] == pytest.approx(0.1, rel=1e-12)


# -- with the rest of the plant ----------------------------------------------------------------------------------------


def test_where_both_wheels_slip_alike_it_is_slower_on_the_same_circle() -> None:
    """The steering answers to the drive's speeds, and the way is that over the ground: the radius stays."""
    dry, wet = plant_of(ts=0.01), plant_of(ts=0.01, slip=0.2)
    radius = 2.0 / 0.5
    fast, slow = driven(dry, 2.0, 0.5, 80), driven(wet, 2.0, 0.5, 100)
    assert slow[:3] == pytest.approx(fast[:3], rel=1e-12)
    assert math.hypot(slow.x, slow.y - radius) == pytest.approx(radius, rel=1e-12)


def test_a_wrong_speed_scale_leaves_the_circle_and_changes_the_time() -> None:
    scaled = driven(plant_of(ts=0.01, speed_scale=1.25), 2.0, 0.5, 80)
    assert scaled[:3] == pytest.approx(driven(plant_of(ts=0.01), 2.0, 0.5, 100)[:3], rel=1e-12)


def test_it_skids_by_the_yaw_rate_that_it_has_and_not_by_the_one_that_was_asked_for() -> None:
    """With saturated steering: beta = -skid v w with the true w; the speed along the way is unchanged."""
    skid, v, dt = 0.05, 2.0, 0.01
    plant = plant_of(ts=dt, skid=skid, max_steering_angle=0.3)
    motion, rate = driven(plant, v, 50.0, 1), v * math.tan(0.3)
    beta = -skid * v * rate
    assert motion.theta == pytest.approx(rate * dt, rel=1e-12)
    assert math.atan2(motion.y, motion.x) == pytest.approx(beta + 0.5 * rate * dt, rel=1e-12)
    straight = driven(plant_of(ts=dt, max_steering_angle=0.3), v, 50.0, 1)
    assert math.hypot(motion.x, motion.y) == pytest.approx(math.hypot(straight.x, straight.y), rel=1e-12)
