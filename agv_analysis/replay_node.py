"""The player: recorded slots and poses to the edge's nodes once more, and their answers."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import TimeReference

from agv_analysis.replay import EdgeInputs
from agv_ros.node import LoopNode
from agv_ros.parameters import LoopParameters
from agv_ros.wire import Command, TrackingError, decode_command, decode_error, encode_clock

_PATIENCE = 10.0
"""How long [s] the edge may take for an answer, before it is given up."""

_TICK = 0.001
"""How often [s] the player looks what is due."""


class Pace(NamedTuple):
    """When the next slot is played."""

    lockstep: bool = False
    """As soon as the edge has answered the one before."""
    rate: float = 1.0
    """Otherwise: seconds of the recording per second."""


class ReplayNode(LoopNode[LoopParameters]):
    """Publishes edge/pose, edge/slot and /clock as recorded, and keeps the edge's answers by step."""

    def __init__(self, inputs: EdgeInputs, pace: Pace, **node_options: Any) -> None:
        super().__init__("replay", LoopParameters, **node_options)
        self.k = 0
        """Number of slots played."""
        self.errors: dict[int, TrackingError] = {}
        self.commands: dict[int, Command] = {}
        self._slots, self._pace = inputs.slots, pace
        self._waits_for: int | None = None
        self._unanswered = {slot.k for slot in inputs.slots if slot.is_answered}
        self._heard = time.monotonic()
        self._begun_ns = 0
        self._pose_out = self.output(PoseStamped, "edge/pose")
        self._slot_out = self.output(TimeReference, "edge/slot")
        self._clock_out = self.output(Clock, "/clock", side=True)
        self.input(Odometry, "edge/error", self._on_error)
        self.input(TwistStamped, "edge/cmd_vel", self._on_command)
        self.poll(self._begin)

    def _begin(self) -> bool:
        """Only once the controller listens to the error detector and speaks to us: nothing is to be lost."""
        wanted = self.settings.wait_for_subscribers
        if not all(output.is_heard(wanted) for output in self.outputs):
            return self._has_failed("no error detector listens to edge/pose and edge/slot")
        if self.count_subscribers("edge/error") < 2 or not self.count_publishers("edge/cmd_vel"):
            return self._has_failed("no controller listens to edge/error and sends edge/cmd_vel")
        if max(self.count_publishers("edge/slot"), self.count_publishers("edge/pose")) > 1:
            self.fail("a relay runs already and publishes edge/slot: use another namespace or ROS_DOMAIN_ID")
            return True
        self._heard, self._begun_ns = time.monotonic(), time.monotonic_ns()
        self._play_what_is_due()
        self.create_timer(_TICK if not self._pace.lockstep else 1.0, self._tick, clock=self._steady)
        return True

    def _has_failed(self, why: str) -> bool:
        if time.monotonic() - self._heard > _PATIENCE:
            self.fail(f"{why}, waited for {_PATIENCE:g} s")
        return self.finished

    def _tick(self) -> None:
        self._play_what_is_due()
        if self._waits_for is None and self.k < len(self._slots):
            self._heard = time.monotonic()  # the edge owes nothing, it is the recording that pauses
        elif time.monotonic() - self._heard > _PATIENCE:
            first = min(self._unanswered) if self._waits_for is None else self._waits_for
            self.fail(f"the edge does not answer step {first}, waited for {_PATIENCE:g} s")

    def _play_what_is_due(self) -> None:
        while self.k < len(self._slots) and self._waits_for is None and self._is_due():
            self._play()
        if self.k == len(self._slots) and not self._unanswered:
            self.finished = True

    def _is_due(self) -> bool:
        passed_ns = (self._slots[self.k].stamp_ns - self._slots[0].stamp_ns) / self._pace.rate
        return self._pace.lockstep or time.monotonic_ns() - self._begun_ns >= passed_ns

    def _play(self) -> None:
        now = self._slots[self.k]
        self.report_every_second(now.stamp_ns)
        self._clock_out.publish(encode_clock(now.stamp_ns))
        if now.pose is not None:
            self._pose_out.publish(now.pose)
        self._slot_out.publish(now.slot)
        self._waits_for = now.k if self._pace.lockstep and now.k in self._unanswered else None
        self.k += 1

    def _on_error(self, data: bytes) -> None:
        error = decode_error(data)
        self.errors[self.grid.step(error.stamp_ns)] = error
        self._settle(self.grid.step(error.stamp_ns))

    def _on_command(self, data: bytes) -> None:
        command = decode_command(data)
        self.commands[self.grid.step(command.stamp_ns)] = command
        self._settle(self.grid.step(command.stamp_ns))

    def _settle(self, k: int) -> None:
        """A step is answered once both its error and its command are here, whichever comes first."""
        self._heard = time.monotonic()
        if k in self.errors and k in self.commands:
            self._unanswered.discard(k)
            if self._waits_for == k:
                self._waits_for = None
            self._play_what_is_due()
