"""The radio link: the only way between the AGV and the edge."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import PoseStamped, TwistStamped
from sensor_msgs.msg import TimeReference

from agv_plant.parameters import RelayParameters
from agv_plant.radio import Channel, Link
from agv_ros.executor import run_node
from agv_ros.node import LoopNode, Output
from agv_ros.wire import DELIVERED, Slot, encode_slot, stamp_of


class RelayNode(LoopNode[RelayParameters]):
    """Forwards or loses each message as it is, and says which in the slot."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("relay", RelayParameters, **node_options)
        settings = self.settings
        self.uplink = Link(Channel(settings.uplink, settings.seed, "uplink"), self.grid)
        self.downlink = Link(Channel(settings.downlink, settings.seed, "downlink"), self.grid)
        self._edge_pose = self.output(PoseStamped, "edge/pose")
        self._edge_slot = self.output(TimeReference, "edge/slot")
        self._agv_cmd_vel = self.output(TwistStamped, "agv/cmd_vel")
        self._agv_slot = self.output(TimeReference, "agv/slot")
        self.input(PoseStamped, "agv/pose", self._on_pose, self._edge_pose, self._edge_slot)
        self.input(TwistStamped, "edge/cmd_vel", self._on_command, self._agv_cmd_vel, self._agv_slot)

    def _on_pose(self, data: bytes) -> None:
        slot = self.uplink.transmit(stamp_of(data))
        self.report_every_second(slot.stamp_ns)
        _pass_on(data, slot, self._edge_pose, self._edge_slot)

    def _on_command(self, data: bytes) -> None:
        _pass_on(data, self.downlink.transmit(stamp_of(data)), self._agv_cmd_vel, self._agv_slot)

    def facts(self) -> dict[str, str]:
        """What each link did to its messages so far."""
        return _counts("uplink", self.uplink) | _counts("downlink", self.downlink)

    def on_settings(self) -> None:
        """Changed loss parameters hold from the next slot on."""
        self.uplink.channel.parameters = self.settings.uplink
        self.downlink.channel.parameters = self.settings.downlink


def _counts(name: str, link: Link) -> dict[str, str]:
    rate = link.lost / link.sent if link.sent else 0.0
    return {
        f"{name} sent": str(link.sent),
        f"{name} lost": str(link.lost),
        f"{name} loss rate": f"{rate:.6f}",
        f"{name} longest outage": str(link.longest),
    }


def _pass_on(data: bytes, slot: Slot, forward: Output, verdict: Output) -> None:
    if slot.verdict == DELIVERED:
        forward.publish(data)
    verdict.publish(encode_slot(slot))


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of the executable `relay`."""
    run_node(RelayNode, args)


if __name__ == "__main__":
    main()
