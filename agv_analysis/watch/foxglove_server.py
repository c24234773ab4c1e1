"""A server for Foxglove and Lichtblick beside a watched loop: its messages as they came, over a WebSocket.

It listens on this machine alone: the protocol knows no token. Clients can read, and nothing else.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from agv_analysis.bags.message_definitions import schema_of
from agv_analysis.watch.message_log import Heard
from agv_ros.errors import UserError

HOST, PORT = "127.0.0.1", 8765
"""Where Foxglove looks for a server, unless told otherwise."""

_BACKLOG = 50_000
"""Messages that a client may lag behind: those of some seconds of a loop in lockstep."""

Send = Callable[[Sequence[str], Sequence[str], Sequence[Heard]], None]
"""Passes messages on; the first two are name and type of each topic by its number."""


@contextmanager
def foxglove_served(port: int) -> Iterator[tuple[str, Send]]:
    """Serve meanwhile; gives the address, and what passes messages on. Port 0: any free one.

    Raises UserError if the package is not installed or the port cannot be used.
    """
    try:
        foxglove: Any = importlib.import_module("foxglove")
    except ImportError:
        raise UserError("a server for Foxglove needs foxglove-sdk: pip install 'agv_ncs[foxglove]'") from None
    foxglove.set_log_level("ERROR")
    context = foxglove.Context()
    try:
        server = foxglove.start_server(
            name="agv_ncs", host=HOST, port=port, context=context, message_backlog_size=_BACKLOG
        )
    except (OSError, RuntimeError) as error:
        raise UserError(f"port {port} of {HOST} cannot be used: {error}: choose another with --foxglove-port") from None
    channels: dict[tuple[str, str], Any] = {}

    def channel_of(name: str, kind: str) -> Any:
        """The channel of a topic; made when its first message comes, and anew where its type is another one then."""
        if (name, kind) not in channels:
            for known in [known for known in channels if known[0] == name]:
                channels.pop(known).close()
            schema = foxglove.Schema(name=kind, encoding="ros2msg", data=schema_of(kind).encode())
            channels[name, kind] = foxglove.Channel(name, schema=schema, message_encoding="cdr", context=context)
        return channels[name, kind]

    def send(names: Sequence[str], kinds: Sequence[str], messages: Sequence[Heard]) -> None:
        for topic, data, received_ns in messages:
            channel_of(names[topic], kinds[topic]).log(data, log_time=received_ns)

    try:
        yield f"ws://{HOST}:{server.port}", send
    finally:
        server.stop()
