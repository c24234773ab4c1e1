"""The error detector: compares the reference with the freshest pose that the edge holds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import TimeReference

from agv_cloud.parameters import ErrorDetectorParameters
from agv_cloud.reference import Reference
from agv_cloud.tracking_error import tracking_error
from agv_ros.executor import run_node
from agv_ros.node import LoopNode
from agv_ros.slot_join import Joined, SlotJoin
from agv_ros.stamps import Steps
from agv_ros.wire import InvalidMessageError, Pose, TrackingError, decode_pose, decode_slot, encode_error, stamp_of


class ErrorDetectorNode(LoopNode[ErrorDetectorParameters]):
    """Answers each uplink slot with one edge/error, from a fresh pose or from an outdated one."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("error_detector", ErrorDetectorParameters, **node_options)
        self.reference = Reference(self.settings)
        self._join: SlotJoin[Pose] = SlotJoin(self.grid.start_ns)
        self._steps = Steps(self.grid)
        self._blind = 0
        self._error_out = self.output(Odometry, "edge/error")
        self.input(PoseStamped, "edge/pose", self._on_pose, self._error_out)
        self.input(TimeReference, "edge/slot", self._on_slot, self._error_out)

    def _on_pose(self, data: bytes) -> None:
        try:
            ready = self._join.add_message(decode_pose(data))
        except InvalidMessageError:
            self._answer(self._join.reject(stamp_of(data)))
            raise
        self._answer(ready)

    def _on_slot(self, data: bytes) -> None:
        slot = decode_slot(data)
        self._steps.of(slot.stamp_ns)
        self.report_every_second(slot.stamp_ns)
        self._answer(self._join.add_slot(slot))

    def _answer(self, ready: list[Joined[Pose]]) -> None:
        for joined in ready:
            stamp_ns, pose = joined.slot.stamp_ns, joined.message
            if pose is None:
                self._blind += 1
                continue
            target = self.reference[self.grid.step(stamp_ns)]
            eps = tracking_error(target.x, target.y, target.theta, pose.x, pose.y, pose.theta)
            self._error_out.publish(encode_error(TrackingError(stamp_ns, *eps, target.v, target.w)))

    def facts(self) -> dict[str, str]:
        """Slots that were not answered, by reason."""
        return {
            "slots without any pose": str(self._blind),
            "slots whose pose never came": str(self._join.unanswered),
            "outdated messages": str(self._join.outdated),
        }


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of the executable `error_detector`."""
    run_node(ErrorDetectorNode, args)


if __name__ == "__main__":
    main()
