"""Running nodes: one process for one node, ended cleanly by a signal, by who started it, or by the node itself."""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import rclpy
from builtin_interfaces.msg import Time as TimeMessage
from rcl_interfaces.msg import Log
from rclpy.duration import Duration
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions

from agv_ros.discovery import discovery_note
from agv_ros.errors import UserError, open_text
from agv_ros.node import LoopNode
from agv_ros.service_manager import ALIVE, READY, STOPPING, notify, watchdog_period
from agv_ros.stopping import CLOSED, COUNTS, Stop, ends_with_starter, stop_on_signals

EXECUTORS: dict[str, Callable[..., Executor]] = {"events": EventsExecutor, "single": SingleThreadedExecutor}

SPIN_TIMEOUT = 0.05
"""Longest wait [s] for the next event. Unbounded, the events executor neither runs timers nor sees signals."""

_ROSOUT_QOS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)

_ROSOUT_PATIENCE = 3.2
"""How long [s] a process that fails looks for those who watch /rosout, and then waits until they have its message.

DDS finds some only when it repeats itself, and repeats a message that somebody has missed, every 3 s.
"""

LAST_FLUSH_TIMEOUT = 10.0
"""How long [s] a node that finishes normally waits for subscribers that lag."""


def spin(executor: Executor, is_done: Callable[[], bool]) -> None:
    """Run callbacks until `is_done`. Raises UserError; any other error of a callback is counted."""
    while not is_done():
        try:
            executor.spin_once(timeout_sec=SPIN_TIMEOUT)
        except ExternalShutdownException:
            return
        except UserError:
            raise
        except Exception as error:
            nodes = [node for node in executor.get_nodes() if isinstance(node, LoopNode)]
            if not nodes:
                raise
            nodes[0].survive(error)


def spin_for(executor: Executor, is_done: Callable[[], bool], seconds: float) -> bool:
    """Run callbacks until `is_done`, `seconds` at most; did it become true?"""
    deadline = time.monotonic() + seconds
    spin(executor, lambda: is_done() or time.monotonic() > deadline)
    return is_done()


def spin_while_more_comes(
    executor: Executor, is_done: Callable[[], bool], count: Callable[[], int], seconds: float
) -> None:
    """Run callbacks until `is_done`, or until `count` has not grown for so many `seconds`."""
    before = -1
    while count() > before:
        before = count()
        if spin_for(executor, is_done, seconds):
            return


def add(executor: Executor, node: LoopNode[Any]) -> None:
    """Let an executor run a node, in all DDS domains that it is in."""
    for side in (node, *node.sides):
        executor.add_node(side)


def run_node(make: Callable[..., LoopNode[Any]], args: Sequence[str] | None = None) -> None:
    """Body of a node's `main`: make it, run it until it ends or is stopped, and exit with its status.

    What is wrong with a parameter or a file is said in one line, on /rosout as well, with exit status 1.
    """
    words = sys.argv[1:] if args is None else list(args)
    with stop_on_signals() as stop:
        failure = _initialise(words)
        try:
            failure = failure or _run(make, stop)
            if failure:
                print(failure, file=sys.stderr, flush=True)
                # Who stops a run, or has started it with others, knows why it ended, and waits for nothing.
                if not (stop.requested or ends_with_starter()):
                    _say_on_rosout(_usual_name(make), failure, stop)
        finally:
            rclpy.try_shutdown()
    if failure:
        raise SystemExit(1)


def _initialise(words: list[str]) -> str:
    """Initialise ROS with the arguments of this process; why that cannot be, in a line, and then without them."""
    try:
        for path in params_files_in(words):
            with open_text(path, UserError):
                pass
        rclpy.init(args=words, signal_handler_options=SignalHandlerOptions.NO)
    except (UserError, rclpy_implementation.RCLError, rclpy_implementation.UnknownROSArgsError) as error:
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        reason = str(error).partition("\n")[0].partition(", at /")[0]
        return reason if isinstance(error, UserError) else f"arguments that ROS does not take: {reason}"
    return ""


def params_files_in(words: Sequence[str]) -> list[str]:
    """The files that arguments name as --params-file."""
    return [path for flag, path in pairwise(words) if flag == "--params-file"]


def _usual_name(make: Callable[..., LoopNode[Any]]) -> str:
    """What a node is called that may never have been made: ErrorDetectorNode is error_detector."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", make.__name__.removesuffix("Node")).lower()


def _say_on_rosout(name: str, failure: str, stop: Stop) -> None:
    """Say on /rosout why a node ends; it waits for subscribers for a moment only."""
    herald = Node(f"{name}_failure", enable_rosout=False, start_parameter_services=False)
    publisher = herald.create_publisher(Log, "/rosout", _ROSOUT_QOS)
    deadline = time.monotonic() + _ROSOUT_PATIENCE
    while not (publisher.get_subscription_count() or stop.requested) and time.monotonic() < deadline:
        time.sleep(0.01)
    seconds, nanoseconds = divmod(time.time_ns(), 1_000_000_000)
    stamp = TimeMessage(sec=seconds, nanosec=nanoseconds)
    publisher.publish(Log(stamp=stamp, level=Log.FATAL, name=name, msg=failure))
    deadline = time.monotonic() + _ROSOUT_PATIENCE
    # A subscriber that is known here may not know of the publisher yet.
    while not publisher.wait_for_all_acked(Duration(seconds=0.1)):
        if stop.requested or time.monotonic() > deadline:
            break
    herald.destroy_node()


def _run(make: Callable[..., LoopNode[Any]], stop: Stop) -> str:
    try:
        node = make()
    except UserError as error:
        return str(error)
    node.get_logger().info(discovery_note())
    node.announce()
    executor = EventsExecutor()
    add(executor, node)
    if (period := watchdog_period()) is not None:  # by the executor, so that a callback that hangs is noticed
        node.every(period, lambda: notify(ALIVE))
    notify(READY)
    spin(executor, lambda: node.finished or stop.requested)
    notify(STOPPING)
    if not node.finished:
        node.on_stop(stop.reason or "the end of its context")
    if stop.requested:
        _answer_what_is_under_way(executor, node, stop)
    deadline = time.monotonic() + (node.settings.stop_timeout if stop.requested else LAST_FLUSH_TIMEOUT)
    spin_for(executor, lambda: stop.insisted or node.is_settled(), deadline - time.monotonic())
    node.close()
    if ends_with_starter():
        print(_counts(node), flush=True)
    node.get_logger().info(f"{CLOSED}, waits until all that it has published has arrived")
    node.flush(max(0.0, deadline - time.monotonic()), lambda: stop.insisted)
    executor.shutdown()
    node.destroy_node()
    return node.failure


def _answer_what_is_under_way(executor: Executor, node: LoopNode[Any], stop: Stop) -> None:
    """Take part in the loop until the runner that started this node, if one did, lets it close.

    The runner has ended the plant, and compares what its nodes say that they have received and published.
    """
    said = ""
    while not (stop.may_close or stop.insisted):
        if (counts := _counts(node)) != said:
            said = counts
            print(counts, flush=True)
        spin_for(executor, lambda: stop.may_close or stop.insisted, SPIN_TIMEOUT)


def _counts(node: LoopNode[Any]) -> str:
    return COUNTS + json.dumps({"received": node.received, "published": node.published()})
