"""The largest gains of Kanayama's law that a robot's dead time and lag bear, and a scenario whose plant is this robot.

The dead time is a constant age of each pose: on a straight track it does not matter where in the loop time passes.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from agv_analysis.identify.robot import IdentifiedRobot
from agv_analysis.scenario import Scenario, parse_scenario
from agv_analysis.stability.derived_loop import linear_loop
from agv_analysis.stability.error_dynamics import NoNominalMotionError
from agv_analysis.stability.first_border import borders
from agv_analysis.stability.lifted import largest_radius
from agv_cloud.parameters import ErrorDetectorParameters
from agv_plant.radio.delay import whole_slots
from agv_ros.errors import UserError
from agv_ros.parameters import parameters_of

_GRID = (0.1, 0.3, 0.6, 1.0, 1.5, 2.2, 4.0, 10.0)
"""Gains that are tried first, over those of a loop with the time constant of dead time, lag and period."""

GAIN_MARGIN = 2.0
"""How far below the largest gains those of the params file are."""


@dataclass(frozen=True)
class BearableGains:
    """The largest gains at a speed, each without the other; K_y = K_theta^2 / 4, so that errors across do not swing."""

    dead_time: float
    """Constant age of poses [s], whole periods."""
    lag: float
    """[s]"""
    ts: float
    """Sampling period [s]."""
    speed: float
    """[m/s]"""
    kx: float
    """[1/s]"""
    ktheta: float
    """[1/m]"""

    @property
    def ky(self) -> float:
        """[1/m^2]"""
        return 0.25 * self.ktheta**2

    def to_json(self) -> dict[str, Any]:
        """All of it."""
        return {
            "dead_time_s": self.dead_time,
            "lag_s": self.lag,
            "ts_s": self.ts,
            "speed_m_per_s": self.speed,
            "kx_max_per_s": self.kx,
            "ktheta_max_per_m": self.ktheta,
            "ky_with_ktheta_max_per_m2": self.ky,
        }


def plant_like(robot: IdentifiedRobot, has_upper_ends: bool = False) -> Scenario | None:
    """A scenario whose plant behaves like the robot; None unless v and w are known.

    `has_upper_ends`: with the longest dead time, lag and the largest gain of their intervals, else with the estimates.
    Raises UserError if the robot was driven faster than a reference may be.
    """
    v, w = (robot[key].fit for key in "vw")
    if v is None or w is None:
        return None
    fastest = parameters_of(ErrorDetectorParameters)["speed"].high
    if fastest is not None and robot.largest_speed > fastest:
        raise UserError(
            f"the robot was driven at up to {robot.largest_speed:g} m/s, and gains are found for at most {fastest:g} "
            "m/s: record it at the speeds at which it works"
        )
    dead_time, lag, gain = (
        max(getattr(part, "high" if has_upper_ends else "value") for part in parts)
        for parts in ((v.dead_time, w.dead_time), (v.lag, w.lag), (v.gain,))
    )
    ts = _rounded(robot.command_period)
    plain = parse_scenario("controller: {ros__parameters: {}}", "defaults", [f"{node}.ts={ts!r}" for node in _NODES])
    values: dict[str, dict[str, Any]] = {
        "plant": {
            "lag": round(lag, 6),
            "speed_scale": round(gain, 6),
            "integration": "arc",
            "substeps": 10 if lag > 0.0 else 1,
        },
        "relay": {"uplink.delay": round(dead_time, 6)},
        "error_detector": {"track": "line", "speed": max(0.01, round(robot.largest_speed, 6))},
    }
    x, y, theta = plain.error_detector.track_start
    values["plant"]["initial_pose"] = [x, y, theta]
    return plain.with_values(values, "the identified robot")


_NODES = ("plant", "relay", "error_detector", "controller")


def _rounded(period: float) -> float:
    """A period [s] to the microsecond: stamps are not better."""
    return max(1e-3, round(period, 6))


def bearable_gains(robot: IdentifiedRobot) -> BearableGains | None:
    """The largest gains with the upper ends of dead time and lag, None where the robot or a border is not known."""
    scenario = plant_like(robot, has_upper_ends=True)
    if scenario is None:
        return None
    ts, speed, lag = scenario.plant.ts, scenario.error_detector.speed, scenario.plant.lag
    slots = whole_slots(scenario.relay.uplink.delay / ts)
    scenario = replace(scenario, relay=replace(scenario.relay, uplink=replace(scenario.relay.uplink, delay=0.0)))
    time = (slots + 1) * ts + lag

    @functools.cache
    def growth(kx: float, ktheta: float) -> float:
        values = {"controller": {"kx": kx, "ktheta": ktheta, "ky": 0.25 * ktheta**2}}
        try:
            loop = linear_loop(scenario.with_values(values), np.array([speed]), np.array([0.0]))
        except NoNominalMotionError:
            return math.inf
        return largest_radius(loop, slots) - 1.0

    slow_kx, slow_ktheta = 0.1 / time, 0.1 / (time * speed)
    along = borders(lambda share: growth(share / time, slow_ktheta), _GRID)
    across = borders(lambda share: growth(slow_kx, share / (time * speed)), _GRID)
    if not along or not across or along[0] <= _GRID[0] or across[0] <= _GRID[0]:
        return None
    return BearableGains(slots * ts, lag, ts, speed, along[0] / time, across[0] / (time * speed))


def robot_scenario(robot: IdentifiedRobot, gains: BearableGains) -> Scenario | None:
    """The scenario of the params file: `plant_like`, with gains a factor GAIN_MARGIN below the largest."""
    scenario = plant_like(robot)
    if scenario is None:
        return None
    kx, ktheta = (float(f"{gain / GAIN_MARGIN:.4g}") for gain in (gains.kx, gains.ktheta))
    values = {"controller": {"kx": kx, "ktheta": ktheta, "ky": 0.25 * ktheta**2}}
    return scenario.with_values(values, "the identified robot")
