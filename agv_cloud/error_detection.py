"""The tracking error of a step from a pose, and the reference ahead.

The error detector without its messages: reference, staleness policy and tracking error put together.
"""

from __future__ import annotations

from typing import NamedTuple

from agv_cloud.parameters import PATH, ErrorDetectorParameters
from agv_cloud.reference.path_reference import PathReference
from agv_cloud.reference.point import ReferencePoint
from agv_cloud.reference.reference import Reference
from agv_cloud.staleness.estimate import PoseEstimator
from agv_cloud.staleness.registry import STALENESS_POLICIES, number_of
from agv_cloud.step import EdgeStep
from agv_cloud.tracking_error import tracking_error
from agv_ros.parts import PartError, complaint
from agv_ros.pose import Pose


class Detection(NamedTuple):
    """Tracking error of a step with the reference's speeds, and the reference itself at that step."""

    eps: tuple[float, float, float]
    """x_e, y_e, theta_e [m, m, rad]."""
    target: ReferencePoint
    """The reference that the edge looks ahead to: its speeds are those that go with the error."""
    reference: ReferencePoint
    """X_r(k)."""
    held: Pose
    """The pose that was taken for the AGV's."""


class ErrorDetection:
    """Compares the reference with the estimated pose, step by step."""

    def __init__(self, settings: ErrorDetectorParameters) -> None:
        self.settings = settings
        self.reference: Reference | PathReference = (
            PathReference(settings.corner, settings.speed, settings.ts)
            if settings.track == PATH
            else Reference(settings)
        )
        self.estimator = self._new_estimator()

    def _new_estimator(self) -> PoseEstimator:
        settings, name = self.settings, self.settings.policy
        number = number_of(name)
        return PoseEstimator(
            STALENESS_POLICIES.find(name), number, settings.policy_values, settings.ts, settings.integration == "arc"
        )

    def restart(self) -> None:
        """A run begins: what was sent in the run before it does not count."""
        self.estimator = self._new_estimator()
        if isinstance(self.reference, PathReference):
            self.reference.restart()

    def detect(self, step: EdgeStep) -> Detection:
        """The error of a step. Raises PartError if the staleness policy raises."""
        k, received = step.k, Pose(step.pose.x, step.pose.y, step.pose.theta)
        if isinstance(self.reference, PathReference):
            self.reference.begin(k)
        try:
            held, target = self.estimator.at(k, step.taken, received, lambda at: self._reference_at(at, received))
        except Exception as problem:  # another package's policy, in which anything can go wrong
            where = STALENESS_POLICIES.find(self.settings.policy).where
            raise PartError(f"{where} {complaint(problem)}, at step {k}") from problem
        ahead = self._reference_at(k, held)
        now = ahead if self.settings.steps_ahead == 0 else self.reference[k] or ahead
        return Detection(tracking_error(*target, *held), ahead, now, held)

    def speeds_ahead(self, k: int, held: Pose) -> tuple[tuple[float, float], ...]:
        """Speeds (v_r, w_r) [m/s, rad/s] from step k on, as far as the controller plans."""
        points = (self._reference_at(k + ahead, held) for ahead in range(self.settings.plan_steps + 1))
        return tuple((point.v, point.w) for point in points)

    def _reference_at(self, k: int, held: Pose) -> ReferencePoint:
        """What step k is compared with; before the first path: the AGV, standing where it is held to be."""
        found = self.reference[k + self.settings.steps_ahead]
        return ReferencePoint(*held, 0.0, 0.0) if found is None else found
