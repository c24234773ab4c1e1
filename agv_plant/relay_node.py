"""The radio link: the only way between the AGV and the edge.

With a DDS domain for each of them that holds by construction, and the relay checks that nothing bypasses it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import TimeReference
from trajectory_msgs.msg import MultiDOFJointTrajectory

from agv_plant.channels.position_dependent import NOWHERE
from agv_plant.parameters import RelayParameters
from agv_plant.radio.channel import Channel
from agv_plant.radio.link import Link, Passage
from agv_ros.clock_mode import ClockMode, hear_clock_mode, window_of
from agv_ros.codec import decode_command, encode_slot, encode_twist, pose_decoder, stamp_of
from agv_ros.endpoints import Output
from agv_ros.executor import run_node
from agv_ros.message_types import ODOMETRY, TWIST
from agv_ros.messages import InvalidMessageError
from agv_ros.node import LoopNode

_LOOK_PERIOD = 1.0
"""How often [s] the relay checks that nothing but itself connects the AGV's domain and the edge's."""


class RelayNode(LoopNode[RelayParameters]):
    """Forwards, delays or loses each message unchanged, and reports the outcome in the slot."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("relay", RelayParameters, **node_options)
        settings = self.settings
        keeps_to_grid = settings.stamps == "grid"
        self.uplink, self.downlink = (
            Link(Channel(channel, settings.seed, name, settings.ts), self.grid, keeps_to_grid, settings.window_steps)
            for name, channel in (("uplink", settings.uplink), ("downlink", settings.downlink))
        )
        self._needs_place = settings.uplink.is_placed or settings.downlink.is_placed
        self._place = NOWHERE
        self._decode_pose, self._loses_stamp = pose_decoder(settings.pose_type), settings.command_type == TWIST
        pose_kind = Odometry if settings.pose_type == ODOMETRY else PoseStamped
        kind, self._command = (MultiDOFJointTrajectory, "plan") if settings.plan_steps else (TwistStamped, "cmd_vel")
        self._agv, self._edge = self.in_domain(settings.plant_domain_id), self.in_domain(settings.edge_domain_id)
        self._edge_pose = self.output(pose_kind, "edge/pose", on=self._edge)
        self._edge_slot = self.output(TimeReference, "edge/slot", optional=True, on=self._edge)
        self._agv_cmd_vel = self.output(Twist if self._loses_stamp else kind, f"agv/{self._command}", on=self._agv)
        self._agv_slot = self.output(TimeReference, "agv/slot", optional=True, on=self._agv)
        self.input(pose_kind, "agv/pose", self._on_pose, self._edge_pose, self._edge_slot, on=self._agv)
        self.input(kind, f"edge/{self._command}", self._on_command, self._agv_cmd_vel, self._agv_slot, on=self._edge)
        self._mode_out = ClockMode(self._edge, "edge")
        hear_clock_mode(self._agv, "agv", self._on_clock_mode)
        if self._agv is not self._edge:
            self.create_timer(_LOOK_PERIOD, self._look_for_ways_around, clock=self._steady)

    def _look_for_ways_around(self) -> None:
        """End the run if anything but this relay joins the domains of the AGV and of the edge."""
        ways = [
            (self._edge, "agv/pose", 0), (self._edge, "edge/pose", 1),
            (self._agv, f"edge/{self._command}", 0), (self._agv, f"agv/{self._command}", 1),
        ]  # fmt: skip
        for side, topic, own in ways:
            if side.count_publishers(topic) > own:
                self.fail(
                    f"{topic} comes into domain {side.context.get_domain_id()} around the relay: "
                    "this run would not show the effect of the channel; stop whatever else publishes it there"
                )

    def _on_clock_mode(self, mode: str) -> None:
        """The AGV says which clock the loop has; the edge is to know it, too."""
        for link in (self.uplink, self.downlink):
            link.limit_window(window_of(mode, self.settings.window_steps))
        self._mode_out.say(mode)

    def _on_pose(self, data: bytes) -> None:
        if self._agv is not self._edge and not self.uplink.sent:
            self._look_for_ways_around()  # before the first pose is passed on, and every now and then from then on
        if self._needs_place:
            self._place = self._place_in(data)
        passage = self.uplink.transmit(stamp_of(data), data, self._place)
        self.report_every_second(passage.slot.stamp_ns)
        _pass_on(passage, self._edge_pose, self._edge_slot)

    def _on_command(self, data: bytes) -> None:
        passed_on = encode_twist(decode_command(data)) if self._loses_stamp else data
        passage = self.downlink.transmit(stamp_of(data), passed_on, self._place)
        _pass_on(passage, self._agv_cmd_vel, self._agv_slot)

    def _place_in(self, pose: bytes) -> tuple[float, float]:
        """Where a pose says that the AGV is [m]; the last place if it cannot be read, which its receiver reports."""
        try:
            return self._decode_pose(pose)[1:3]
        except InvalidMessageError:
            return self._place

    def facts(self) -> dict[str, str]:
        """What each link did to its messages so far."""
        return self.uplink.facts("uplink") | self.downlink.facts("downlink")

    def on_settings(self) -> None:
        """Changed loss parameters hold from the next slot on."""
        self.uplink.channel.parameters = self.settings.uplink
        self.downlink.channel.parameters = self.settings.downlink


def _pass_on(passage: Passage, forward: Output, outcome: Output) -> None:
    for data in passage.arrived:
        forward.publish(data)
    outcome.publish(encode_slot(passage.slot))


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of the executable `relay`."""
    run_node(RelayNode, args)


if __name__ == "__main__":
    main()
