"""The pose that the edge takes for the AGV's, and the one that it compares it with, step by step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from agv_cloud.reference.point import ReferencePoint
from agv_cloud.staleness.align import align
from agv_cloud.staleness.hold import hold
from agv_cloud.staleness.predict import predict
from agv_cloud.staleness.registry import ALIGN, HOLD
from agv_ros.parts import Part
from agv_ros.pose import Pose


def staleness_policy(
    number: int, held: Pose, target: Pose, reference: ReferencePoint, v: float, w: float, ts: float, arc: bool,
    parameters: tuple[float, ...],
) -> tuple[Pose, Pose]:  # fmt: skip
    """One step of a policy as the loop calls it: (held, target) of now, see `registry`.

    By default one of this package by its number; another package's that is chosen replaces it.
    """
    if number == HOLD:
        return hold(held, target, reference)
    if number == ALIGN:
        return align(held, target, reference)
    return predict(held, target, reference, v, w, ts, arc)


class Estimate(NamedTuple):
    """What the edge computes from at a step."""

    held: Pose
    target: Pose


class PoseEstimator:
    """Keeps the estimate of the node: what is held, and the commands that a policy may want to know.

    Each step is computed once: that of step k goes on from step k-1 unless a fresher pose has come.
    """

    def __init__(self, policy: Part, number: int, parameters: tuple[float, ...], ts: float, arc: bool) -> None:
        self._step: Callable[..., Any] = policy.adapter
        self._number, self._parameters, self._ts, self._arc = number, parameters, ts, arc
        self._is_stepwise = is_stepwise(number)
        self.uses_commands = bool({"v", "w"} & policy.arguments)
        """Must the policy know the commands that were sent?"""
        self._sent: dict[int, tuple[float, float]] = {}
        self._newest = (0.0, 0.0)
        self._taken = -1
        self._k = 0
        self._estimate = Estimate(Pose(0.0, 0.0, 0.0), Pose(0.0, 0.0, 0.0))

    def add_command(self, k: int, v: float, w: float) -> None:
        """The command that was sent at step k [m/s, rad/s]."""
        self._sent[k] = (v, w)

    def has_command(self, k: int) -> bool:
        """Is it known what was sent at step k, or does it not matter any more?"""
        return k in self._sent or k < self._k

    def at(self, k: int, taken: int, pose: Pose, reference: Callable[[int], ReferencePoint]) -> Estimate:
        """The estimate at step k from the pose that was taken at step `taken` <= k, with the reference by step.

        A step at which no command was sent counts as one under the command before it.
        """
        if taken != self._taken or k < self._k:
            self._taken, self._k = taken, taken
            point = reference(taken)
            self._estimate = Estimate(pose, Pose(point.x, point.y, point.theta))
            self._sent = {step: command for step, command in self._sent.items() if step >= taken}
        if not self._is_stepwise:
            self._k = max(self._k, k - 1)
        for step in range(self._k, k):
            self._newest = self._sent.get(step, self._newest)
            self._estimate = Estimate(
                *self._step(
                    self._number, *self._estimate, reference(step + 1), *self._newest, self._ts, self._arc,
                    self._parameters,
                )
            )  # fmt: skip
        self._k = k
        return self._estimate


def is_stepwise(number: int) -> bool:
    """Does a policy go on from its own last step, so that none may be left out? `hold` and `align` do not."""
    return number not in (HOLD, ALIGN)
