"""Which clock a loop has: the plant says it once, latched, and the relay passes it on to the edge.

In lockstep the plant alone decides when a step is over, so no stamp is more than one step after the newest one,
whatever window a node grants a loop whose clock goes on by itself.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy

from diagnostic_msgs.msg import KeyValue
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile

LOCKSTEP = "lockstep"

LOCKSTEP_WINDOW = 1
"""Steps: each one follows the one before it."""

_TOPIC = "clock_mode"
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""A copy of it is used: rclpy writes a topic's overrides into the profile that it is given."""


class ClockMode:
    """Says on one side of the radio, `agv` or `edge`, which clock the loop has."""

    def __init__(self, node: Node, side: str) -> None:
        self._publisher: Publisher = node.create_publisher(KeyValue, f"{side}/{_TOPIC}", copy(_LATCHED))

    def say(self, mode: str) -> None:
        """Say it to all that listen, and to those that come later."""
        self._publisher.publish(KeyValue(key="clock", value=mode))


def hear_clock_mode(node: Node, side: str, callback: Callable[[str], None]) -> None:
    """Call back with the clock of the loop, as soon as it is known and whenever it is said again."""
    node.create_subscription(KeyValue, f"{side}/{_TOPIC}", lambda said: callback(said.value), copy(_LATCHED))


def window_of(mode: str, steps: int) -> int:
    """How many steps ahead of the newest one a stamp may be, `steps` unless the loop is in lockstep."""
    return LOCKSTEP_WINDOW if mode == LOCKSTEP else steps
