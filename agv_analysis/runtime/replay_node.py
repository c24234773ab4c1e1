"""The player: sends recorded slots and poses to the edge's nodes again, and collects their answers."""

from __future__ import annotations

import time
from collections.abc import Collection
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import TimeReference

from agv_analysis.bags.writer import REPLAY_OF
from agv_analysis.runtime.edge_inputs import EdgeInputs, SlotInput
from agv_analysis.runtime.recorder_node import PUBLISHERS, TOPICS, RecorderNode
from agv_ros.codec import decode_command, decode_error, encode_clock
from agv_ros.endpoints import LOOP_QOS
from agv_ros.messages import Command, TrackingError
from agv_ros.node import LoopNode
from agv_ros.parameters import LoopParameters

_PATIENCE = 10.0
"""How long [s] the edge may take for an answer, before it is given up."""

_START_PATIENCE = 30.0
"""How long [s] nodes may take to start and to find each other."""

_TICK = 0.001
"""How often [s] the player checks what is due."""

_SLOW_TICK = 0.1
"""How often [s] it checks for missing answers, where the answers decide what is due."""

_AGAIN = 0.5
"""After how long [s] without an answer a slot is sent again to nodes that run already."""

_MOST_EXTRA = 8
"""Most extra subscriptions that are made for nodes which wait for more subscribers than there are."""

_ANSWERS: dict[str, type] = {"edge/error": Odometry, "edge/cmd_vel": TwistStamped}


class Pace(NamedTuple):
    """When the next slot is played."""

    lockstep: bool = False
    """As soon as the edge has answered the one before."""
    rate: float = 1.0
    """Otherwise: seconds of the recording per second."""


class ReplayRecorder(RecorderNode):
    """Records what is played and answered, and beside it what was recorded on the AGV's side of the radio.

    These messages go to the new bag alone, not over DDS, where a real AGV might listen to them.
    """

    def __init__(self, source: str, counted: Collection[str], **node_options: Any) -> None:
        """`source`: the recording; `counted`: nodes that began with this replay, and so say how much is to be here."""
        self._source, self._counted = source, counted
        super().__init__(**node_options)
        self._record = {topic: self._receiver(number) for number, topic in enumerate(TOPICS)}
        self._number = {topic: number for number, topic in enumerate(TOPICS)}
        self.player: ReplayNode | None = None

    def asked(self) -> dict[str, str]:
        """The edge's nodes: there are no others in a replay."""
        return {node: PUBLISHERS[node] for node in ("error_detector", "controller")}

    def about(self) -> dict[str, str]:
        """What is embedded in the bag."""
        return super().about() | {REPLAY_OF: self._source}

    def record(self, topic: str, data: bytes) -> None:
        """Take a message of the recording as it is."""
        self._record[topic](data)

    def count(self, topic: str) -> int:
        """Messages of a topic so far."""
        return self._writer.counts[self._number[topic]]

    def missing(self) -> dict[str, int]:
        """Messages by topic that nodes say they have published, or that the player has heard, and that are not here."""
        heard = self.player.heard if self.player is not None else {}
        late = {self._names[self._number[topic]]: count - self.count(topic) for topic, count in heard.items()}
        return {topic: count for topic, count in late.items() if count > 0} | super().missing()

    def _note(self, diagnostics: DiagnosticArray) -> None:
        diagnostics.status = [status for status in diagnostics.status if status.name in self._counted]
        super()._note(diagnostics)


class ReplayNode(LoopNode[LoopParameters]):
    """Publishes edge/pose, edge/slot and /clock as recorded, and keeps the edge's answers by step.

    Nodes that run already may hear the player before all of them hear each other, or the player hears them: one sees
    of DDS only who is connected to oneself. So a slot is sent to them again until its answers are here, the first one
    until they are in the recording, too: it is answered again, by the same. From then on nothing is lost.
    """

    def __init__(self, inputs: EdgeInputs, pace: Pace, edge_runs: bool = False, **node_options: Any) -> None:
        """`edge_runs`: the nodes of the edge have been started elsewhere."""
        super().__init__("replay", LoopParameters, **node_options)
        self.k = 0
        """Number of slots played."""
        self.errors: dict[int, TrackingError] = {}
        self.commands: dict[int, Command] = {}
        self.recorder: ReplayRecorder | None = None
        self._slots, self._pace, self._edge_runs = inputs.slots, pace, edge_runs
        self._waits_for: int | None = None
        self._is_connected = False
        self._unanswered = {slot.k for slot in inputs.slots if slot.is_answered}
        self._heard = self._sent = time.monotonic()
        self._begun_ns = 0
        self._extra_subscriptions: list[Subscription] = []
        self._pose_out = self.output(PoseStamped, "edge/pose")
        self._slot_out = self.output(TimeReference, "edge/slot")
        self._clock_out = self.output(Clock, "/clock", side=True)
        self.input(Odometry, "edge/error", self._on_error)
        self.input(TwistStamped, "edge/cmd_vel", self._on_command)
        self.poll(self._begin)

    @property
    def heard(self) -> dict[str, int]:
        """Steps that were answered, by topic."""
        return {"edge/error": len(self.errors), "edge/cmd_vel": len(self.commands)}

    # -- before the first slot ---------------------------------------------------------------------------------------

    def _begin(self) -> bool:
        """Only once the controller receives from the error detector and is connected to us, so that nothing is lost."""
        missing = self._who_is_missing()
        if missing:
            waited = time.monotonic() - self._heard
            if waited > _START_PATIENCE:
                self.fail(f"{missing}, waited for {_START_PATIENCE:g} s")
            elif self._edge_runs and len(self._extra_subscriptions) < min(_MOST_EXTRA, int(waited)) * len(_ANSWERS):
                self._add_subscriptions()
            return self.finished
        if max(self.count_publishers("edge/slot"), self.count_publishers("edge/pose")) > 1:
            self.fail("a relay runs already and publishes edge/slot: use another namespace or ROS_DOMAIN_ID")
            return True
        while self._extra_subscriptions:
            self.destroy_subscription(self._extra_subscriptions.pop())
        self._heard, self._begun_ns = time.monotonic(), time.monotonic_ns()
        self._play_what_is_due()
        self.create_timer(_SLOW_TICK if self._pace.lockstep else _TICK, self._tick, clock=self._steady)
        return True

    def _who_is_missing(self) -> str:
        if not all(output.is_heard(self.settings.wait_for_subscribers) for output in self.outputs):
            return "no error detector listens to edge/pose and edge/slot"
        own = 1 + len(self._extra_subscriptions) // len(_ANSWERS) + (self.recorder is not None)
        if self.count_subscribers("edge/error") <= own or not self.count_publishers("edge/cmd_vel"):
            return "no controller listens to edge/error and sends edge/cmd_vel"
        return ""

    def _add_subscriptions(self) -> None:
        """One more subscription to each answer, for nodes that wait for more of them than a replay has."""
        for topic, kind in _ANSWERS.items():
            self._extra_subscriptions.append(self.create_subscription(kind, topic, lambda _: None, LOOP_QOS, raw=True))

    def _is_all_heard(self, k: int) -> bool:
        """Have the answers to step k reached both us and the recording?"""
        recorded = self.recorder is None or all(self.recorder.count(topic) for topic in _ANSWERS)
        return recorded and k in self.errors and k in self.commands

    # -- slot by slot ------------------------------------------------------------------------------------------------

    def _tick(self) -> None:
        if self._waits_for is not None and self._is_all_heard(self._waits_for):
            self._go_on()
        elif self._waits_for is not None and self._edge_runs and time.monotonic() - self._sent > _AGAIN:
            self._send(self._slots[self.k - 1])
        self._play_what_is_due()
        if self._waits_for is None and self.k < len(self._slots):
            self._heard = time.monotonic()  # no answer is pending: the recording pauses
        elif time.monotonic() - self._heard > _PATIENCE:
            first = min(self._unanswered) if self._waits_for is None else self._waits_for
            self.fail(f"the edge does not answer step {first}, waited for {_PATIENCE:g} s")

    def _play_what_is_due(self) -> None:
        while self.k < len(self._slots) and self._waits_for is None and self._is_due():
            self._play()
        if self.k == len(self._slots) and not self._unanswered:
            self.finished = True

    def _passed_ns(self, slot: SlotInput) -> int:
        """When the slot is due, after the first one [ns]."""
        return round((slot.stamp_ns - self._slots[0].stamp_ns) / self._pace.rate)

    def _is_due(self) -> bool:
        due_ns = self._begun_ns + self._passed_ns(self._slots[self.k])
        return self._pace.lockstep or time.monotonic_ns() >= due_ns

    def _play(self) -> None:
        now = self._slots[self.k]
        self.report_every_second(now.stamp_ns)
        self._send(now)
        if self.recorder is not None:
            for topic, data in now.agv_side:
                self.recorder.record(topic, data)
        if now.is_answered and (self._pace.lockstep or not self._is_connected):
            self._waits_for = now.k
        self.k += 1

    def _send(self, slot: SlotInput) -> None:
        self._sent = time.monotonic()
        self._clock_out.publish(encode_clock(slot.stamp_ns))
        if slot.pose is not None:
            self._pose_out.publish(slot.pose)
        self._slot_out.publish(slot.slot)

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
        if k in self.errors and k in self.commands:
            self._unanswered.discard(k)
            if self._waits_for == k and (self._is_connected or self._is_all_heard(k)):
                self._go_on()
        if self._is_connected:
            self._heard = time.monotonic()
            self._play_what_is_due()

    def _go_on(self) -> None:
        """The step that was waited for is answered; time goes on from the first that is."""
        if not self._is_connected:
            self._is_connected = True
            self._heard = time.monotonic()
            self._begun_ns = time.monotonic_ns() - self._passed_ns(self._slots[self.k - 1])
        self._waits_for = None
