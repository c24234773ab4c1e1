"""The error detector: compares the reference with the freshest pose that the edge holds.

It steps with each slot that the relay announces, lost or not; or, behind a real radio, by its own clock.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from typing import Any

from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry, Path
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import TimeReference
from trajectory_msgs.msg import MultiDOFJointTrajectory

from agv_cloud.error_detection import ErrorDetection
from agv_cloud.parameters import PATH, ErrorDetectorParameters
from agv_cloud.reference.path_reference import PathReference
from agv_cloud.reference.path_track import PathError, PathTrack, Point
from agv_cloud.reference.point import ReferencePoint
from agv_cloud.reference.reference import Reference
from agv_cloud.reference.thinned_path import path_points, thinned
from agv_cloud.slot_stepping import SlotStepping
from agv_cloud.step import EdgeStep
from agv_cloud.timer_stepping import OutsideRunError, TimerStepping
from agv_ros.clock_mode import hear_clock_mode, window_of
from agv_ros.codec import (
    decode_command,
    decode_slot,
    encode_error,
    encode_pose,
    encode_slot,
    pose_decoder,
    stamp_of,
)
from agv_ros.executor import run_node
from agv_ros.message_types import ODOMETRY
from agv_ros.messages import (
    FRAME_MAP,
    FRAME_REFERENCE,
    InvalidMessageError,
    Slot,
    StampedPose,
    TrackingError,
    quaternion_of_yaw,
)
from agv_ros.node import LoopNode
from agv_ros.parts import PartError
from agv_ros.speeds_codec import SpeedsAhead, encode_speeds
from agv_ros.stamps import NS_PER_S
from agv_ros.transforms import TransformBroadcaster

TIMER = "timer"
"""Stands on edge/age in place of an outcome."""

_PATH_TOPIC = "edge/path"

_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""A copy of it is used: rclpy writes a topic's overrides into the profile that it is given."""


class ErrorDetectorNode(LoopNode[ErrorDetectorParameters]):
    """Answers each uplink slot, or each tick of its clock, with one edge/error, be its pose fresh or outdated."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("error_detector", ErrorDetectorParameters, **node_options)
        settings = self.settings
        self._detection = ErrorDetection(settings)
        self._slots = SlotStepping(self.grid, settings.window_steps)
        self._timed = TimerStepping(self.grid, from_first_pose=settings.begin == "first_pose")
        self._is_timed = settings.trigger == TIMER
        self._decode_pose = pose_decoder(settings.pose_type)
        self._timer: Any = None
        self._hears_paths = False
        self._refusal = ""
        self._transforms = TransformBroadcaster(self, FRAME_REFERENCE)
        if not self._transforms.available:  # logged here only: there is no loop without this node
            self.get_logger().info("tf2_msgs is not installed: no node of this loop publishes transforms on /tf")
        self._error_out = self.output(Odometry, "edge/error")
        plans, is_path = settings.plan_steps > 0, settings.track == PATH
        self._horizon_out = self.output(MultiDOFJointTrajectory, "edge/horizon") if plans else None
        self._path_out = self.create_publisher(Path, "edge/reference", copy(_LATCHED))
        self._reference_out = self.output(PoseStamped, "edge/reference_pose", side=True) if is_path else None
        self._make_inputs()
        reference = self._detection.reference
        if isinstance(reference, Reference):
            self._show(path_points(reference, settings))
        else:
            self._listen_for_paths()
        if self._detection.estimator.uses_commands:
            self.input(TwistStamped, "edge/cmd_vel", self._on_command)

    def _make_inputs(self) -> None:
        kind = Odometry if self.settings.pose_type == ODOMETRY else PoseStamped
        feeds = [output for output in (self._error_out, self._reference_out) if output is not None]
        if self._is_timed:
            self._age_out = self.output(TimeReference, "edge/age", side=True)
            # Not used; but a relay, if there is one, may wait until its slots have a subscriber.
            self.input(TimeReference, "edge/slot", lambda _: None)
            self.input(kind, "edge/pose", self._keep_pose, *feeds)
        else:
            # First the slots: a relay waits for a subscriber of the poses, and then has that of the slots, too.
            self.input(TimeReference, "edge/slot", self._on_slot, *feeds)
            self.input(kind, "edge/pose", self._on_pose, *feeds)
            hear_clock_mode(self, "edge", self._on_clock_mode)

    def _on_clock_mode(self, mode: str) -> None:
        self._slots.limit_window(window_of(mode, self.settings.window_steps))

    def on_stop(self, reason: str) -> None:
        """What is under way is still answered; a clock of its own would go on forever."""
        super().on_stop(reason)
        if self._timer is not None:
            self._timer.cancel()

    def on_settings(self) -> None:
        """Parameters that were changed while the node runs."""
        self._detection.settings = self.settings

    def _show(self, points: Iterable[ReferencePoint]) -> None:
        """Publish the reference for display, latched; it is not part of the loop, which does not wait for viewers."""
        path = Path()
        path.header.frame_id = FRAME_MAP
        for point in points:
            pose = PoseStamped()
            pose.header.frame_id = FRAME_MAP
            pose.pose.position.x, pose.pose.position.y = point.x, point.y
            pose.pose.orientation.z, pose.pose.orientation.w = quaternion_of_yaw(point.theta)
            path.poses.append(pose)
        self._path_out.publish(path)

    # -- along paths -------------------------------------------------------------------------------------------------

    def _listen_for_paths(self) -> None:
        """Subscribe to planners, which publish a path once, and to a path that was latched before this node started.

        No single subscription gets both: one for latched paths is incompatible with publishers that do not latch.
        """
        where = self.resolve_topic_name(_PATH_TOPIC)

        def catch_up() -> bool:
            offered = [info.qos_profile.durability for info in self.get_publishers_info_by_topic(where)]
            if _LATCHED.durability in offered:
                self.create_subscription(Path, _PATH_TOPIC, self._on_latched_path, copy(_LATCHED), raw=True)
                return True
            return self._hears_paths

        self.input(Path, _PATH_TOPIC, self._on_path)
        self.poll(catch_up)
        self.get_logger().info(f"waiting for a path on {where}: the AGV shall stand still until one comes")

    def _on_path(self, data: bytes) -> None:
        self._hears_paths = True
        self._take_path(data)

    def _on_latched_path(self, data: bytes) -> None:
        if not self._hears_paths:  # from then on both subscriptions receive what a latching publisher sends
            self._take_path(data)

    def _take_path(self, data: bytes) -> None:
        """Drive another path than the last one; one that cannot be driven is counted, and the last one holds."""
        reference = self._detection.reference
        assert isinstance(reference, PathReference)
        try:
            track = reference.take(_points_of(data))
            if track is not None:
                self._announce(track, reference.paths)
        except PathError as error:
            self.rejected[_PATH_TOPIC] += 1
            if str(error) != self._refusal:
                self._refusal = str(error)
                self.get_logger().warning(f"{_PATH_TOPIC}: path rejected: {error}; more like it are only counted")
            self.report(self._last_ns)  # the path's own stamp is not of the loop's time

    def _announce(self, track: PathTrack, number: int) -> None:
        x, y, _ = track.curve.at(0.0)
        self.get_logger().info(f"path {number}: {track.curve.length:.3f} m from ({x:.3f}, {y:.3f}) m on")
        self._show(thinned(track, track.steps))

    # -- by slots ----------------------------------------------------------------------------------------------------

    def _on_pose(self, data: bytes) -> None:
        try:
            self._slots.add_pose(self._decode_pose(data))
        except InvalidMessageError:
            self._slots.reject_pose(stamp_of(data))
            self._answer_slots()
            raise
        self._answer_slots()

    def _on_slot(self, data: bytes) -> None:
        slot = decode_slot(data)
        self._slots.step_of(slot.stamp_ns)
        self.report_every_second(slot.stamp_ns)
        self._slots.add_slot(slot)
        self._answer_slots()

    def _on_command(self, data: bytes) -> None:
        command = decode_command(data)
        step_of = self._timed.step_of if self._is_timed else self._slots.step_of
        self._detection.estimator.add_command(step_of(command.stamp_ns), command.v, command.w)
        self._answer_slots()

    def _answer_slots(self) -> None:
        while (step := self._slots.next(self._detection.estimator)) is not None:
            if step.k == 0:
                self._detection.restart()
            self._answer(step)

    # -- by its own clock --------------------------------------------------------------------------------------------

    def _keep_pose(self, data: bytes) -> None:
        try:
            begins = self._timed.add_pose(self._decode_pose(data), self.get_clock().now().nanoseconds)
        except OutsideRunError as error:
            self.fail(str(error))
            return
        if begins:
            self._begin()

    def _begin(self) -> None:
        """A run begins: its ticks come just after the AGV's instants, since a command must not be from the future."""
        number = self._timed.freshest.beginnings
        if number > 1:
            at = self._timed.freshest.first_ns / NS_PER_S
            self.get_logger().warning(f"the AGV, or its clock, began anew: run {number} begins at its time {at:.3f} s")
        self.grid = self._timed.grid
        self._detection.restart()
        if self._timer is None:
            is_simulated = bool(self.get_parameter("use_sim_time").value)
            clock = self.get_clock() if is_simulated else self._steady
            self._timer = self.create_timer(self.settings.ts, self._tick, clock=clock)
        else:
            self._timer.reset()
        self._tick()

    def _tick(self) -> None:
        step = None if self.finished else self._timed.tick(self.get_clock().now().nanoseconds)
        if step is None:
            return
        stamp_ns = self.grid.stamp(step.k)
        self.report_every_second(stamp_ns)
        self._age_out.publish(encode_slot(Slot(stamp_ns, step.pose.stamp_ns, TIMER)))
        self._answer(step)

    # -- either way --------------------------------------------------------------------------------------------------

    def _answer(self, step: EdgeStep) -> None:
        """Publish the error of a step, and what goes with it."""
        try:
            found = self._detection.detect(step)
        except PartError as error:
            self.fail(str(error))
            return
        stamp_ns, prefix, reference = self.grid.stamp(step.k), self.settings.frame_prefix, found.reference
        if self._horizon_out is not None:
            ahead = SpeedsAhead(stamp_ns, self._detection.speeds_ahead(step.k, found.held))
            self._horizon_out.publish(encode_speeds(ahead, self.grid.ts_ns, prefix + FRAME_REFERENCE))
        posture = StampedPose(stamp_ns, reference.x, reference.y, reference.theta)
        if self._reference_out is not None:
            self._reference_out.publish(encode_pose(posture))
        self._transforms.send(posture)
        message = TrackingError(stamp_ns, *found.eps, found.target.v, found.target.w)
        self._error_out.publish(encode_error(message, prefix))

    def facts(self) -> dict[str, str]:
        """Slots that were not answered, by reason; or how the edge's clock and the AGV's differ. Paths that came."""
        reference, timed = self._detection.reference, self._timed
        paths = {"paths": str(reference.paths)} if isinstance(reference, PathReference) else {}
        if self._is_timed:
            return paths | {
                "clock offset [s]": f"{timed.freshest.offset_ns / NS_PER_S:.6f}",
                "oldest pose [s]": f"{timed.oldest_ns / NS_PER_S:.6f}",
                "stamps in the future": str(timed.freshest.future),
                "outdated messages": str(timed.freshest.outdated),
                "beginnings": str(timed.freshest.beginnings),
                "missed steps": str(timed.missed),
            }
        return paths | {
            "slots without any pose": str(self._slots.blind),
            "slots whose pose never came": str(self._slots.unanswered),
            "outdated messages": str(self._slots.outdated),
            "beginnings": str(self._slots.beginnings),
        }


def _points_of(data: bytes) -> list[Point]:
    """Where a serialised nav_msgs/Path leads [m]. Raises PathError if it is none, or in another frame than `map`."""
    try:
        path = deserialize_message(data, Path)
    except (RuntimeError, ValueError) as error:
        raise PathError(f"it cannot be read: {error}") from None
    frames = {path.header.frame_id, *(pose.header.frame_id or FRAME_MAP for pose in path.poses)} - {FRAME_MAP}
    if frames:
        found = ", ".join(repr(frame) for frame in sorted(frames))
        raise PathError(f"it is in frame {found}, poses and paths must be in {FRAME_MAP!r}: let the planner plan there")
    return [(pose.pose.position.x, pose.pose.position.y) for pose in path.poses]


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of the executable `error_detector`."""
    run_node(ErrorDetectorNode, args)


if __name__ == "__main__":
    main()
