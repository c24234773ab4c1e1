"""A radio link for topics of any type: what crosses it is lost, late or doubled as a channel of this package says.

Messages are passed on as they are, serialised. Types and QoS are those that the publishers offer, once there is one. A
latched topic is state that DDS sends to later subscribers, so it is passed on without loss. Services, actions and
parameters are left alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import TimeReference

from agv_plant.channels.position_dependent import NOWHERE
from agv_plant.channels.registry import TRACE
from agv_plant.channels.timed_trace import read_trace
from agv_plant.emulator_parameters import DirectionParameters, LinkEmulatorParameters
from agv_plant.radio.channel import Channel
from agv_plant.radio.message_link import Fate, MessageLink, UnderWay
from agv_ros.codec import encode_slot, pose_decoder
from agv_ros.endpoints import Offer, Output, message_class, offer_of
from agv_ros.errors import UserError
from agv_ros.executor import run_node
from agv_ros.message_types import ODOMETRY
from agv_ros.messages import Slot
from agv_ros.node import LoopNode
from agv_ros.parameters import ParameterError
from agv_ros.stamps import to_nanoseconds

_LOOK_PERIOD = 0.1
"""How often [s] the emulator looks who publishes and who listens."""

_REPORT_PERIOD = 1.0
"""How often [s] it reports."""

_TICK = 0.001
"""How often [s] it looks which late messages have arrived, while there are any."""

Deliver = Callable[[], None]


class LinkEmulatorNode(LoopNode[LinkEmulatorParameters]):
    """Both directions of the radio, with all topics that cross it."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("link_emulator", LinkEmulatorParameters, **node_options)
        settings = self.settings
        agv, edge = self.in_domain(settings.plant_domain_id), self.in_domain(settings.edge_domain_id)
        self.place, self._decode_pose = NOWHERE, pose_decoder(settings.pose_type)
        self.under_way: UnderWay[Deliver] = UnderWay()
        self.topics: list[EmulatedTopic] = []
        self.links: dict[str, list[MessageLink]] = {}
        """By direction: one, or one for each topic."""
        for name, source, sink in (("uplink", agv, edge), ("downlink", edge, agv)):
            self._make_direction(name, settings.directions[name], source, sink)
        if not self.topics:
            raise ParameterError(
                "no topic crosses the link: name some, as in -p uplink.topics:=[/scan] -p downlink.topics:=[/cmd_vel]"
            )
        if settings.pose_topic:
            kind = Odometry if settings.pose_type == ODOMETRY else PoseStamped
            self.input(kind, settings.pose_topic, self._on_pose, on=agv)
        self._tick = self.create_timer(_TICK, self._deliver, clock=self._steady)
        self._tick.cancel()
        self._look()
        self.create_timer(_LOOK_PERIOD, self._look, clock=self._steady)
        self.create_timer(_REPORT_PERIOD, self._report_now, clock=self._steady)

    def _make_direction(self, name: str, direction: DirectionParameters, source: Node, sink: Node) -> None:
        verdicts = self.output(TimeReference, f"{name}/verdict", side=True)
        ways = direction.ways(name, self.settings.has_domains)
        own = [f"{name}{heard}" for heard, _ in ways] if not direction.one_fate else [name] * bool(ways)
        links = [self._link(name, stream, direction) for stream in own]
        self.links[name] = links
        for number, (heard, called) in enumerate(ways):
            link = links[0 if direction.one_fate else number]
            self.topics.append(EmulatedTopic(self, heard, called, source, sink, link, verdicts))

    def _link(self, name: str, stream: str, direction: DirectionParameters) -> MessageLink:
        ts = direction.period or self.settings.ts
        is_trace = direction.model == TRACE
        if is_trace and not direction.period and read_trace(direction.trace_file, name).time is not None:
            raise ParameterError(f"{name}.trace_file has times, which slots need: set {name}.period, a slot's length")
        # All topics meet one measured outcome, whose column has the direction's name.
        channel = Channel(direction, self.settings.seed, name if is_trace else stream, ts)
        return MessageLink(channel, to_nanoseconds(ts), direction.period > 0.0)

    # -- what arrives later ------------------------------------------------------------------------------------------

    def send(self, arrival_ns: int, deliver: Deliver) -> None:
        """Deliver a message later."""
        self.under_way.add(arrival_ns, deliver)
        if self._tick.is_canceled():
            self._tick.reset()

    def _deliver(self) -> None:
        for deliver in self.under_way.arrived(time.monotonic_ns()):
            deliver()
        if not self.under_way:
            self._tick.cancel()

    def is_settled(self) -> bool:
        """Has all that is under way arrived?"""
        return not self.under_way

    # -- around it ---------------------------------------------------------------------------------------------------

    def _look(self) -> None:
        for topic in self.topics:
            topic.look()

    def _on_pose(self, data: bytes) -> None:
        self.place = self._decode_pose(data)[1:3]

    def _report_now(self) -> None:
        self._last_ns = self.get_clock().now().nanoseconds
        self.report(self._last_ns)

    def on_settings(self) -> None:
        """Changed loss parameters hold from the next slot on."""
        for name, direction in self.settings.directions.items():
            for link in self.links[name]:
                link.channel.parameters = direction

    def facts(self) -> dict[str, str]:
        """What each direction, and each topic, did to its messages so far."""
        facts: dict[str, str] = {}
        for name, links in self.links.items():
            if len(links) == 1:
                facts |= links[0].facts(name)
        for topic in self.topics:
            facts |= topic.facts()
        return facts | {"under way": str(len(self.under_way))}


class EmulatedTopic:
    """A topic on its way across the radio."""

    def __init__(
        self, node: LinkEmulatorNode, heard: str, called: str, source: Node, sink: Node, link: MessageLink,
        verdicts: Output,
    ) -> None:  # fmt: skip
        self.heard, self.called = source.resolve_topic_name(heard), sink.resolve_topic_name(called)
        self._node, self._source, self._sink = node, source, sink
        self._link, self._verdicts = link, verdicts
        self._are_verdicts_heard = False
        self._offer: Offer | None = None
        self._subscription: Any = None
        self._publisher: Any = None
        self._refusal = ""
        self.sent = self.lost = self.bytes = 0

    def look(self) -> None:
        """Follow what the publishers offer; before there is one, nothing can be done."""
        self._are_verdicts_heard = self._verdicts.is_heard(2)
        offer = offer_of(self._source, self.heard)
        if offer is None or offer == self._offer:
            return
        try:
            kind = message_class(offer.type_name)
        except UserError as error:
            self._refuse(str(error))
            return
        if self._offer is not None and offer.type_name != self._offer.type_name:
            self._refuse(f"published as {offer.type_name} now, was {self._offer.type_name}: start the emulator again")
            return
        self._offer, depth = offer, self._node.settings.depth
        if self._publisher is None:
            self._publisher = self._sink.create_publisher(kind, self.called, offer.passed_on(depth))
        if self._subscription is not None:
            self._source.destroy_subscription(self._subscription)
        self._subscription = self._source.create_subscription(
            kind, self.heard, self._pass_on if offer.is_latched else self._transmit, offer.profile(depth), raw=True
        )
        how = "reliable" if offer.is_reliable else "best effort"
        latched = ", latched and so without loss" if offer.is_latched else ""
        self._node.get_logger().info(f"{self.heard} ({offer.type_name}, {how}{latched}) -> {self.called}")

    def _refuse(self, why: str) -> None:
        """Say once why a topic does not cross."""
        if why != self._refusal:
            self._refusal = why
            self._node.get_logger().error(f"{self.heard}: {why}")

    def _pass_on(self, data: bytes) -> None:
        self.sent += 1
        self.bytes += len(data)
        self._publisher.publish(data)

    def _transmit(self, data: bytes) -> None:
        now_ns = time.monotonic_ns()
        try:
            fate = self._link.transmit(now_ns, self._node.place)
        except UserError as error:  # a trace that may not be outrun is over, or another package's model fails
            self._node.fail(f"{self.heard}: {error}")
            return
        self.sent += 1
        self.bytes += len(data)
        self.lost += not fate.arrivals
        for arrival_ns in fate.arrivals:
            if arrival_ns <= now_ns:
                self._publisher.publish(data)
            else:
                self._node.send(arrival_ns, lambda: self._publisher.publish(data))
        if self._are_verdicts_heard:
            self._tell(fate, now_ns)

    def _tell(self, fate: Fate, now_ns: int) -> None:
        """Publish what became of a message: when it was sent, when it arrives (0: never), the outcome and why."""
        stamp_ns = self._node.get_clock().now().nanoseconds
        arrival_ns = stamp_ns + fate.arrivals[0] - now_ns if fate.arrivals else 0
        self._verdicts.publish(encode_slot(Slot(stamp_ns, arrival_ns, fate.outcome, f"topic={self.heard} {fate.note}")))

    def facts(self) -> dict[str, str]:
        """Counts, as the node reports them."""
        facts = {f"{self.heard} sent": str(self.sent), f"{self.heard} lost": str(self.lost)}
        facts[f"{self.heard} sent [byte]"] = str(self.bytes)
        if self._refusal:
            facts[f"{self.heard} does not cross"] = self._refusal
        elif self._offer is None:
            facts[f"{self.heard} does not cross"] = "it has no publisher"
        return facts


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of the executable `link_emulator`."""
    run_node(LinkEmulatorNode, args)


if __name__ == "__main__":
    main()
