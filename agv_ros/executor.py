"""Running nodes: one process for one node, ended cleanly by a signal, by who started it, or by the node itself."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

DISCOVERY_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
"""Environment variable of ROS 2: which participants find each other."""

# The loop is one machine's business unless its user says otherwise; set before rclpy makes its first participant.
os.environ.setdefault(DISCOVERY_RANGE, "LOCALHOST")

import rclpy
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.signals import SignalHandlerOptions

from agv_ros.errors import UserError
from agv_ros.node import LoopNode

EXECUTORS: dict[str, Callable[..., Executor]] = {"events": EventsExecutor, "single": SingleThreadedExecutor}

SPIN_TIMEOUT = 0.05
"""Longest wait [s] for the next event. Unbounded, the events executor neither runs timers nor sees signals."""

LAST_FLUSH_TIMEOUT = 10.0
"""How long [s] a node that finishes normally waits for subscribers that lag."""


ENDS_WITH_STDIN = "AGV_NCS_ENDS_WITH_STDIN"
"""Environment variable: a process in which it is set ends when its standard input does.

So who starts processes holds one end of a pipe each, which the system closes however that process ends.
"""

_ORPHAN_PATIENCE = 1.5
"""How long [s] a process whose starter is gone may take to end in order, and then once more to end in a hurry."""

_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


class Stop:
    """Set by signals, and by the end of the process that started this one."""

    def __init__(self) -> None:
        self.requested = False
        self.insisted = False
        """Asked for again: nothing is waited for any more."""
        self.reason = ""
        """What asked first, as in "SIGTERM"."""

    def request(self, number: int, _: object = None) -> None:
        """Signal handler."""
        self.ask(signal.Signals(number).name)

    def ask(self, reason: str) -> None:
        """End in order; if that has been asked for already, at once."""
        self.insisted = self.requested
        self.requested = True
        self.reason = self.reason or reason


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Turn signals that end a process into a flag: a loop ends between two events, not in the middle of one.

    A closed terminal sends SIGHUP, which `nohup` has a process ignore.
    """
    stop = Stop()
    heeded = [n for n in _STOP_SIGNALS if n != signal.SIGHUP or signal.getsignal(n) != signal.SIG_IGN]
    before = {number: signal.signal(number, stop.request) for number in heeded}
    if os.environ.get(ENDS_WITH_STDIN):
        threading.Thread(target=_end_with_stdin, args=(stop,), daemon=True).start()
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _end_with_stdin(stop: Stop) -> None:
    """Body of a thread: once standard input ends, end this process, by force if need be."""
    while os.read(0, 4096):
        pass
    for _ in range(2):
        stop.ask("the end of the process that started it")
        time.sleep(_ORPHAN_PATIENCE)
    os._exit(1)


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


def add(executor: Executor, node: LoopNode[Any]) -> None:
    """Let an executor run a node, in all DDS domains that it is in."""
    for side in (node, *node.sides):
        executor.add_node(side)


def discovery_note() -> str:
    """Who can find the nodes of this process, and how to change that."""
    range_ = os.environ[DISCOVERY_RANGE]
    whom = {
        "LOCALHOST": "this host alone finds the loop", "OFF": "no other process finds the loop",
        "SUBNET": "every host of the network finds the loop and can send it messages",
    }.get(range_, "the middleware's own default holds")  # fmt: skip
    return f"discovery: {DISCOVERY_RANGE}={range_}, {whom}"


def run_node(make: Callable[..., LoopNode[Any]], args: Sequence[str] | None = None) -> None:
    """Body of a node's `main`: make it, run it until it ends or is stopped, and exit with its status.

    What is wrong with a parameter or a file is said in one line, with exit status 1.
    """
    with stop_on_signals() as stop:
        rclpy.init(args=None if args is None else list(args), signal_handler_options=SignalHandlerOptions.NO)
        try:
            failure = _run(make, stop)
        finally:
            rclpy.try_shutdown()
    if failure:
        print(failure, file=sys.stderr)
        raise SystemExit(1)


def _run(make: Callable[..., LoopNode[Any]], stop: Stop) -> str:
    try:
        node = make()
    except UserError as error:
        return str(error)
    node.get_logger().info(discovery_note())
    executor = EventsExecutor()
    add(executor, node)
    spin(executor, lambda: node.finished or stop.requested)
    if not node.finished:
        node.on_stop(stop.reason or "the end of its context")
    deadline = time.monotonic() + (node.settings.stop_timeout if stop.requested else LAST_FLUSH_TIMEOUT)
    spin_for(executor, lambda: stop.insisted or node.is_settled(), deadline - time.monotonic())
    node.close()
    node.flush(max(0.0, deadline - time.monotonic()), lambda: stop.insisted)
    executor.shutdown()
    node.destroy_node()
    return node.failure
