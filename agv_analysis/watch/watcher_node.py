"""The node that listens to a running loop, and takes no part in it.

Its subscriptions ask for best effort: publishers neither wait for it nor send again what it has missed, so a page that
lags costs the loop nothing. It has no executor: what has come is taken in one go, some times a second, which costs a
fraction of a callback for each message.
"""

from __future__ import annotations

from collections.abc import Iterator

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from sensor_msgs.msg import TimeReference

from agv_analysis.watch.live_loop import DIAGNOSTICS, TOPICS
from agv_analysis.watch.message_log import Heard
from agv_ros.endpoints import WATCHER, take_all
from agv_ros.node import ENDED

_QOS = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)

_KINDS: dict[str, tuple[type, ...]] = {
    "edge/slot": (TimeReference,), "agv/pose": (PoseStamped, Odometry), "edge/error": (Odometry,),
    "edge/cmd_vel": (TwistStamped,), "agv/cmd_vel": (TwistStamped, Twist), "agv/slot": (TimeReference,),
    "/diagnostics": (DiagnosticArray,),
}  # fmt: skip
"""Types that a topic may have; the first is listened to until another one is offered."""


class WatcherNode:
    """Listens to the loop of a namespace, on both sides of the radio."""

    def __init__(self, namespace: str = "", plant_domain_id: int = -1, edge_domain_id: int = -1) -> None:
        self.namespace = namespace.strip("/")
        self._contexts: dict[int, Context] = {}
        self._nodes: dict[int, Node] = {}
        self.agv, self.edge = self.in_domain(plant_domain_id), self.in_domain(edge_domain_id)
        self._topics = [(number, topic, self._side_of(topic)) for number, topic in enumerate(TOPICS)]
        if self.edge is not self.agv:
            self._topics.append((DIAGNOSTICS, "/diagnostics", self.edge))
        if self.namespace:  # a fleet's vehicles have a topic of their own
            self._topics.append((DIAGNOSTICS, "diagnostics", self.agv))
        kinds = [_KINDS["/diagnostics" if number == DIAGNOSTICS else topic][0] for number, topic, _ in self._topics]
        self._heard: list[Subscription] = [
            self._listen(node, kind, topic) for kind, (_, topic, node) in zip(kinds, self._topics, strict=True)
        ]

    def in_domain(self, domain_id: int) -> Node:
        """The participant in a DDS domain; a negative id: the usual one."""
        context = Context()
        rclpy.init(
            context=context, domain_id=None if domain_id < 0 else domain_id,
            signal_handler_options=SignalHandlerOptions.NO,
        )  # fmt: skip
        number = context.get_domain_id()
        if number in self._nodes:
            context.try_shutdown()
            return self._nodes[number]
        self._contexts[number] = context
        self._nodes[number] = Node(
            WATCHER, context=context, namespace=self.namespace or None, use_global_arguments=False,
            enable_rosout=False, start_parameter_services=False,
        )  # fmt: skip
        return self._nodes[number]

    def _side_of(self, topic: str) -> Node:
        return self.edge if topic.startswith("edge/") else self.agv

    def _listen(self, node: Node, kind: type, topic: str) -> Subscription:
        return node.create_subscription(kind, topic, lambda _: None, _QOS, raw=True)

    def look(self) -> None:
        """Listen to another type where the loop offers one, as the odometry of a robot. To be called now and then."""
        for i, (_, topic, node) in enumerate(self._topics):
            others = [kind for kind in _KINDS.get(topic, ()) if kind is not self._heard[i].msg_type]
            if not others:
                continue
            infos = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
            offered = {info.topic_type for info in infos}
            for kind in others:
                if f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}" in offered:
                    node.destroy_subscription(self._heard[i])
                    self._heard[i] = self._listen(node, kind, topic)
                    break

    def names(self) -> list[str]:
        """Full names of the topics, in the order of TOPICS."""
        return [self._side_of(topic).resolve_topic_name(topic) for topic in TOPICS]

    def types(self) -> list[str]:
        """Names of their types, as in sensor_msgs/msg/TimeReference."""
        kinds = [heard.msg_type for heard in self._heard[: len(TOPICS)]]
        return [f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}" for kind in kinds]

    def drain(self) -> list[Heard]:
        """What has come since the last call, topic by topic."""
        return list(self._taken())

    def _taken(self) -> Iterator[Heard]:
        for (number, _, _), heard in zip(self._topics, self._heard, strict=True):
            for data, received_ns in take_all(heard):
                yield Heard(number, data, received_ns)

    def reports_in(self, data: bytes) -> Iterator[tuple[str, dict[str, str], bool]]:
        """What each node of this loop says in a message of diagnostics: its name, its facts, and has it ended?"""
        for status in deserialize_message(data, DiagnosticArray).status:
            namespace, _, name = status.name.strip("/").rpartition("/")
            if namespace == self.namespace:
                facts = {value.key: value.value for value in status.values}
                yield name, facts, ENDED in facts

    def close(self) -> None:
        """Leave all domains."""
        for node in self._nodes.values():
            node.destroy_node()
        for context in self._contexts.values():
            context.try_shutdown()
