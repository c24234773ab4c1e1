"""The controller: a pure function of the tracking error, on the edge."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry

from agv_cloud.control_law import control_law, limit_speed
from agv_cloud.parameters import ControllerParameters
from agv_ros.executor import run_node
from agv_ros.message_types import TWIST_STAMPED
from agv_ros.node import LoopNode
from agv_ros.wire import Command, decode_error, encode_command, encode_twist


class ControllerNode(LoopNode[ControllerParameters]):
    """Answers each edge/error with one edge/cmd_vel of the same stamp."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("controller", ControllerParameters, **node_options)
        self._is_stamped = self.settings.command_type == TWIST_STAMPED
        self._cmd_vel = self.output(TwistStamped if self._is_stamped else Twist, "edge/cmd_vel")
        self.input(Odometry, "edge/error", self._on_error, self._cmd_vel)

    def _on_error(self, data: bytes) -> None:
        error, gains = decode_error(data), self.settings
        self.report_every_second(error.stamp_ns)
        v, w = control_law(error.x_e, error.y_e, error.theta_e, error.v_r, error.w_r, gains.kx, gains.ky, gains.ktheta)
        command = Command(error.stamp_ns, limit_speed(v, gains.v_max), w)
        self._cmd_vel.publish(
            encode_command(command, gains.frame_prefix) if self._is_stamped else encode_twist(command)
        )


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of the executable `controller`."""
    run_node(ControllerNode, args)


if __name__ == "__main__":
    main()
