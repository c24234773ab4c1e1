"""The server behind a page: it keeps a browser's connections, logs no requests, and lets browsers leave in silence."""

from __future__ import annotations

import errno
import importlib
import socket
import sys
from typing import Any

from agv_ros.errors import UserError

_BACKLOG = 128
"""Connections that wait to be accepted."""


def page_server(app: Any, host: str, port: int, buffer: int = 0) -> Any:
    """A werkzeug server, with a thread for each connection, of a WSGI application. Port 0: any free one.

    What it sends waits for a buffer of so many bytes to be full, or flushed. Raises UserError that says why it cannot
    listen there.
    """
    werkzeug: Any = importlib.import_module("werkzeug.serving")
    lasting = {"log": lambda *_: None, "protocol_version": "HTTP/1.1", "wbufsize": buffer}
    quiet = type("Quiet", (werkzeug.WSGIRequestHandler,), lasting)
    with listener(host, port) as bound:  # the server has a copy of it
        server = werkzeug.make_server(host, port, app, threaded=True, request_handler=quiet, fd=bound.fileno())
    server.daemon_threads = True
    report = server.handle_error

    def handle_error(*request: object) -> None:
        if not isinstance(sys.exc_info()[1], ConnectionError):  # as of a page that was closed
            report(*request)

    server.handle_error = handle_error
    return server


def listener(host: str, port: int) -> socket.socket:
    """A socket that listens for a page's requests. Raises UserError that says why it cannot, and what to do."""
    bound = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((host, port))
        bound.listen(_BACKLOG)
    except OSError as error:
        bound.close()
        is_host = isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL
        remedy = "give --host an address of this machine" if is_host else "choose another with --port"
        raise UserError(f"port {port} of {host} cannot be used: {error.strerror}: {remedy}") from None
    return bound
