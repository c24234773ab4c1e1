"""Some topics of a running robot as a bag: whatever their types are, for as long as is asked for."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription

from agv_analysis.bags.message_definitions import schema_of
from agv_analysis.bags.rosbag2_metadata import TopicInfo
from agv_analysis.bags.writer import BagWriter
from agv_ros.discovery import discovery_note
from agv_ros.endpoints import WATCHER, Offer, message_class, offer_of, take_all
from agv_ros.errors import UserError
from agv_ros.stopping import stop_on_signals

_DEPTH = 5000
"""Messages of a topic that may wait until they are taken."""

_TICK = 0.02
"""How often [s] they are."""

_PATIENCE = 10.0
"""How long [s] to wait until every topic has had a message."""

_SAVED_EVERY = 50
"""Ticks after which what was taken is written."""

Heard = Callable[[float], None]
"""Is told for how many seconds all topics have been heard."""


def record_topics(directory: Path, topics: Sequence[str], seconds: float, heard: Heard) -> list[int]:
    """Record `seconds` of these topics, from when each has had a message, to a new directory, which it creates.

    Returns how many messages of each there are. SIGINT and SIGTERM end it before its time. Log times are those of
    receiving. Subscriptions ask for what the publishers offer. Raises UserError if a topic is not published, of a type
    that is not installed, or silent, and if the directory exists or cannot be written to.
    """
    with stop_on_signals() as stop, _node() as node:
        listeners = [_Listener(node, node.resolve_topic_name(topic)) for topic in topics]
        begun = time.monotonic()
        while missing := [f"{one.topic} is not published" for one in listeners if not one.look()]:
            _give_up_after(begun, stop.requested, missing)
            time.sleep(_TICK)
        writer = BagWriter(directory, [partial(_described, listener) for listener in listeners], {}, by_stamp=False)
        try:
            _record(listeners, writer, seconds, lambda: stop.requested, heard)
            writer.close()
        except OSError as error:
            writer.abandon()
            raise UserError(f"{directory}: cannot be written any more: {error.strerror}") from None
        return writer.counts


@contextmanager
def _node() -> Iterator[Node]:
    """A node for which no loop waits."""
    context = Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = Node(
        WATCHER, context=context, use_global_arguments=False, enable_rosout=False, start_parameter_services=False
    )
    try:
        yield node
    finally:
        node.destroy_node()
        context.try_shutdown()


class _Listener:
    """A topic, by its full name, and a subscription to it once it is known what is offered."""

    def __init__(self, node: Node, topic: str) -> None:
        self.topic = topic
        self.offer: Offer | None = None
        self._node = node
        self._subscription: Subscription | None = None

    def look(self) -> bool:
        """Subscribe if the topic is published by now; is it?"""
        if self._subscription is None:
            self.offer = offer_of(self._node, self.topic)
            if self.offer is not None:
                kind = message_class(self.offer.type_name)
                self._subscription = self._node.create_subscription(
                    kind, self.topic, lambda _: None, self.offer.profile(_DEPTH), raw=True
                )
        return self._subscription is not None

    def taken(self) -> Iterator[tuple[bytes, int]]:
        """What has come since the last call: the message, and when it was received [ns since 1970]."""
        assert self._subscription is not None
        return take_all(self._subscription)


def _described(listener: _Listener) -> TopicInfo:
    assert listener.offer is not None
    kind = listener.offer.type_name
    return TopicInfo(listener.topic, kind, schema_of(kind), "", [])


def _record(
    listeners: Sequence[_Listener], writer: BagWriter, seconds: float, is_stopped: Callable[[], bool], heard: Heard
) -> None:
    opened, complete, ticks = time.monotonic(), 0.0, 0
    while True:
        for number, listener in enumerate(listeners):
            for data, received_ns in listener.taken():
                writer.write(number, data, received_ns, received_ns)
        if complete or all(writer.counts):
            complete = complete or time.monotonic()
            heard(min(time.monotonic() - complete, seconds))
            if is_stopped() or time.monotonic() - complete >= seconds:
                return
        else:
            silent = [f"{one.topic} is silent" for one, n in zip(listeners, writer.counts, strict=True) if not n]
            _give_up_after(opened, is_stopped(), silent)
        ticks += 1
        if ticks % _SAVED_EVERY == 0:
            writer.write_older()
        time.sleep(_TICK)


def _give_up_after(begun: float, is_stopped: bool, reasons: Sequence[str]) -> None:
    if is_stopped or time.monotonic() - begun > _PATIENCE:
        raise UserError(f"{'; '.join(reasons)} ({discovery_note()})")
