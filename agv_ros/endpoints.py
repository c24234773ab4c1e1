"""Publishers and subscriptions of the loop's nodes, to serialised messages."""

from __future__ import annotations

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy

from agv_ros.stamps import to_nanoseconds

# Deep enough that a reader which falls behind for seconds, the recorder above all, still gets every message, even in
# lockstep, where they are thousands a second. DDS sets memory aside only for messages that wait.
# Only copies of it are used: rclpy writes a topic's overrides into the profile that it is given.
LOOP_QOS = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.RELIABLE)

_RECORDERS = ("recorder", "rosbag2_recorder")
"""Names of nodes that only record: one of them alone is no reason for a loop to begin."""


class Output:
    """A publisher of serialised messages that counts them."""

    def __init__(self, publisher: Publisher, side: bool, optional: bool, where: Node) -> None:
        self._publisher = publisher
        self._side = side
        self._optional = optional
        self._where = where
        self.count = 0
        self.topic: str = publisher.topic_name

    def publish(self, data: bytes) -> None:
        """Send one serialised message."""
        self.count += 1
        self._publisher.publish(data)

    def is_heard(self, subscribers: int) -> bool:
        """Has the topic this many subscribers? One fewer is enough beside the loop: only a recorder listens there.

        A single one must not be a recorder, and an optional topic does without it.
        """
        count = self._publisher.get_subscription_count()
        if self._side or subscribers != 1:
            return bool(count >= subscribers - self._side)
        return self._optional or (count > 0 and self._is_heard_by_a_peer())

    def _is_heard_by_a_peer(self) -> bool:
        infos = self._where.get_subscriptions_info_by_topic(self.topic)
        # A name that begins with _ is one that is not known yet.
        return any(not info.node_name.startswith("_") and info.node_name not in _RECORDERS for info in infos)

    def rivals(self) -> list[str]:
        """Names of other nodes that publish what one node of a loop alone should; none beside the loop."""
        if self._side or self._where.count_publishers(self.topic) <= 1:
            return []
        infos = self._where.get_publishers_info_by_topic(self.topic)
        others = [f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos]
        own = self._where.get_fully_qualified_name()
        if own in others:  # one of them is this node
            others.remove(own)
        return sorted(others)

    def flush(self, seconds: float) -> bool:
        """Wait until every subscriber has what was sent, `seconds` at most; do they have it?"""
        return bool(self._publisher.wait_for_all_acked(Duration(nanoseconds=to_nanoseconds(seconds))))
