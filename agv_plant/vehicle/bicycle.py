"""A vehicle that steers its front wheel, as a bicycle, a car or a tow tractor does."""

from __future__ import annotations

import math
from typing import Annotated

from agv_plant.vehicle.unicycle import integrate
from agv_ros.parts import Quantity


def bicycle(
    x: float,
    y: float,
    theta: float,
    steering: float,
    v: float,
    w: float,
    dt: float,
    arc: bool,
    v_driven: float,
    w_driven: float,
    wheelbase: Annotated[float, Quantity("distance of the axles", "m", above=0.0, high=100.0)] = 1.0,
    max_steering_angle: Annotated[
        float, Quantity("limit on the steering angle, to either side", "rad", above=0.0, high=1.57, limit=True)
    ] = 0.7,
    steering_rate: Annotated[
        float, Quantity("limit on the rate of the steering angle, .inf: none", "rad/s", above=0.0, high=math.inf)
    ] = math.inf,
    steering_lag: Annotated[
        float, Quantity("time constant with which the steering follows; 0: at once", "s", low=0.0, high=60.0)
    ] = 0.0,
) -> tuple[float, float, float, float]:
    """Pose of the rear axle's middle [m, m, rad] and steering angle [rad] a time `dt` [s] later.

    The steering angle that a command asks for is atan(wheelbase w / v), as ros2_controllers' bicycle controller obeys a
    Twist: 0 if v and w are both 0. It is limited, followed with a first-order lag, exactly discretised, and at a
    limited rate. With the angle that is reached the vehicle turns at v tan(steering) / wheelbase. `v` is the speed over
    the ground, `v_driven` and `w_driven` are those that the drive gives, from which the angle is made.

    Source: Rajamani, Vehicle Dynamics and Control, 2nd ed. 2012, 2.2, with the reference point on the rear axle.
    """
    wanted = steering_angle(v_driven, w_driven, wheelbase)
    wanted = min(max(wanted, -max_steering_angle), max_steering_angle)
    if steering_lag > 0.0:
        wanted = wanted + math.exp(-dt / steering_lag) * (steering - wanted)
    change = steering_rate * dt
    steering = min(max(wanted, steering - change), steering + change)
    x, y, theta = integrate(arc, x, y, theta, v, v * math.tan(steering) / wheelbase, dt)
    return x, y, theta, steering


def steering_angle(v: float, w: float, wheelbase: float) -> float:
    """Steering angle [rad] at which a bicycle turns at w [rad/s] while it drives at v [m/s]."""
    if v == 0.0:
        return 0.0 if w == 0.0 else math.copysign(0.5 * math.pi, w)
    return math.atan(wheelbase * w / v)
