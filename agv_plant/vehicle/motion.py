"""The AGV's motion in one sampling period: drive, wheels, ground, and what its sensors make of its pose."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from agv_plant.vehicle.drive import driven_speeds
from agv_plant.vehicle.slip import over_ground, side_slip
from agv_plant.vehicle.unicycle import arc_step, euler_step

if TYPE_CHECKING:
    from agv_plant.parameters import PlantParameters

NOISE, SLIP = "plant/noise", "plant/slip"
"""Random streams: of step k the numbers 0, 1, 2 for x, y, theta; 0, 1 for the left and the right wheel."""


class Body(NamedTuple):
    """What is to be known of an AGV; the fields are the parameters of its plant."""

    arc: bool
    """Does it move along the arc, or by Euler's step?"""
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


class Motion(NamedTuple):
    """Pose in frame `map` [m, m, rad], and what the drive did last: speeds [m/s, rad/s], acceleration [m/s^2]."""

    x: float
    y: float
    theta: float
    v: float = 0.0
    w: float = 0.0
    a: float = 0.0


def body_of(plant: PlantParameters) -> Body:
    """The AGV that parameters describe."""
    others = {name: getattr(plant, name) for name in Body._fields if name != "arc"}
    return Body(arc=plant.integration == "arc", **others)


def move(motion: Motion, v: float, w: float, n_left: float, n_right: float, body: Body) -> Motion:
    """The motion a period later, under the command (v, w) [m/s, rad/s] and with these normal numbers for the wheels.

    The period is taken in `substeps` equal parts, each with the speeds that the drive has reached by then.
    """
    x, y, theta, v_driven, w_driven, a = motion
    dt = body.ts / body.substeps
    s_left, s_right = body.slip + body.slip_noise * n_left, body.slip + body.slip_noise * n_right
    for _ in range(body.substeps):
        v_driven, w_driven, a = driven_speeds(
            v, w, v_driven, w_driven, a, dt, body.w_max, body.a_max, body.j_max, body.lag
        )
        v_true, w_true = over_ground(body.speed_scale * v_driven, w_driven, s_left, s_right, body.track_width)
        beta = side_slip(v_true, w_true, body.skid)
        x, y, course = integrate(body.arc, x, y, theta + beta, v_true, w_true, dt)
        theta = course - beta
    return Motion(x, y, theta, v_driven, w_driven, a)


def integrate(arc: bool, x: float, y: float, theta: float, v: float, w: float, ts: float) -> tuple[float, float, float]:
    """One sampling period by the one or the other integration."""
    if arc:
        return arc_step(x, y, theta, v, w, ts)
    return euler_step(x, y, theta, v, w, ts)


def measured(
    x: float, y: float, theta: float, n_x: float, n_y: float, n_theta: float, noise_xy: float, noise_theta: float
) -> tuple[float, float, float]:
    """Pose as the AGV measures it, with these normal numbers times the standard deviations [m, rad] as errors."""
    return x + noise_xy * n_x, y + noise_xy * n_y, theta + noise_theta * n_theta
