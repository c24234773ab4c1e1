"""The peers of the loop: the same messages around the same hops, nothing computed.

`loop`: the loop's eight messages a step (seven and /clock) between four nodes, as message objects that are made once.
`raw`: the same as serialised bytes, which spares rclpy the conversions: the least that the hops can cost.
`four_hop`: one stamped pose passed around four nodes.

    python -m benchmarks.echo SHAPE STEPS EXECUTOR ROLE...
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

from agv_ros.executor import EXECUTORS, spin  # sets the discovery range before rclpy starts
from agv_ros.stopping import stop_on_signals

import rclpy  # isort: skip
from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import TimeReference

from agv_ros.endpoints import LOOP_QOS

ROLES = ("plant", "relay", "error_detector", "controller")


def _message(kind: type) -> Any:
    message = kind()
    if kind is not Clock:
        message.header.stamp.sec = 1
    if kind is TimeReference:
        message.source = "delivered"
    elif kind is Odometry:
        message.header.frame_id, message.child_frame_id = "base_link", "reference"
    elif kind is not Clock:
        message.header.frame_id = "map"
    return message


class Echo:
    """One role of a ring of nodes; the plant counts the rounds."""

    def __init__(self, role: str, shape: str, steps: int, context: rclpy.Context) -> None:
        self.node = Node(f"echo_{role}", context=context, use_global_arguments=False)
        self.rounds = 0
        self.started = 0.0
        self.ended = 0.0
        self._raw = shape == "raw"
        self._steps = steps
        self._begin: Callable[[], None] = lambda: None
        if shape == "four_hop":
            self._four_hop(role)
        else:
            self._loop(role)

    def _to(self, kind: type, topic: str) -> Callable[[], None]:
        publisher, message = self.node.create_publisher(kind, topic, LOOP_QOS), _message(kind)
        content = serialize_message(message) if self._raw else message
        return lambda: publisher.publish(content)

    def _on(self, kind: type, topic: str, *actions: Callable[[], None]) -> None:
        def callback(_: Any) -> None:
            for action in actions:
                action()

        self.node.create_subscription(kind, topic, callback, LOOP_QOS, raw=self._raw)

    def _loop(self, role: str) -> None:
        if role == "plant":
            clock, pose = self._to(Clock, "/clock"), self._to(PoseStamped, "agv/pose")
            self._begin = lambda: (clock(), pose())[0]
            self._on(TwistStamped, "agv/cmd_vel")
            self._on(TimeReference, "agv/slot", self._round)
        elif role == "relay":
            self._on(PoseStamped, "agv/pose", self._to(PoseStamped, "edge/pose"), self._to(TimeReference, "edge/slot"))
            self._on(
                TwistStamped, "edge/cmd_vel", self._to(TwistStamped, "agv/cmd_vel"), self._to(TimeReference, "agv/slot")
            )
        elif role == "error_detector":
            self._on(PoseStamped, "edge/pose")
            self._on(TimeReference, "edge/slot", self._to(Odometry, "edge/error"))
        else:
            self._on(Odometry, "edge/error", self._to(TwistStamped, "edge/cmd_vel"))

    def _four_hop(self, role: str) -> None:
        place = ROLES.index(role)
        to = self._to(PoseStamped, f"hop_{place}")
        if role == "plant":
            self._begin = to
            self._on(PoseStamped, "hop_3", self._round)
        else:
            self._on(PoseStamped, f"hop_{place - 1}", to)

    def _round(self) -> None:
        self.rounds += 1
        if self.rounds == 1:
            self.started = time.perf_counter()
        if self.rounds > self._steps:
            self.ended = time.perf_counter()
        else:
            self._begin()

    def kick(self) -> None:
        """Send the first message, again until it comes around."""
        if self.rounds == 0:
            self._begin()


def echo(shape: str, steps: int, executor_name: str, roles: Sequence[str]) -> float:
    """Rounds per second of the ring. Without the plant among the roles: 0, when the process is stopped."""
    with stop_on_signals() as stop:
        context = rclpy.Context()
        rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
        nodes = {role: Echo(role, shape, steps, context) for role in roles}
        executor = EXECUTORS[executor_name](context=context)
        for node in nodes.values():
            executor.add_node(node.node)
        plant = nodes.get("plant")
        if plant is None:
            spin(executor, lambda: stop.requested)
        else:
            timer = plant.node.create_timer(0.2, plant.kick)
            spin(executor, lambda: plant.rounds > 0)
            plant.node.destroy_timer(timer)
            spin(executor, lambda: plant.ended > 0.0 or stop.requested)
        executor.shutdown()
        for node in nodes.values():
            node.node.destroy_node()
        context.try_shutdown()
    return steps / (plant.ended - plant.started) if plant else 0.0


if __name__ == "__main__":
    print(echo(sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4:]))
