"""The AGV's motion in one sampling period: drive, wheels, vehicle, ground, and the measured pose."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from agv_plant.vehicle.drive import driven_speeds
from agv_plant.vehicle.slip import over_ground, side_slip
from agv_plant.vehicle.unicycle import unicycle

if TYPE_CHECKING:
    from agv_plant.parameters import PlantParameters

NOISE, SLIP = "plant/noise", "plant/slip"
"""Random streams: of step k the numbers 0, 1, 2 for x, y, theta; 0, 1 for the left and the right wheel."""

States = tuple[float, ...]
"""States of a vehicle beyond its pose."""


class VehicleParameters(NamedTuple):
    """Parameters of an AGV's motion; the fields are those of its plant."""

    arc: bool
    """Are poses integrated along the arc, or by Euler's step?"""
    ts: float
    substeps: int
    speed_scale: float
    w_max: float
    a_max: float
    j_max: float
    lag: float
    slip: float
    slip_noise: float
    track_width: float
    skid: float
    parameters: tuple[float, ...] = ()
    """Those of the vehicle itself, in the order of its signature."""


class Motion(NamedTuple):
    """Pose in frame `map` [m, m, rad], what the drive did last, and the vehicle's further states."""

    x: float
    y: float
    theta: float
    v: float = 0.0
    """Speeds of the drive [m/s, rad/s]."""
    w: float = 0.0
    a: float = 0.0
    """Its acceleration [m/s^2]."""
    states: States = ()


def vehicle_parameters(plant: PlantParameters) -> VehicleParameters:
    """The AGV that parameters describe."""
    others = {name: getattr(plant, name) for name in VehicleParameters._fields if name not in ("arc", "parameters")}
    return VehicleParameters(arc=plant.integration == "arc", parameters=plant.vehicle_values, **others)


def vehicle_step(
    x: float, y: float, theta: float, states: States, v: float, w: float, v_driven: float, w_driven: float, dt: float,
    arc: bool, parameters: tuple[float, ...],
) -> tuple[float, float, float, States]:  # fmt: skip
    """The vehicle of a loop as the loop calls it: pose and further states a time `dt` [s] later, see `registry`.

    By default a unicycle; another vehicle that is chosen replaces it.
    """
    x, y, theta = unicycle(x, y, theta, v, w, dt, arc)
    return x, y, theta, states


def move(motion: Motion, v: float, w: float, n_left: float, n_right: float, vehicle: VehicleParameters) -> Motion:
    """The motion a period later, under the command (v, w) [m/s, rad/s] and with these normal numbers for the wheels.

    The period is taken in `substeps` equal parts, each with the speeds that the drive has reached by then.
    """
    x, y, theta, v_driven, w_driven, a, states = motion
    dt = vehicle.ts / vehicle.substeps
    s_left, s_right = vehicle.slip + vehicle.slip_noise * n_left, vehicle.slip + vehicle.slip_noise * n_right
    for _ in range(vehicle.substeps):
        v_driven, w_driven, a = driven_speeds(
            v, w, v_driven, w_driven, a, dt, vehicle.w_max, vehicle.a_max, vehicle.j_max, vehicle.lag
        )
        v_true, w_true = over_ground(vehicle.speed_scale * v_driven, w_driven, s_left, s_right, vehicle.track_width)
        x_to, y_to, theta_to, states = vehicle_step(
            x, y, theta, states, v_true, w_true, v_driven, w_driven, dt, vehicle.arc, vehicle.parameters
        )
        if vehicle.skid > 0.0:
            # The vehicle does not move along its heading: its displacement is turned by the side-slip angle.
            beta = side_slip(v_true, (theta_to - theta) / dt, vehicle.skid)
            cos, sin, dx, dy = math.cos(beta), math.sin(beta), x_to - x, y_to - y
            x_to, y_to = x + cos * dx - sin * dy, y + sin * dx + cos * dy
        x, y, theta = x_to, y_to, theta_to
    return Motion(x, y, theta, v_driven, w_driven, a, states)


def measured(
    x: float, y: float, theta: float, n_x: float, n_y: float, n_theta: float, noise_xy: float, noise_theta: float
) -> tuple[float, float, float]:
    """Pose as the AGV measures it, with these normal numbers times the standard deviations [m, rad] as errors."""
    return x + noise_xy * n_x, y + noise_xy * n_y, theta + noise_theta * n_theta
