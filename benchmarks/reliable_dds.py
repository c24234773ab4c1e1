"""What DDS itself makes of an outage between two hosts on a cable, beside what a reliable channel makes of it.

The hosts are network namespaces joined by a veth pair; for a time the kernel of one of them drops all that comes. Needs
root and iproute2.

    python -m benchmarks.reliable_dds publish|listen RELIABILITY DEPTH
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from benchmarks.comparison import Comparison

PERIOD, OUTAGE, SECONDS = 0.01, 1.0, 6.0
TOPIC = "/benchmark"
ROUND_TRIP, HEARTBEAT = 0.01, 3.0
"""Time [s] after which Fast DDS has sent again what was missing.

At once if the writer's history is full, for it then says what it has; else with its next heartbeat.
"""
_AFTER = 0.05
"""What comes within this time [s] after an outage came at once."""


class Outage(NamedTuple):
    """What a listener saw of an outage."""

    silence: float
    """How long nothing came [s]."""
    at_once: int
    """Messages that came within 50 ms of the end of the silence."""
    lost: int
    """Messages that never came."""
    oldest: float
    """The greatest age of a message when it came [s]."""


def measure() -> list[Comparison]:
    """Outages of a second, best effort and reliable with a history of 10 and of 1000 messages, beside the channel's."""
    found = []
    for name, reliability, depth in (("best effort", "best_effort", 10), ("reliable, history 10", "reliable", 10),
                                     ("reliable, history 1000", "reliable", 1000)):  # fmt: skip
        seen, expected = _seen(reliability, depth), _expected(reliability, depth)
        for what, unit in (("silence", "s"), ("at_once", ""), ("lost", ""), ("oldest", "s")):
            row = f"{name}: {what.replace('_', ' ')}"
            found.append(Comparison(row, getattr(expected, what), "DDS", getattr(seen, what), unit))
    return found


def _expected(reliability: str, depth: int) -> Outage:
    """What the channel makes of the same outage."""
    from agv_plant.parameters import ChannelParameters
    from agv_plant.radio.channel import Channel

    values: dict[str, Any] = {"schedule": f"2: outage={OUTAGE}"}
    if reliability == "reliable":
        values |= {"reliable": True, "history": depth, "resend_after": ROUND_TRIP if depth <= 10 else HEARTBEAT}
    channel = Channel(ChannelParameters(**values), 1, "uplink", PERIOD)
    sent = np.arange(1, round(SECONDS / PERIOD))
    waits = np.array([-1.0 if channel.lost(k) else max(channel.delays(k)) for k in sent.tolist()])
    return _outage((sent * PERIOD)[waits >= 0.0], ((sent + waits) * PERIOD)[waits >= 0.0], len(sent))


def _outage(sent: Any, came: Any, count: int) -> Outage:
    """From the instants of all messages that came [s], in the order in which they came."""
    gaps = np.diff(came)
    end = int(np.argmax(gaps)) + 1
    at_once = int(np.count_nonzero((came >= came[end]) & (came < came[end] + _AFTER)))
    return Outage(float(gaps[end - 1]), at_once, count - len(sent), float((came - sent).max()))


def _seen(reliability: str, depth: int) -> Outage:
    with _two_hosts() as (agv, edge, cut):
        listener = _start(edge, "listen", reliability, depth)
        publisher = _start(agv, "publish", reliability, depth)
        assert listener.stdout is not None
        listener.stdout.readline()  # the first message is there
        time.sleep(2.0)
        cut(True)
        time.sleep(OUTAGE)
        cut(False)
        sent = json.loads(publisher.communicate(timeout=60.0)[0])
        time.sleep(1.0)
        listener.send_signal(signal.SIGINT)
        rows = np.array(json.loads(listener.communicate(timeout=60.0)[0]))
    return _outage(rows[:, 0], rows[:, 1], sent - round(rows[0, 2]))


def _start(host: list[str], role: str, reliability: str, depth: int) -> subprocess.Popen[str]:
    command = [*host, sys.executable, "-m", "benchmarks.reliable_dds", role, reliability, str(depth)]
    environment = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
    return subprocess.Popen(command, env=environment, text=True, stdout=subprocess.PIPE)


@contextmanager
def _two_hosts() -> Iterator[tuple[list[str], list[str], Any]]:
    """How to run something on the AGV's host and on the edge's, and what cuts the cable and joins it."""
    names = [f"agv_ncs_{os.getpid()}_{side}" for side in ("agv", "edge")]
    ends = [f"v{os.getpid()}{side}" for side in "ae"]

    def ip(*words: str) -> None:
        subprocess.run(["ip", *words], check=True, capture_output=True)

    def cut(is_cut: bool) -> None:
        for name, end in zip(names, ends, strict=True):
            tc = ["tc", "-n", name, "filter", "add" if is_cut else "del", "dev", end, "parent", "ffff:"]
            away = ["protocol", "ip", "u32", "match", "u32", "0", "0", "action", "mirred", "egress", "redirect"]
            subprocess.run([*tc, *([*away, "dev", "nowhere"] if is_cut else [])], check=True, capture_output=True)

    try:
        for name in names:
            ip("netns", "add", name)
        ip("link", "add", ends[0], "netns", names[0], "type", "veth", "peer", "name", ends[1], "netns", names[1])
        for host, (name, end) in enumerate(zip(names, ends, strict=True), start=1):
            ip("-n", name, "address", "add", f"10.214.0.{host}/24", "dev", end)
            ip("-n", name, "link", "add", "nowhere", "type", "veth", "peer", "name", "further")
            for link in ("lo", end, "nowhere"):
                ip("-n", name, "link", "set", link, "up")
            ip("-n", name, "route", "add", "default", "dev", end)
            subprocess.run(["tc", "-n", name, "qdisc", "add", "dev", end, "ingress"], check=True)
        yield ["ip", "netns", "exec", names[0]], ["ip", "netns", "exec", names[1]], cut
    finally:
        for name in names:
            subprocess.run(["ip", "netns", "delete", name], check=False, capture_output=True)


def run(role: str, reliability: str, depth: int) -> None:
    """Body of a process: publish stamped messages, or listen to them and print what came when."""
    from agv_ros.executor import EXECUTORS, spin, spin_for
    from agv_ros.stopping import stop_on_signals

    import rclpy  # isort: skip
    from rclpy.node import Node
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from rclpy.signals import SignalHandlerOptions
    from sensor_msgs.msg import TimeReference

    from agv_ros.codec import decode_slot, encode_slot
    from agv_ros.messages import Slot

    profile = QoSProfile(depth=depth, reliability=ReliabilityPolicy[reliability.upper()])
    rows: list[tuple[float, float, int]] = []
    with stop_on_signals() as stop:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = Node(role)
        executor = EXECUTORS["events"]()
        executor.add_node(node)
        if role == "publish":
            publisher, count = node.create_publisher(TimeReference, TOPIC, profile), 0
            spin_for(executor, lambda: publisher.get_subscription_count() > 0, 30.0)

            def send() -> None:
                nonlocal count
                publisher.publish(encode_slot(Slot(time.monotonic_ns(), count, "")))
                count += 1

            node.create_timer(PERIOD, send)
            spin(executor, lambda: count >= SECONDS / PERIOD or stop.requested)
            spin_for(executor, lambda: False, 1.0)
            print(count)
        else:

            def receive(data: bytes) -> None:
                slot, now = decode_slot(data), time.monotonic()
                if not rows:
                    print("first", flush=True)
                rows.append((slot.stamp_ns * 1e-9, now, slot.freshest_ns))

            node.create_subscription(TimeReference, TOPIC, receive, profile, raw=True)
            spin(executor, lambda: stop.requested)
            print(json.dumps(rows))
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    run(sys.argv[1], sys.argv[2], int(sys.argv[3]))
