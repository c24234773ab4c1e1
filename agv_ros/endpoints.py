"""Publishers and subscriptions of the loop's nodes, to serialised messages."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from typing import NamedTuple

from rclpy.duration import Duration, Infinite
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from agv_ros.errors import UserError
from agv_ros.message_sync import MOST_WAITING
from agv_ros.stamps import to_nanoseconds

# Deep enough that a reader which falls behind for seconds, the recorder above all, still gets every message, even in
# lockstep, where they are thousands a second. DDS sets memory aside only for messages that wait.
# Only copies of it are used: rclpy writes a topic's overrides into the profile that it is given.
LOOP_QOS = QoSProfile(depth=MOST_WAITING, reliability=ReliabilityPolicy.RELIABLE)

RECORDER = "recorder"
"""Usual name of the node that records a loop."""

_RECORDERS = (RECORDER, "rosbag2_recorder")
"""Names of nodes that only record: one of them alone is no reason for a loop to begin."""

WATCHER = "watcher"
"""Name of the node behind the page of `agv-ncs watch`: a loop begins, and goes on, as if it were not there."""


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

        A single one must not be a recorder, and an optional topic does without it. Watchers do not count.
        """
        if self._side or subscribers != 1:
            return self._is_counted(subscribers - self._side)
        return self._optional or (self._publisher.get_subscription_count() > 0 and self._is_heard_by_a_peer())

    def _is_counted(self, wanted: int) -> bool:
        """Are there this many subscribers whose names are known, watchers left out?"""
        if self._publisher.get_subscription_count() < wanted or wanted <= 0:
            return wanted <= 0
        return sum(name != WATCHER for name in self._names_of_subscribers()) >= wanted

    def _is_heard_by_a_peer(self) -> bool:
        return any(name not in (*_RECORDERS, WATCHER) for name in self._names_of_subscribers())

    def is_watched(self) -> bool:
        """Does a watcher listen?"""
        return WATCHER in self._names_of_subscribers()

    def _names_of_subscribers(self) -> list[str]:
        infos = self._where.get_subscriptions_info_by_topic(self.topic)
        # A name that begins with _ is one that is not known yet.
        return [info.node_name for info in infos if not info.node_name.startswith("_")]

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


class Offer(NamedTuple):
    """What the publishers of a topic offer together."""

    type_name: str
    """As in sensor_msgs/msg/LaserScan."""
    is_reliable: bool
    """Do all of them send again what was lost?"""
    is_latched: bool
    """Do all of them send what was sent before to those who come later?"""
    deadline: Duration | None
    lifespan: Duration | None
    """The longest; None if one has no limit."""

    def profile(self, depth: int) -> QoSProfile:
        """A subscription's that hears all of them, keeping `depth` messages."""
        return QoSProfile(
            depth=depth,
            reliability=ReliabilityPolicy.RELIABLE if self.is_reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if self.is_latched else DurabilityPolicy.VOLATILE,
        )

    def passed_on(self, depth: int) -> QoSProfile:
        """A publisher's that offers the same."""
        profile = self.profile(depth)
        if self.deadline is not None:
            profile.deadline = self.deadline
        if self.lifespan is not None:
            profile.lifespan = self.lifespan
        return profile


def offer_of(node: Node, topic: str) -> Offer | None:
    """What is offered on a topic, by its full name, as far as it has been discovered; None if it is not published.

    Of several types the first counts.
    """
    infos = node.get_publishers_info_by_topic(topic)
    if not infos:
        return None
    own = [info.qos_profile for info in infos if info.topic_type == infos[0].topic_type]
    return Offer(
        infos[0].topic_type,
        all(qos.reliability == ReliabilityPolicy.RELIABLE for qos in own),
        all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in own),
        _longest([qos.deadline for qos in own]),
        _longest([qos.lifespan for qos in own]),
    )


def _longest(durations: list[Duration]) -> Duration | None:
    limited = [duration for duration in durations if 0 < duration.nanoseconds < Infinite.nanoseconds]
    return max(limited, key=lambda duration: duration.nanoseconds) if len(limited) == len(durations) else None


def take_all(subscription: Subscription) -> Iterator[tuple[bytes, int]]:
    """What has come without an executor: each serialised message, and when it was received [ns since 1970]."""
    with subscription.handle:
        while (message := subscription.handle.take_message(subscription.msg_type, True)) is not None:
            data, about = message
            yield data, int(about["received_timestamp"])


def message_class(type_name: str) -> type:
    """The Python class of a type like sensor_msgs/msg/LaserScan. Raises UserError if it is not installed here."""
    package, _, name = type_name.partition("/msg/")
    try:
        found: type = getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        raise UserError(
            f"the type {type_name} is not installed here: install the package {package}, and source its workspace"
        ) from None
    return found
