"""The AGV: publishes its pose, executes the commands that arrive, and keeps the loop's clock.

lockstep: step k + 1 follows the answer to step k, as fast as it comes. realtime: one step every T_s, with the newest
command held; the AGV stops when that is too old. A command that arrives within a period acts on the whole of it, as it
does in lockstep, where answers take no time.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from geometry_msgs.msg import PoseStamped, TwistStamped
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import TimeReference
from trajectory_msgs.msg import MultiDOFJointTrajectory

from agv_plant.deadline_monitor import DeadlineMonitor
from agv_plant.downlink_policy import DOWNLINK_POLICIES, share_of_command
from agv_plant.parameters import PlantParameters
from agv_plant.progress_line import progress_line
from agv_plant.random_stream import normals_of
from agv_plant.vehicle.motion import NOISE, SLIP, Motion, measured, move, vehicle_parameters, vehicle_step
from agv_plant.vehicle.registry import VEHICLES
from agv_plant.zero_order_hold import ZeroOrderHold
from agv_ros.clock_mode import LOCKSTEP, ClockMode
from agv_ros.codec import decode_command, decode_slot, encode_clock, encode_pose, stamp_of
from agv_ros.endpoints import RECORDER
from agv_ros.executor import run_node
from agv_ros.message_sync import Joined, MessageSync
from agv_ros.messages import FRAME_AGV, Command, InvalidMessageError, StampedPose
from agv_ros.node import LoopNode
from agv_ros.parts import complaint
from agv_ros.pose import Pose
from agv_ros.speeds_codec import decode_speeds
from agv_ros.stamps import to_nanoseconds
from agv_ros.stopping import STOPPED_BY
from agv_ros.substitution import replaced
from agv_ros.transforms import TransformBroadcaster

D = TypeVar("D")

_REPEAT_AFTER, _REPEAT_AFTER_WAITING = 0.5, 4.0
"""Lockstep: a pose is sent again after this time [s] without an answer, if a peer may have come up after it.

Later where this node has waited for subscribers, who may yet have been others than its peers: a busy machine alone
shall not make a run differ, and what DDS itself has lost it brings after 3 s.
"""

_FOUND_BY_ALL = 3.2
"""Time [s] by which a node is found by all others: what DDS has lost of its announcements it repeats after 3 s."""

_PEERS = (("edge/slot", "relay"), ("edge/error", "error_detector"), ("edge/cmd_vel", "controller"))
"""A topic that each peer publishes, in the order in which a step passes them."""


_ONCE = (("agv/pose", "plant"), *_PEERS, ("agv/slot", "relay"), ("agv/cmd_vel", "relay"), ("/clock", "plant"))
"""What one node alone publishes, or else two loops have become one."""


class PlantNode(LoopNode[PlantParameters]):
    """Owns the state X_c(k) and decides when k becomes k + 1."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("plant", PlantParameters, **node_options)
        settings = self.settings
        self.k = 0
        self.steps = math.inf if math.isinf(settings.duration) else max(1, round(settings.duration / settings.ts))
        self._steps_per_line = max(1, round(self.steps / 20 if math.isfinite(self.steps) else 10.0 / settings.ts))
        vehicle = VEHICLES.find(settings.vehicle)
        self._motion = Motion(*settings.initial_pose, states=(0.0,) * len(vehicle.states))
        self._vehicle = vehicle_parameters(settings)
        self._move = replaced(move, {vehicle_step: vehicle.adapter})
        self._noise = normals_of(settings.seed, NOISE)
        self._slip = normals_of(settings.seed, SLIP)
        self._downlink_policy = DOWNLINK_POLICIES.index(settings.downlink_policy)
        self._join: MessageSync[Command] = MessageSync(self.grid.start_ns)
        timeout_ns = to_nanoseconds(settings.cmd_vel_timeout)
        self._held = ZeroOrderHold(timeout_ns, timeout_ns)
        self.deadline_monitor = DeadlineMonitor(self.grid.ts_ns, self.steps)
        self._lockstep = settings.clock == LOCKSTEP
        self._pose_out = self.output(PoseStamped, "agv/pose")
        self._clock_out = self.output(Clock, "/clock", side=True)
        self._mode_out = ClockMode(self, "agv")
        self._mode_out.say(settings.clock)
        self._truth_out = self.output(PoseStamped, "agv/ground_truth", side=True) if settings.is_noisy else None
        self._transforms = TransformBroadcaster(self, FRAME_AGV)
        self._plans: dict[int, tuple[tuple[float, float], ...]] = {}
        # First the slots: a relay waits for a subscriber of the commands, and then has that of the slots, too.
        self.input(TimeReference, "agv/slot", self._on_slot)
        if settings.plan_steps:
            self.input(MultiDOFJointTrajectory, "agv/plan", self._on_plan)
        else:
            self.input(TwistStamped, "agv/cmd_vel", self._on_command)
        self._may_begin = 0.0
        self._begin_by = time.monotonic() + settings.start_timeout
        self.poll(self._begin)

    def on_stop(self, reason: str) -> None:
        """A run that was to have a certain length has not come to its end."""
        super().on_stop(reason)
        if math.isfinite(self.steps):
            self.failure = f"{self.get_name()} was {STOPPED_BY}{reason} at {progress_line(self.k, self.steps)}"

    def is_settled(self) -> bool:
        """The loop ends with its clock: what is under way to the AGV belongs to a step that it does not finish."""
        return True

    @property
    def state(self) -> Pose:
        """The true pose."""
        return Pose(*self._motion[:3])

    def _begin(self) -> bool:
        wanted = max(self.settings.wait_for_subscribers, self._lockstep)
        if not all(output.is_heard(wanted) for output in self.outputs):
            if time.monotonic() > self._begin_by:
                self.fail(self._not_begun(wanted))
            return self.finished
        if self.settings.wait_for_subscribers == 1 and self._waits_for_recorder():
            return False
        if rivals := [f"another {node} publishes {topic}" for topic, node in _ONCE if self._publishers_of(topic) > 1]:
            remap = ", with -r /clock:=clock -r /diagnostics:=diagnostics," if "/clock" in " ".join(rivals) else ""
            self.fail(f"{', '.join(rivals)}: use another namespace{remap} or ROS_DOMAIN_ID")
        elif self._lockstep:
            self._watch_for_answers()
            self._publish()
        else:
            self._keep_time()
        return True

    def _waits_for_recorder(self) -> bool:
        """May a recorder that is there not have been found yet by all nodes? Then the loop begins a little later."""
        if RECORDER not in self.get_node_names():
            return False
        self._may_begin = self._may_begin or time.monotonic() + _FOUND_BY_ALL
        return time.monotonic() < self._may_begin

    def _publishers_of(self, topic: str) -> int:
        """How many nodes publish what this node calls `topic`."""
        return int(self.count_publishers(self.resolve_topic_name(topic)))

    def _not_begun(self, wanted: int) -> str:
        """Why the loop has not begun: who does not listen, or is not there."""
        few = next(output.topic for output in self.outputs if not output.is_heard(wanted))
        missing = self._silent() or ("recorder" if wanted > 1 else "relay")
        return (
            f"the loop has not begun within {self.settings.start_timeout:g} s: {few} has fewer listeners "
            f"than it waits for ({wanted}): is the {missing} running?"
        )

    # -- the loop ----------------------------------------------------------------------------------------------------

    def _publish(self) -> None:
        stamp_ns = self.grid.stamp(self.k)
        self.report_every_second(stamp_ns)
        pose = self._measured_pose()
        self._clock_out.publish(encode_clock(stamp_ns))
        if self._truth_out is not None:
            self._truth_out.publish(encode_pose(StampedPose(stamp_ns, *self.state)))
        self._transforms.send(pose)
        self._pose_out.publish(encode_pose(pose))

    def _measured_pose(self) -> StampedPose:
        """The pose that the AGV publishes at step k."""
        plant, stamp_ns = self.settings, self.grid.stamp(self.k)
        if not plant.is_noisy:
            return StampedPose(stamp_ns, *self.state)
        n_x, n_y, n_theta, _ = self._noise.at(self.k)
        return StampedPose(stamp_ns, *measured(*self.state, n_x, n_y, n_theta, plant.noise_xy, plant.noise_theta))

    def _advance(self, command: Command) -> None:
        """From step k to k + 1 under the newest command."""
        plant, age = self.settings, (self.grid.stamp(self.k) - command.stamp_ns) // self.grid.ts_ns
        v, w = command.v, command.w
        if plant.downlink_policy == "buffer":
            plan = self._plan_of(command)
            v, w = plan[min(age, len(plan) - 1)]
        share = share_of_command(age, self._downlink_policy, plant.policy_steps)
        n_left, n_right = self._slip.at(self.k)[:2] if plant.slip_noise > 0.0 else (0.0, 0.0)
        try:
            motion = self._move(self._motion, share * v, share * w, n_left, n_right, self._vehicle)
        except Exception as problem:  # another package's vehicle, in which anything can go wrong
            self.fail(f"{VEHICLES.find(plant.vehicle).where} {complaint(problem)}, at step {self.k}")
            return
        if not all(map(math.isfinite, motion[:3])):
            self.fail(f"the loop diverged: after step {self.k} the pose {self.state} is no longer finite")
            return
        self._motion = motion
        self.k += 1
        if self.k >= self.steps:
            self.finished = True
        else:
            self._publish()
        if self.k % self._steps_per_line == 0:
            self.get_logger().info(progress_line(self.k, self.steps))

    def _plan_of(self, command: Command) -> tuple[tuple[float, float], ...]:
        """The plan that came with a command, which is its first step; those before it are forgotten."""
        self._plans = {ns: plan for ns, plan in self._plans.items() if ns >= command.stamp_ns}
        return self._plans.get(command.stamp_ns, ((command.v, command.w),))

    def _on_plan(self, data: bytes) -> None:
        plan = self._decoded(decode_speeds, data)
        self._plans[plan.stamp_ns] = plan.speeds
        self._take(Command(plan.stamp_ns, *plan.speeds[0]))

    def _on_command(self, data: bytes) -> None:
        self._take(self._decoded(decode_command, data))

    def _decoded(self, decode: Callable[[bytes], D], data: bytes) -> D:
        """A command or plan; of one that cannot be used, its slot goes on without it."""
        try:
            return decode(data)
        except InvalidMessageError:
            self._answer(self._join.reject(stamp_of(data)))
            raise

    def _take(self, command: Command) -> None:
        if self._lockstep:
            self._refuse_later(command.stamp_ns)
            self._answer(self._join.add_message(command))
        else:
            self._held.offer(command)

    def _on_slot(self, data: bytes) -> None:
        slot = decode_slot(data)
        if self._lockstep:
            self._refuse_later(slot.stamp_ns)
            self._answer(self._join.add_slot(slot))

    def _refuse_later(self, stamp_ns: int) -> None:
        """Raise InvalidMessageError for an answer to a step that has not been asked for."""
        if self._pose_out.count and stamp_ns > self.grid.stamp(self.k):
            raise InvalidMessageError(
                f"answers a step after {self.k}, which has not been asked for: who else sends it?"
            )

    # -- lockstep ----------------------------------------------------------------------------------------------------

    def _answer(self, ready: list[Joined[Command]]) -> None:
        for joined in ready:
            stamp_ns = joined.slot.stamp_ns
            asked = self._pose_out.count > 0  # what came before the first pose answers another run's
            if asked and stamp_ns == self.grid.stamp(self.k) and not self.finished:
                self._advance(joined.message or Command(stamp_ns, 0.0, 0.0))

    def _watch_for_answers(self) -> None:
        """Give up, naming the missing peer, when a step stays without an answer for too long."""
        seen, since, repeated, known = -1, time.monotonic(), time.monotonic(), self._peers()
        patience = _REPEAT_AFTER_WAITING if self.settings.wait_for_subscribers else _REPEAT_AFTER

        def watch() -> None:
            nonlocal seen, since, repeated, known
            now = time.monotonic()
            if self.k != seen:
                if seen <= 0 or repeated > since:
                    known = self._peers()
                seen, since = self.k, now
            elif now - since > self.settings.answer_timeout:
                self.fail(self._no_answer())
            elif now - max(since, repeated) > patience and self._pose_out.count and self._may_be_lost(known):
                repeated = now
                self._pose_out.publish(encode_pose(self._measured_pose()))

        self.create_timer(min(0.1, self.settings.answer_timeout / 4.0), watch, clock=self._steady)

    def _peers(self) -> frozenset[tuple[str, bytes]]:
        """Who publishes what the plant waits for: topic and identity of each publisher."""
        return frozenset(
            (topic, bytes(info.endpoint_gid))
            for topic, _ in _PEERS
            for info in self.get_publishers_info_by_topic(self.resolve_topic_name(topic))
        )

    def _may_be_lost(self, known: frozenset[tuple[str, bytes]]) -> bool:
        """Was the pose of this step possibly sent before a peer was up, at the start or after a restart?"""
        peers = self._peers()
        return self.k == 0 or (peers != known and {topic for topic, _ in peers} == {topic for topic, _ in _PEERS})

    def _silent(self) -> str:
        """The first peer that is not there, empty if all are."""
        silent = next((peer for topic, peer in _PEERS if not self.count_publishers(topic)), "")
        if silent == "relay" and self.count_publishers("agv/slot"):  # the edge has a domain of its own
            return "edge, with error_detector and controller,"
        return silent

    def _no_answer(self) -> str:
        silent = self._silent()
        question = (
            f"is the {silent} running?"
            if silent
            else "all nodes are known, but one that was killed still is for some 20 s: do all of them run, with the "
            "same ts and start_time, and does each hear the one before it?"
        )
        return f"no answer to step {self.k} on agv/cmd_vel within {self.settings.answer_timeout:g} s: {question}"

    # -- realtime ----------------------------------------------------------------------------------------------------

    def _keep_time(self) -> None:
        self.deadline_monitor.start(time.monotonic_ns())
        self._publish()
        self.create_timer(self.settings.ts, self._tick, clock=self._steady)

    def _tick(self) -> None:
        due = self.deadline_monitor.tick(time.monotonic_ns())
        while self.k < due and not self.finished:
            self._advance(self._held.at(self.grid.stamp(self.k + 1)))

    def facts(self) -> dict[str, str]:
        """Progress; in realtime also deadlines and what became of commands."""
        facts = {"step": str(self.k)}
        if not self._lockstep:
            facts |= self.deadline_monitor.facts()
            facts |= {"stops without command": str(self._held.stops), "outdated commands": str(self._held.outdated)}
        return facts


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of the executable `plant`."""
    run_node(PlantNode, args)


if __name__ == "__main__":
    main()
