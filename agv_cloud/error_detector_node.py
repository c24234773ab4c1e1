"""The error detector: compares the reference with the freshest pose that the edge holds."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry, Path
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import TimeReference

from agv_cloud.parameters import ErrorDetectorParameters
from agv_cloud.reference import Reference
from agv_cloud.reference_path import path_points
from agv_cloud.staleness import Posture, Prediction
from agv_cloud.tracking_error import tracking_error
from agv_plant.unicycle import STEPS
from agv_ros.executor import run_node
from agv_ros.node import LoopNode
from agv_ros.slot_join import Joined, SlotJoin
from agv_ros.stamps import Steps
from agv_ros.transforms import TransformBroadcaster
from agv_ros.wire import (
    FRAME_MAP,
    FRAME_REFERENCE,
    InvalidMessageError,
    Pose,
    TrackingError,
    decode_command,
    decode_pose,
    decode_slot,
    encode_error,
    stamp_of,
)


class ErrorDetectorNode(LoopNode[ErrorDetectorParameters]):
    """Answers each uplink slot with one edge/error, from a fresh pose or from an outdated one."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("error_detector", ErrorDetectorParameters, **node_options)
        self.reference = Reference(self.settings)
        self._join: SlotJoin[Pose] = SlotJoin(self.grid.start_ns)
        self._steps = Steps(self.grid)
        self._blind = 0
        self._predicts = self.settings.policy == "predict"
        self._prediction = self._new_prediction()
        self._ready: deque[Joined[Pose]] = deque()
        self._answered = -1
        self._error_out = self.output(Odometry, "edge/error")
        self._transforms = TransformBroadcaster(self, FRAME_REFERENCE)
        if not self._transforms.available:  # said here only: there is no loop without this node
            self.get_logger().info("tf2_msgs is not installed: no node of this loop publishes transforms on /tf")
        self.input(PoseStamped, "edge/pose", self._on_pose, self._error_out)
        self.input(TimeReference, "edge/slot", self._on_slot, self._error_out)
        self._publish_path()
        if self._predicts:
            self.input(TwistStamped, "edge/cmd_vel", self._on_command)

    def _publish_path(self) -> None:
        """The reference for those who look on, once and latched; no part of the loop, so nobody is waited for."""
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._path_out = self.create_publisher(Path, "edge/reference", latched)
        path = Path()
        path.header.frame_id = FRAME_MAP
        for point in path_points(self.reference, self.settings):
            pose = PoseStamped()
            pose.header.frame_id = FRAME_MAP
            pose.pose.position.x, pose.pose.position.y = point.x, point.y
            pose.pose.orientation.z, pose.pose.orientation.w = math.sin(0.5 * point.theta), math.cos(0.5 * point.theta)
            path.poses.append(pose)
        self._path_out.publish(path)

    def _new_prediction(self) -> Prediction:
        return Prediction(STEPS[self.settings.integration], self.settings.ts)

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

    def _on_command(self, data: bytes) -> None:
        command = decode_command(data)
        self._prediction.add_command(self._steps.of(command.stamp_ns), command.v, command.w)
        self._answer([])

    def _answer(self, ready: list[Joined[Pose]]) -> None:
        self._ready.extend(ready)
        while self._ready and self._may_answer():
            self._answer_one(self._ready.popleft())

    def _may_answer(self) -> bool:
        """A prediction waits for the command that answers the step before, unless the next step comes first."""
        if not self._predicts or len(self._ready) > 1:
            return True
        k = self.grid.step(self._ready[0].slot.stamp_ns)
        return k - 1 != self._answered or self._prediction.has_command(k - 1)

    def _answer_one(self, joined: Joined[Pose]) -> None:
        stamp_ns, pose = joined.slot.stamp_ns, joined.message
        if pose is None:
            self._blind += 1
            return
        k, taken = self.grid.step(stamp_ns), self.grid.step(pose.stamp_ns)
        now, held = self.reference[k], Posture(pose.x, pose.y, pose.theta)
        target = self.reference[taken] if self.settings.policy == "align" else now
        if self._predicts:
            if k == 0:
                self._prediction = self._new_prediction()  # a run begins: what was sent in one before it is past
            held = self._prediction.at(k, taken, held)
        eps = tracking_error(target.x, target.y, target.theta, *held)
        self._answered = k
        error = TrackingError(stamp_ns, *eps, now.v, now.w)
        self._transforms.send(Pose(stamp_ns, now.x, now.y, now.theta))
        self._error_out.publish(encode_error(error, self.settings.frame_prefix))

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
