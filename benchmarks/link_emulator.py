"""What the link emulator costs: messages and bytes a second, and the time it adds, beside a node that only forwards.

Both are processes of their own between a source and a sink, which are in this one and so have one clock. The peer does
what `topic_tools relay` does, in Python as the emulator is: it takes serialised messages and publishes them.

    python -m benchmarks.link_emulator forward RELIABILITY
"""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from agv_ros.executor import EXECUTORS, spin, spin_for
from agv_ros.stopping import stop_on_signals
from benchmarks.comparison import Comparison

HEARD, CALLED = "/benchmark", "/edge/benchmark"
SMALL, LARGE = 64, 1_000_000
SECONDS = 4.0
WINDOW = {SMALL: 200, LARGE: 8}
"""Messages that are under way at most: more would wait in queues, and count as speed of nothing."""

_STAMP = struct.Struct("<iI")


class Crossing(NamedTuple):
    """What was measured of messages of one size."""

    rate: float
    """Messages a second, as many as go through."""
    p50: float
    p99: float
    """Time from source to sink [s], of messages that come one at a time."""


def measure() -> list[Comparison]:
    """The emulator with a channel that loses nothing and with one that loses, beside the forwarder."""
    found = []
    emulator = ["-m", "agv_plant.link_emulator_node", "--ros-args", "-p", f"uplink.topics:=[{HEARD}]"]
    lossy = [*emulator, "-p", "uplink.model:=gilbert_elliott", "-p", "uplink.p:=0.02", "-p", "uplink.r:=0.5"]
    forwarder = ["-m", "benchmarks.link_emulator", "forward"]
    for size, aim, unit in ((SMALL, 10_000.0, "messages/s"), (LARGE, 200.0, "MB/s")):
        peer, ours, losing = (through(command, size) for command in (forwarder, emulator, lossy))
        what = f"{size} byte"
        found += [
            Comparison(f"{what}, throughput", ours.rate, "forwarder", peer.rate, unit),
            Comparison(f"{what}, throughput, 4 % lost", losing.rate, "forwarder", peer.rate, unit),
            Comparison(f"{what}, throughput", ours.rate, "aim", aim, unit, aim=1.0),
            Comparison(f"{what}, time p50", ours.p50 * 1e6, "forwarder", peer.p50 * 1e6, "us", smaller_is_better=True),
            Comparison(f"{what}, time p99", ours.p99 * 1e6, "forwarder", peer.p99 * 1e6, "us", smaller_is_better=True),
        ]
    return found


def through(command: list[str], size: int) -> Crossing:
    """Send messages of `size` bytes through a process."""
    import rclpy
    from rclpy.node import Node
    from rclpy.qos import QoSProfile
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import Image

    context = rclpy.Context()
    rclpy.init(context=context)
    node = Node("benchmark", context=context, use_global_arguments=False)
    executor = EXECUTORS["events"](context=context)
    executor.add_node(node)
    message = bytearray(serialize_message(Image(data=bytes(size))))
    publisher = node.create_publisher(Image, HEARD, QoSProfile(depth=1000))
    times: list[float] = []
    sent = 0

    def publish() -> None:
        nonlocal sent
        sent += 1
        _STAMP.pack_into(message, 4, *divmod(time.monotonic_ns(), 1_000_000_000))
        publisher.publish(bytes(message))

    def receive(data: bytes) -> None:
        seconds, nanoseconds = _STAMP.unpack_from(data, 4)
        times.append(time.monotonic() - seconds - nanoseconds * 1e-9)

    node.create_subscription(Image, CALLED, receive, QoSProfile(depth=1000), raw=True)
    process = subprocess.Popen(
        [sys.executable, *command], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=os.environ
    )
    try:
        assert spin_for(executor, lambda: bool(publisher.get_subscription_count()), 60.0)
        assert spin_for(executor, lambda: bool(node.count_publishers(CALLED)), 60.0)
        spin_for(executor, lambda: False, 0.5)
        times.clear()
        single = _one_at_a_time(executor, publish, times)
        rate = _as_fast_as_possible(executor, publish, times, WINDOW[size])
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(30.0)
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()
    p50, p99 = np.percentile(single, [50.0, 99.0])
    return Crossing(rate if size == SMALL else rate * size * 1e-6, float(p50), float(p99))


def _one_at_a_time(executor: Any, publish: Callable[[], None], times: list[float]) -> list[float]:
    """Times of messages each of which is sent when the one before it has come, or is lost."""
    until = time.monotonic() + SECONDS
    while time.monotonic() < until:
        count = len(times)
        publish()
        spin_for(executor, lambda count=count: len(times) > count, 0.02)  # type: ignore[misc]
    return list(times)


def _as_fast_as_possible(executor: Any, publish: Callable[[], None], times: list[float], window: int) -> float:
    """Messages a second that cross, lost ones counted, with no more than `window` under way."""
    times.clear()
    sent, began = 0, time.monotonic()
    while (now := time.monotonic()) < began + SECONDS:
        for _ in range(window - min(window, sent - len(times))):
            publish()
            sent += 1
        came = len(times)
        if not spin_for(executor, lambda came=came: len(times) >= came + window // 2, 0.05):  # type: ignore[misc]
            sent = len(times)  # what has not come by now is lost
    return len(times) / (now - began)


def forward() -> None:
    """Body of the peer's process."""
    import rclpy
    from rclpy.node import Node
    from rclpy.qos import QoSProfile
    from rclpy.signals import SignalHandlerOptions
    from sensor_msgs.msg import Image

    with stop_on_signals() as stop:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = Node("forwarder")
        publisher = node.create_publisher(Image, CALLED, QoSProfile(depth=1000))
        node.create_subscription(Image, HEARD, publisher.publish, QoSProfile(depth=1000), raw=True)
        executor = EXECUTORS["events"]()
        executor.add_node(node)
        spin(executor, lambda: stop.requested)
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__" and sys.argv[1:] == ["forward"]:
    forward()
