"""The controller: a pure function of the tracking error, on the edge; with a plan, also of the reference ahead."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from trajectory_msgs.msg import MultiDOFJointTrajectory

from agv_cloud.control.command import command, control_law
from agv_cloud.control.command_plan import planned_commands
from agv_cloud.control.registry import CONTROL_LAWS
from agv_cloud.parameters import ControllerParameters
from agv_ros.codec import decode_error, encode_command, encode_twist
from agv_ros.executor import run_node
from agv_ros.message_sync import MOST_WAITING
from agv_ros.message_types import TWIST_STAMPED
from agv_ros.messages import FRAME_AGV, Command, TrackingError
from agv_ros.node import LoopNode
from agv_ros.parts import complaint
from agv_ros.speeds_codec import SpeedsAhead, decode_speeds, encode_speeds
from agv_ros.stamps import NS_PER_S
from agv_ros.substitution import replaced


class ControllerNode(LoopNode[ControllerParameters]):
    """Answers each edge/error with one edge/cmd_vel of the same stamp; with plans, also with one edge/plan."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("controller", ControllerParameters, **node_options)
        law = CONTROL_LAWS.find(self.settings.law)
        self._command = replaced(command, {control_law: law.adapter})
        self._initial_memory = self._memory = law.memory
        self._memory_before, self._answered_ns = law.memory, -1
        self._gains = self.settings.gains
        self._is_stamped = self.settings.command_type == TWIST_STAMPED
        plans = self.settings.plan_steps > 0
        kind = TwistStamped if self._is_stamped else Twist
        self._cmd_vel = self.output(kind, "edge/cmd_vel", side=plans)
        self._errors: dict[int, TrackingError] = {}
        self._horizons: dict[int, SpeedsAhead] = {}
        if plans:
            self._plan_out = self.output(MultiDOFJointTrajectory, "edge/plan")
            self.input(Odometry, "edge/error", self._keep_error, self._cmd_vel, self._plan_out)
            self.input(MultiDOFJointTrajectory, "edge/horizon", self._keep_horizon, self._cmd_vel, self._plan_out)
        else:
            self.input(Odometry, "edge/error", self._on_error, self._cmd_vel)

    def on_settings(self) -> None:
        """Gains that were changed while the node runs."""
        self._gains = self.settings.gains

    def _on_error(self, data: bytes) -> None:
        error, settings = decode_error(data), self.settings
        self._begin_step(error.stamp_ns)
        try:
            v, w, self._memory = self._command(
                error.x_e, error.y_e, error.theta_e, error.v_r, error.w_r, self._memory, self._gains, settings.ts,
                settings.look_ahead, settings.v_max,
            )  # fmt: skip
        except Exception as problem:  # another package's law, in which anything can go wrong
            self._refuse(complaint(problem), error.stamp_ns)
            return
        self._send(Command(error.stamp_ns, v, w))

    def _begin_step(self, stamp_ns: int) -> None:
        """A step that comes again is answered from the memory with which it was answered before."""
        self.report_every_second(stamp_ns)
        if stamp_ns == self._answered_ns:
            self._memory = self._memory_before
        elif stamp_ns < self._answered_ns or stamp_ns == self.grid.start_ns:  # another run begins
            self._memory = self._initial_memory
        self._answered_ns, self._memory_before = stamp_ns, self._memory

    def _refuse(self, what: str, stamp_ns: int) -> None:
        """End the run: the control law cannot go on."""
        where = CONTROL_LAWS.find(self.settings.law).where
        self.fail(f"{where} {what}, {(stamp_ns - self.grid.start_ns) / NS_PER_S:.6g} s after the start of the run")

    def _send(self, command: Command) -> None:
        if math.isnan(command.v) or math.isnan(command.w):
            self._refuse("returns NaN", command.stamp_ns)
            return
        prefix = self.settings.frame_prefix
        self._cmd_vel.publish(encode_command(command, prefix) if self._is_stamped else encode_twist(command))

    # -- with a plan -------------------------------------------------------------------------------------------------

    def _keep_error(self, data: bytes) -> None:
        error = decode_error(data)
        self._errors[error.stamp_ns] = error
        self._answer(error.stamp_ns)

    def _keep_horizon(self, data: bytes) -> None:
        horizon = decode_speeds(data)
        self._horizons[horizon.stamp_ns] = horizon
        self._answer(horizon.stamp_ns)

    def _answer(self, stamp_ns: int) -> None:
        """Answer a step once both its error and the reference ahead are there."""
        if stamp_ns in self._errors and stamp_ns in self._horizons:
            self._plan(self._errors.pop(stamp_ns), self._horizons.pop(stamp_ns))
        for waiting in (self._errors, self._horizons):
            if len(waiting) > MOST_WAITING:  # the other topic is dead
                del waiting[next(iter(waiting))]

    def _plan(self, error: TrackingError, horizon: SpeedsAhead) -> None:
        settings, stamp_ns = self.settings, error.stamp_ns
        self._begin_step(stamp_ns)
        try:
            commands, self._memory = planned_commands(
                (error.x_e, error.y_e, error.theta_e), horizon.speeds, self._memory, self._gains, settings.ts,
                settings.look_ahead, settings.v_max, settings.integration == "arc", self._command,
            )  # fmt: skip
        except Exception as problem:  # as above
            self._refuse(complaint(problem), stamp_ns)
            return
        self._send(Command(stamp_ns, *commands[0]))
        plan = SpeedsAhead(stamp_ns, tuple(commands))
        self._plan_out.publish(encode_speeds(plan, self.grid.ts_ns, settings.frame_prefix + FRAME_AGV))


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of the executable `controller`."""
    run_node(ControllerNode, args)


if __name__ == "__main__":
    main()
