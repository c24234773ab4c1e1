"""Parameters of the edge's side: error detector and controller."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

from agv_cloud.control.registry import CONTROL_LAWS, KANAYAMA
from agv_cloud.reference.tracks import TRACKS
from agv_cloud.staleness.registry import STALENESS_POLICIES
from agv_plant.vehicle.unicycle import STEPS
from agv_ros.message_types import COMMAND_TYPES, POSE_TYPES
from agv_ros.parameters import LoopParameters, ParameterError, merged, parameter
from agv_ros.parts import Part, PartError, checked, field_of, schema_of

TRIGGERS = ("slot", "timer")

CSV, PATH = "csv", "path"
"""Tracks that come from elsewhere: a file, or a topic."""


_PolicyParameters = schema_of("PolicyParameters", STALENESS_POLICIES.usable(), globals())
_LawParameters = schema_of(
    "LawParameters", {name: law for name, law in CONTROL_LAWS.usable().items() if name != KANAYAMA}, globals()
)
_KANAYAMA = CONTROL_LAWS.find(KANAYAMA)


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
        choices=STALENESS_POLICIES.names(),
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

    of_policies: Any = merged(_PolicyParameters)
    """Parameters of policies that have some, `policy.parameter`."""

    def __post_init__(self) -> None:
        """Check what no single bound can say."""
        STALENESS_POLICIES.find(self.policy)
        if self.track == CSV and not self.track_file:
            raise ParameterError("error_detector.track is csv, but error_detector.track_file is empty: name a file")
        if self.lap_time < 16.0 * self.ts:
            raise ParameterError(
                f"error_detector.lap_time must be at least 16 ts = {16.0 * self.ts:g} s, got {self.lap_time!r}"
            )

    @property
    def policy_values(self) -> tuple[float, ...]:
        """The parameters of the chosen policy, in the order of its signature."""
        own = getattr(self.of_policies, self.policy, None)
        return () if own is None else dataclasses.astuple(own)


@dataclass(frozen=True)
class ControllerParameters(LoopParameters):
    """Parameters of the node `controller`."""

    law: str = parameter(
        KANAYAMA,
        "control law; kanayama: the paper's, with the gains kx, ky, ktheta, state_feedback: linear in the tracking "
        "error, pure_pursuit: along the circle to the point that the reference reaches look_ahead later; the gains of "
        "others than kanayama have the law's name before them",
        choices=CONTROL_LAWS.names(),
    )
    kx: float = field_of(_KANAYAMA, "kx")
    ky: float = field_of(_KANAYAMA, "ky")
    ktheta: float = field_of(_KANAYAMA, "ktheta")
    of_laws: Any = merged(_LawParameters)
    """Gains of the other laws, `law.gain`."""
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

    def __post_init__(self) -> None:
        """Check what no single bound can say: can the law be called?"""
        law = CONTROL_LAWS.find(self.law)
        if "look_ahead" in law.arguments and self.steps_ahead == 0:
            raise ParameterError(
                f"{CONTROL_LAWS.where(self.law)} looks ahead, but look_ahead is {self.look_ahead:g}: set it to one "
                "period ts at least, the same on all nodes"
            )
        _try(law, self)

    @property
    def gains(self) -> tuple[float, ...]:
        """The parameters of the chosen law, in the order of its signature."""
        if self.law == KANAYAMA:
            return self.kx, self.ky, self.ktheta
        own = getattr(self.of_laws, self.law, None)
        return () if own is None else dataclasses.astuple(own)


_TRIALS = ((0.0, 0.0, 0.0, 1.0, 0.0), (0.1, -0.2, 0.3, 0.5, 0.1))
"""Errors [m, m, rad] and speeds of the reference [m/s, rad/s] with which a law must be able to deal."""


def _try(law: Part, settings: ControllerParameters) -> None:
    """Call a law once or twice. Raises PartError if it raises or if its command is no two finite numbers."""
    where = CONTROL_LAWS.where(law.name)
    for trial in _TRIALS:
        arguments = (*trial, law.memory, settings.gains, settings.ts, settings.look_ahead)
        found = checked(law, where, lambda: law.adapter(*arguments))  # noqa: B023  # called at once
        if len(found) != 2 + len(law.memory):
            raise PartError(f"{where} must return as many numbers for its memory as it begins with: {len(law.memory)}")
        if not all(map(math.isfinite, found)):
            raise PartError(f"{where} returns {found} for the error and reference speeds {trial}: must be finite")
