"""A process whose subscription is not served while its publisher sends 6000 messages, and then has ten more to hear."""

from __future__ import annotations

import time

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.experimental import EventsExecutor

import agv_ros.discovery  # noqa: F401  # which sets what the middleware reads
from agv_ros.codec import encode_pose
from agv_ros.endpoints import LOOP_QOS
from agv_ros.messages import StampedPose

BACKLOG, LATER = 6000, 10
PATIENCE = 60.0


def main() -> None:
    """Print how many of all messages were received."""
    rclpy.init()
    node, heard = rclpy.create_node("behind"), 0

    def hear(_: bytes) -> None:
        nonlocal heard
        heard += 1

    publisher = node.create_publisher(PoseStamped, "pose", LOOP_QOS)
    node.create_subscription(PoseStamped, "pose", hear, LOOP_QOS, raw=True)
    executor = EventsExecutor()
    executor.add_node(node)
    until = time.monotonic() + PATIENCE

    def spin(is_done: int) -> None:
        while heard < is_done and time.monotonic() < until:
            executor.spin_once(timeout_sec=0.05)

    while not publisher.get_subscription_count() and time.monotonic() < until:
        executor.spin_once(timeout_sec=0.05)
    sent = 0
    for count in (BACKLOG, LATER):
        for _ in range(count):
            publisher.publish(encode_pose(StampedPose(1_000_000_000 + sent, 0.0, 0.0, 0.0)))
        sent += count
        spin(sent)
    print(f"received {heard}", flush=True)
    rclpy.shutdown()


if __name__ == "__main__":
    main()
