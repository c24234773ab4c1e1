"""Parameters of the edge's side: error detector and controller."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from agv_cloud.control.registry import CONTROL_LAWS, KANAYAMA
from agv_cloud.reference.point import ReferencePoint
from agv_cloud.reference.tracks import TRACKS
from agv_cloud.staleness.registry import STALENESS_POLICIES, number_of
from agv_plant.vehicle.unicycle import STEPS
from agv_ros.message_types import COMMAND_TYPES, POSE_TYPES
from agv_ros.parameters import LoopParameters, ParameterError, merged, parameter, parameters_of
from agv_ros.part_parameters import field_of, refuse_taken, schema_of, values_of
from agv_ros.parts import try_part
from agv_ros.pose import Pose

TRIGGERS = ("slot", "timer")

CSV, PATH = "csv", "path"
"""Tracks that come from elsewhere: a file, or a topic."""


@dataclass(frozen=True)
class _OwnErrorDetectorParameters(LoopParameters):
    """Parameters of the node `error_detector` but for those of policies."""

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
    corridor: float = parameter(
        0.0,
        "largest distance of the AGV from its reference that the analysis allows, 0: no corridor; the nodes do not use "
        "it",
        unit="m", low=0.0, high=1e6,
    )  # fmt: skip
    corridor_along: float = parameter(
        0.0,
        "largest deviation along the track, for a corridor that is longer or shorter than it is wide: corridor is then "
        "its half-width across the track; 0: corridor bounds the distance in every direction",
        unit="m", low=0.0, high=1e6,
    )  # fmt: skip
    policy: str = parameter(
        "hold",
        "what an outdated pose is compared with; hold: the reference of now, align: that of its instant, predict: it "
        "is moved on by the plant's model under the commands sent since, and compared with the reference of now",
        choices=STALENESS_POLICIES.names,
        remedy=STALENESS_POLICIES.remedy,
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


_TAKEN_AT_ERROR_DETECTOR = tuple(parameters_of(_OwnErrorDetectorParameters))


def _policy_parameters() -> type:
    return schema_of("PolicyParameters", STALENESS_POLICIES.usable(), _TAKEN_AT_ERROR_DETECTOR, globals())


@dataclass(frozen=True)
class ErrorDetectorParameters(_OwnErrorDetectorParameters):
    """Parameters of the node `error_detector`."""

    of_policies: Any = merged(_policy_parameters, STALENESS_POLICIES.refusal)
    """Parameters of policies that have some, `policy.parameter`."""

    def __post_init__(self) -> None:
        """Check what no single bound can say."""
        policy = STALENESS_POLICIES.find(self.policy)
        refuse_taken(policy, _TAKEN_AT_ERROR_DETECTOR)
        number, arc = number_of(self.policy), self.integration == "arc"
        for held, target, reference, v, w in _STALE_TRIALS:
            try_part(
                policy, STALENESS_POLICIES.call, number, held, target, reference, v, w, self.ts, arc, self.policy_values
            )
        if self.track == CSV and not self.track_file:
            raise ParameterError("error_detector.track is csv, but error_detector.track_file is empty: name a file")
        if self.corridor_along > 0.0 and self.corridor == 0.0:
            raise ParameterError(
                f"error_detector.corridor_along is {self.corridor_along:g}, but error_detector.corridor is 0: name the "
                "corridor's half-width across the track, too"
            )
        if self.lap_time < 16.0 * self.ts:
            raise ParameterError(
                f"error_detector.lap_time must be at least 16 ts = {16.0 * self.ts:g} s, got {self.lap_time!r}"
            )

    @property
    def policy_values(self) -> tuple[float, ...]:
        """The parameters of the chosen policy, in the order of its signature."""
        return values_of(STALENESS_POLICIES.find(self.policy), self.of_policies)

    @property
    def hears_commands(self) -> bool:
        """Does the chosen policy have to know the commands that were sent?"""
        return bool({"v", "w"} & STALENESS_POLICIES.find(self.policy).arguments)


_STALE_TRIALS = (
    (Pose(0.0, 0.0, 0.0), Pose(0.0, 0.0, 0.0), ReferencePoint(0.0, 0.0, 0.0, 1.0, 0.0), 0.0, 0.0),
    (Pose(0.1, -0.2, 0.3), Pose(0.2, 0.1, 0.2), ReferencePoint(0.3, 0.2, 0.1, 0.5, 0.1), 0.6, -0.1),
)
"""Poses and speeds that a policy must handle."""


_KANAYAMA = CONTROL_LAWS.own_part(KANAYAMA)


@dataclass(frozen=True)
class _OwnControllerParameters(LoopParameters):
    """Parameters of the node `controller` but for those of laws with names of their own before their gains."""

    law: str = parameter(
        KANAYAMA,
        "control law; kanayama: the paper's, with the gains kx, ky, ktheta, state_feedback: linear in the tracking "
        "error, pure_pursuit: along the circle to the point that the reference reaches look_ahead later; the gains of "
        "others than kanayama have the law's name before them",
        choices=CONTROL_LAWS.names,
        remedy=CONTROL_LAWS.remedy,
    )
    kx: float = field_of(_KANAYAMA, "kx")
    ky: float = field_of(_KANAYAMA, "ky")
    ktheta: float = field_of(_KANAYAMA, "ktheta")
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


_TAKEN_AT_CONTROLLER = tuple(parameters_of(_OwnControllerParameters))


def _law_parameters() -> type:
    others = {name: law for name, law in CONTROL_LAWS.usable().items() if name != KANAYAMA}
    return schema_of("LawParameters", others, _TAKEN_AT_CONTROLLER, globals())


@dataclass(frozen=True)
class ControllerParameters(_OwnControllerParameters):
    """Parameters of the node `controller`."""

    of_laws: Any = merged(_law_parameters, CONTROL_LAWS.refusal)
    """Gains of other laws than kanayama, `law.gain`."""

    def __post_init__(self) -> None:
        """Check what no single bound can say: can the law be called?"""
        law = CONTROL_LAWS.find(self.law)
        refuse_taken(law, _TAKEN_AT_CONTROLLER)
        if "look_ahead" in law.arguments and self.steps_ahead == 0:
            raise ParameterError(
                f"{law.where} looks ahead, but look_ahead is {self.look_ahead:g}: set it to one period ts at least, "
                "the same on all nodes"
            )
        for trial in _TRIALS:
            try_part(law, CONTROL_LAWS.call, *trial, law.memory, self.gains, self.ts, self.look_ahead)

    @property
    def gains(self) -> tuple[float, ...]:
        """The parameters of the chosen law, in the order of its signature."""
        if self.law == KANAYAMA:
            return self.kx, self.ky, self.ktheta
        return values_of(CONTROL_LAWS.find(self.law), self.of_laws)


_TRIALS = ((0.0, 0.0, 0.0, 1.0, 0.0), (0.1, -0.2, 0.3, 0.5, 0.1))
"""Errors [m, m, rad] and speeds of the reference [m/s, rad/s] that a law must handle."""
