"""The error detector: compares the reference with the freshest pose that the edge holds.

It steps with each slot that the relay announces, lost or not; or, behind a real radio, by its own clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from copy import copy
from typing import Any

from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry, Path
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import TimeReference
from trajectory_msgs.msg import MultiDOFJointTrajectory

from agv_cloud.clock_offset import FreshestPose
from agv_cloud.parameters import PATH, ErrorDetectorParameters
from agv_cloud.reference.path_track import Curve, PathError, PathReference, PathTrack, Point
from agv_cloud.reference.point import ReferencePoint
from agv_cloud.reference.reference import Reference
from agv_cloud.reference.thinned_path import path_points, thinned
from agv_cloud.staleness.estimate import PoseEstimator
from agv_cloud.staleness.registry import STALENESS_POLICIES
from agv_cloud.tracking_error import tracking_error
from agv_ros.codec import (
    decode_command,
    decode_odometry,
    decode_pose,
    decode_slot,
    encode_error,
    encode_pose,
    encode_slot,
    stamp_of,
)
from agv_ros.executor import run_node
from agv_ros.message_sync import Joined, MessageSync
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
from agv_ros.pose import Pose
from agv_ros.speeds_codec import SpeedsAhead, encode_speeds
from agv_ros.stamps import MAX_FIRST, NS_PER_S, Grid, Steps
from agv_ros.transforms import TransformBroadcaster

TIMER = "timer"
"""What edge/age says of its slots, in place of an outcome."""

_PATH_TOPIC = "edge/path"

_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""A copy of it is used: rclpy writes a topic's overrides into the profile that it is given."""


class ErrorDetectorNode(LoopNode[ErrorDetectorParameters]):
    """Answers each uplink slot, or each tick of its clock, with one edge/error, be its pose fresh or outdated."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("error_detector", ErrorDetectorParameters, **node_options)
        is_path = self.settings.track == PATH
        self.reference: Reference | PathReference = PathReference() if is_path else Reference(self.settings)
        self._join: MessageSync[StampedPose] = MessageSync(self.grid.start_ns)
        self._steps = Steps(self.grid)
        self._blind = 0
        self._ahead = self.settings.steps_ahead
        self._estimator = self._new_estimator()
        self._ready: deque[Joined[StampedPose]] = deque()
        self._answered = -1
        self._error_out = self.output(Odometry, "edge/error")
        plans = self.settings.plan_steps > 0
        self._horizon_out = self.output(MultiDOFJointTrajectory, "edge/horizon") if plans else None
        self._transforms = TransformBroadcaster(self, FRAME_REFERENCE)
        if not self._transforms.available:  # said here only: there is no loop without this node
            self.get_logger().info("tf2_msgs is not installed: no node of this loop publishes transforms on /tf")
        self._is_odometry = self.settings.pose_type == ODOMETRY
        self._freshest = FreshestPose(self.grid.ts_ns)
        self._timer: Any = None
        self._missed = 0
        self._oldest_ns = 0
        self._path_out = self.create_publisher(Path, "edge/reference", copy(_LATCHED))
        self._points: list[Point] = []
        self._paths = 0
        self._hears_paths = False
        self._refusal = ""
        self._reference_out = self.output(PoseStamped, "edge/reference_pose", side=True) if is_path else None
        kind = Odometry if self._is_odometry else PoseStamped
        heard = [output for output in (self._error_out, self._reference_out) if output is not None]
        if self.settings.trigger == TIMER:
            self._age_out = self.output(TimeReference, "edge/age", side=True)
            self.input(kind, "edge/pose", self._keep_pose, *heard)
            # Not used; but a relay, if there is one, may be told to wait until somebody hears its slots.
            self.input(TimeReference, "edge/slot", lambda _: None)
        else:
            self.input(kind, "edge/pose", self._on_pose, *heard)
            self.input(TimeReference, "edge/slot", self._on_slot, *heard)
        if isinstance(self.reference, Reference):
            self._show(path_points(self.reference, self.settings))
        else:
            self._listen_for_paths()
        if self._estimator.uses_commands:
            self.input(TwistStamped, "edge/cmd_vel", self._on_command)

    def _show(self, points: Iterable[ReferencePoint]) -> None:
        """The reference for those who look on, latched; no part of the loop, so nobody is waited for."""
        path = Path()
        path.header.frame_id = FRAME_MAP
        for point in points:
            pose = PoseStamped()
            pose.header.frame_id = FRAME_MAP
            pose.pose.position.x, pose.pose.position.y = point.x, point.y
            pose.pose.orientation.z, pose.pose.orientation.w = quaternion_of_yaw(point.theta)
            path.poses.append(pose)
        self._path_out.publish(path)

    def _new_estimator(self) -> PoseEstimator:
        settings, name = self.settings, self.settings.policy
        number = STALENESS_POLICIES.names().index(name)
        return PoseEstimator(
            STALENESS_POLICIES.find(name), number, settings.policy_values, settings.ts, settings.integration == "arc"
        )

    def _forget_the_run_before(self) -> None:
        """A run begins: what was sent in one before it is past."""
        self._estimator = self._new_estimator()
        if isinstance(self.reference, PathReference):
            self.reference.restart()

    def _decode_pose(self, data: bytes) -> StampedPose:
        return decode_odometry(data) if self._is_odometry else decode_pose(data)

    # -- along paths -------------------------------------------------------------------------------------------------

    def _listen_for_paths(self) -> None:
        """To planners, which publish a path once, and to one that somebody latched before this node was there.

        No single subscription gets both, and one for what is latched is complained of by those who do not latch.
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
        if not self._hears_paths:  # from then on both subscriptions hear whoever latches
            self._take_path(data)

    def _take_path(self, data: bytes) -> None:
        """Drive another path than the last one; one that cannot be driven is counted, and the last one holds."""
        try:
            points = _points_of(data)
            if points != self._points:
                self._replace_path(Curve(points, self.settings.corner))
                self._points = points
        except PathError as error:
            self.rejected[_PATH_TOPIC] += 1
            if str(error) != self._refusal:
                self._refusal = str(error)
                self.get_logger().warning(f"{_PATH_TOPIC}: path rejected: {error}; more like it are only counted")
            self.report(self._last_ns)  # the path's own stamp is not of the loop's time

    def _replace_path(self, curve: Curve) -> None:
        assert isinstance(self.reference, PathReference)
        track = PathTrack(curve, self.settings.speed, self.settings.ts)
        self.reference.replace(track)
        self._paths += 1
        x, y, _ = curve.at(0.0)
        self.get_logger().info(f"path {self._paths}: {curve.length:.3f} m from ({x:.3f}, {y:.3f}) m on")
        self._show(thinned(track, track.steps))

    def _reference_at(self, k: int, held: Pose) -> ReferencePoint:
        """What step k is compared with; before the first path, that the AGV stands where it is held to be."""
        found = self.reference[k + self._ahead]
        return ReferencePoint(*held, 0.0, 0.0) if found is None else found

    # -- by slots ----------------------------------------------------------------------------------------------------

    def _on_pose(self, data: bytes) -> None:
        try:
            ready = self._join.add_message(self._decode_pose(data))
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
        self._estimator.add_command(self._steps.of(command.stamp_ns), command.v, command.w)
        self._answer([])

    def _answer(self, ready: list[Joined[StampedPose]]) -> None:
        self._ready.extend(ready)
        while self._ready and self._may_answer():
            self._answer_one(self._ready.popleft())

    def _may_answer(self) -> bool:
        """A prediction waits for the command that answers the step before, unless the next step comes first."""
        if not self._estimator.uses_commands or len(self._ready) > 1:
            return True
        k = self.grid.step(self._ready[0].slot.stamp_ns)
        return k - 1 != self._answered or self._estimator.has_command(k - 1)

    def _answer_one(self, joined: Joined[StampedPose]) -> None:
        stamp_ns, pose = joined.slot.stamp_ns, joined.message
        if pose is None:
            self._blind += 1
            return
        k = self.grid.step(stamp_ns)
        if k == 0:
            self._forget_the_run_before()
        self._compare(k, self.grid.step(pose.stamp_ns), pose)

    # -- by its own clock --------------------------------------------------------------------------------------------

    def _keep_pose(self, data: bytes) -> None:
        beginnings = self._freshest.beginnings
        self._freshest.offer(self._decode_pose(data), self.get_clock().now().nanoseconds)
        if self._freshest.beginnings > beginnings:
            self._begin()

    def _begin(self) -> None:
        """The AGV has been heard for the first time, or has started anew."""
        first_ns, ts_ns = self._freshest.first_ns, self.grid.ts_ns
        if self.settings.begin == "first_pose":
            self.grid = Grid(first_ns, ts_ns)
        elif not 0 <= first_ns - self.grid.start_ns <= MAX_FIRST * ts_ns:
            self.fail(
                f"the first pose has the stamp {first_ns / NS_PER_S:.3f} s, which is in no run that begins at "
                f"start_time = {self.settings.start_time:g} s: set it, or set error_detector.begin to first_pose"
            )
            return
        self._steps = Steps(self.grid)
        self._forget_the_run_before()
        self._answered = -1
        # From here on, so that its ticks come just after the AGV's instants: a command must not be from the future.
        if self._timer is None:
            is_simulated = bool(self.get_parameter("use_sim_time").value)
            clock = self.get_clock() if is_simulated else self._steady
            self._timer = self.create_timer(self.settings.ts, self._tick, clock=clock)
        else:
            self._timer.reset()
        self._tick()

    def _tick(self) -> None:
        pose = self._freshest.pose
        if pose is None or self.finished:
            return
        time_ns = self._freshest.time(self.get_clock().now().nanoseconds)
        k = self._step_at(time_ns, self.grid.ts_ns // 100)
        if k <= self._answered:
            return
        self._missed += k - self._answered - 1 if self._answered >= 0 else 0
        stamp_ns = self.grid.stamp(k)
        self._oldest_ns = max(self._oldest_ns, stamp_ns - pose.stamp_ns)
        self.report_every_second(stamp_ns)
        self._age_out.publish(encode_slot(Slot(stamp_ns, pose.stamp_ns, TIMER)))
        self._compare(k, min(k, self._step_at(pose.stamp_ns, self.grid.ts_ns // 2)), pose)

    def _step_at(self, stamp_ns: int, early_ns: int) -> int:
        """The last step at an instant; one that is only `early_ns` ahead counts."""
        return max(0, (stamp_ns - self.grid.start_ns + early_ns) // self.grid.ts_ns)

    # -- either way --------------------------------------------------------------------------------------------------

    def _compare(self, k: int, taken: int, pose: StampedPose) -> None:
        """Publish the error of step k, as a pose tells it that was taken at step `taken`."""
        stamp_ns, received = self.grid.stamp(k), Pose(pose.x, pose.y, pose.theta)
        if isinstance(self.reference, PathReference):
            self.reference.begin(k)
        try:
            held, target = self._estimator.at(k, taken, received, lambda step: self._reference_at(step, received))
        except Exception as problem:  # another package's policy, in which anything can go wrong
            where = STALENESS_POLICIES.where(self.settings.policy)
            self.fail(f"{where} raises {type(problem).__name__}: {problem}, at step {k}")
            return
        now = self._reference_at(k, held)
        eps = tracking_error(*target, *held)
        self._answered = k
        error = TrackingError(stamp_ns, *eps, now.v, now.w)
        if self._horizon_out is not None:
            self._horizon_out.publish(self._horizon(k, held))
        here = now if self._ahead == 0 else self.reference[k] or now
        posture = StampedPose(stamp_ns, here.x, here.y, here.theta)
        if self._reference_out is not None:
            self._reference_out.publish(encode_pose(posture))
        self._transforms.send(posture)
        self._error_out.publish(encode_error(error, self.settings.frame_prefix))

    def _horizon(self, k: int, held: Pose) -> bytes:
        """Speeds of the reference from step k on, as far as the controller plans."""
        points = (self._reference_at(k + ahead, held) for ahead in range(self.settings.plan_steps + 1))
        ahead = SpeedsAhead(self.grid.stamp(k), tuple((point.v, point.w) for point in points))
        return encode_speeds(ahead, self.grid.ts_ns, self.settings.frame_prefix + FRAME_REFERENCE)

    def facts(self) -> dict[str, str]:
        """Slots that were not answered, by reason; or how the edge's clock and the AGV's get along. Paths that came."""
        paths = {"paths": str(self._paths)} if self.settings.track == PATH else {}
        if self.settings.trigger == TIMER:
            freshest = self._freshest
            return paths | {
                "clock offset": f"{freshest.offset_ns / NS_PER_S:.6f}",
                "oldest pose": f"{self._oldest_ns / NS_PER_S:.6f}",
                "stamps in the future": str(freshest.future),
                "outdated messages": str(freshest.outdated),
                "beginnings": str(freshest.beginnings),
                "missed steps": str(self._missed),
            }
        return paths | {
            "slots without any pose": str(self._blind),
            "slots whose pose never came": str(self._join.unanswered),
            "outdated messages": str(self._join.outdated),
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
