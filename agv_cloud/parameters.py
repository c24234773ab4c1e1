"""Parameters of the edge's side: error detector and controller."""

from __future__ import annotations

import math
from dataclasses import dataclass

from agv_cloud.reference.tracks import TRACKS
from agv_cloud.staleness import POLICIES
from agv_plant.vehicle.unicycle import STEPS
from agv_ros.message_types import COMMAND_TYPES, POSE_TYPES
from agv_ros.parameters import LoopParameters, ParameterError, parameter

TRIGGERS = ("slot", "timer")

CSV, PATH = "csv", "path"
"""Tracks that come from elsewhere: a file, or a topic."""


@dataclass(frozen=True)
class ErrorDetectorParameters(LoopParameters):
    """Parameters of the node `error_detector`."""

    track: str = parameter(
        "paper",
        "reference track; csv: speeds from track_file, path: along a nav_msgs/Path that comes on edge/path, from its "
        "beginning to its end, and along each other one that comes after it",
        choices=(*TRACKS, CSV, PATH),
    )
    track_file: str = parameter("", "track csv: file with the columns t [s], v [m/s], w [rad/s]")
    track_start: tuple[float, float, float] = parameter(
        (0.0, 0.0, 1.5707963267948966), "X_r(0) = [x, y, theta] in frame map", unit="m, m, rad"
    )
    lap_time: float = parameter(100.0, "time T of one lap of the track", unit="s", above=0.0, high=1e6)
    speed: float = parameter(
        1.0, "speed of the tracks line, circle, eight, warehouse and path", unit="m/s", above=0.0, high=100.0
    )
    corner: float = parameter(
        0.2, "track path: how far before a corner, at most, the arc begins that rounds it", unit="m", above=0.0,
        high=100.0,
    )  # fmt: skip
    policy: str = parameter(
        "hold",
        "what an outdated pose is compared with; hold: the reference of now, align: that of its instant, predict: it "
        "is moved on by the plant's model under the commands sent since, and compared with the reference of now",
        choices=POLICIES,
    )
    integration: str = parameter(
        "euler", "predict: how the plant's model integrates one period, as plant.integration", choices=tuple(STEPS)
    )

    trigger: str = parameter(
        "slot",
        "what makes the edge step; slot: each slot of edge/slot, lost or not, timer: its own clock, every ts, with the "
        "freshest pose that it holds and no slots, as behind a real radio; its age is then on edge/age",
        choices=TRIGGERS,
    )
    begin: str = parameter(
        "start_time",
        "timer: instant of step 0 in the time of the AGV's stamps; start_time: that one, first_pose: the stamp of the "
        "first pose that arrives, for a robot whose clock is not known",
        choices=("start_time", "first_pose"),
    )
    pose_type: str = parameter(
        "pose", "type of edge/pose; pose: geometry_msgs/PoseStamped, odometry: nav_msgs/Odometry", choices=POSE_TYPES
    )

    def __post_init__(self) -> None:
        """Check what no single bound can say."""
        if self.track == CSV and not self.track_file:
            raise ParameterError("error_detector.track is csv, but error_detector.track_file is empty: name a file")
        if self.lap_time < 16.0 * self.ts:
            raise ParameterError(
                f"error_detector.lap_time must be at least 16 ts = {16.0 * self.ts:g} s, got {self.lap_time!r}"
            )


@dataclass(frozen=True)
class ControllerParameters(LoopParameters):
    """Parameters of the node `controller`."""

    kx: float = parameter(25.0, "gain K_x of the error along the track", unit="1/s", low=0.0, high=1e6, runtime=True)
    ky: float = parameter(1.0, "gain K_y of the error across the track", unit="1/m^2", low=0.0, high=1e6, runtime=True)
    ktheta: float = parameter(2.0, "gain K_theta of the error of heading", unit="1/m", low=0.0, high=1e6, runtime=True)
    integration: str = parameter(
        "euler", "how the model behind a plan integrates one period, as plant.integration", choices=tuple(STEPS)
    )
    command_type: str = parameter(
        "twist_stamped",
        "type of edge/cmd_vel; twist_stamped: geometry_msgs/TwistStamped, twist: geometry_msgs/Twist, which without a "
        "stamp cannot pass the relay or tell a predicting edge",
        choices=COMMAND_TYPES,
    )
    v_max: float = parameter(math.inf, "limit on |v|, .inf: none", unit="m/s", above=0.0, high=math.inf, runtime=True)
