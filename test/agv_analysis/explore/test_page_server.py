"""The server of pages with a real connection that is cut off."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Callable, Iterator

import pytest

pytest.importorskip("werkzeug", reason="needs werkzeug: pip install '.[explore]'")

from agv_analysis.explore.page_server import page_server


def test_a_browser_that_leaves_in_the_middle_of_a_frame_is_no_error(capfd: pytest.CaptureFixture[str]) -> None:
    has_left = threading.Event()

    def app(_: object, start_response: Callable[..., object]) -> Iterator[bytes]:
        start_response("200 OK", [("Content-Type", "text/event-stream")])
        while True:
            yield bytes(1000)
            if has_left.is_set():
                return

    server = page_server(app, "127.0.0.1", 0, buffer=1 << 20)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        with socket.create_connection(("127.0.0.1", server.port)) as browser:
            browser.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            assert browser.recv(64).startswith(b"HTTP/1.1 200")
            browser.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # without a farewell
        has_left.set()
        for connection in threading.enumerate():
            if "process_request_thread" in connection.name:
                connection.join(60.0)
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
    assert capfd.readouterr().err == ""
