"""Watching a running loop: the node that listens, the session that understands it, the pages that show it."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from agv_analysis.scenario import load_scenario
from agv_analysis.watch.foxglove_server import foxglove_served
from agv_analysis.watch.watch_page import served
from agv_analysis.watch.watch_session import TICK, WatchSession
from agv_ros.errors import UserError
from agv_ros.stopping import stop_on_signals

_LOOK = 20
"""Ticks between two looks at the types that the loop's topics have."""

EVERYWHERE = ("", "0.0.0.0", "::")


def watch(
    namespace: str, config: Path | None, domains: tuple[int, int], folder: Path, where: tuple[str, int],
    ready: Callable[[str, str], None], stop_run: Callable[[], None] | None, foxglove_port: int | None = None,
) -> None:  # fmt: skip
    """Serve the page of a namespace's loop at host and port `where`; `ready` receives its address.

    `domains` are the DDS domains of AGV and edge, negative: the usual one. `stop_run` ends the run that the page
    belongs to. With a `foxglove_port` a server for Foxglove stands beside the page, and `ready` receives its address as
    well, which is empty otherwise. Raises UserError if the params file, host or a port cannot be used.
    """
    from agv_analysis.watch.remote_parameters_node import RemoteParameters  # nodes, which need ROS
    from agv_analysis.watch.watcher_node import WatcherNode

    if where[0] in EVERYWHERE:
        raise UserError(f"--host {where[0]!r} names no address: name the one by which others reach this machine")
    scenario = None if config is None else load_scenario(str(config))
    with stop_on_signals() as stop, ExitStack() as servers:
        to_foxglove, send = "", None
        if foxglove_port is not None:
            to_foxglove, send = servers.enter_context(foxglove_served(foxglove_port))
        watcher = WatcherNode(namespace, *domains)
        remote = RemoteParameters(watcher.agv, watcher.edge)
        session = WatchSession(watcher, remote, scenario, folder, stop_run, send)
        try:
            with served(session, *where) as address:
                ready(address, to_foxglove)
                _listen(session, lambda: stop.requested)
                session.end()
        finally:
            session.close()
            remote.close()
            watcher.close()


def _listen(session: WatchSession, is_done: Callable[[], bool]) -> None:
    count, due = 0, time.monotonic()
    while not is_done():
        if count % _LOOK == 0:
            session.watcher.look()
        session.tick()
        count, due = count + 1, max(due + TICK, time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))
    session.tick()
