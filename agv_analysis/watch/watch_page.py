"""Serves the page of a watched loop: frames as server-sent events, and what its buttons and sliders ask for."""

from __future__ import annotations

import importlib
import math
import secrets
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from agv_analysis.explore.guard import THIS_HOST, guard
from agv_analysis.explore.page_server import page_server
from agv_analysis.watch.watch_session import Edition, WatchSession
from agv_ros.errors import UserError

_PAGE = Path(__file__).with_name("watch.html")

_MOST_VIEWERS = 8
"""Pages that may be open at a time."""

_MOST_SLOTS, _MOST_SECONDS = 100_000, 600.0
"""Longest outage that can be asked for."""

_SECURITY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; connect-src 'self'"
)


def app_of(session: WatchSession, path: str) -> Any:
    """The page as a Flask app at a path that ends with a slash. Raises UserError if Flask is not installed."""
    try:
        flask: Any = importlib.import_module("flask")
    except ImportError:
        raise UserError("the page needs Flask: pip install 'agv_ncs[explore]'") from None
    app = flask.Flask("agv_ncs", static_folder=None)
    html = _PAGE.read_text(encoding="utf-8")

    @app.get(path)
    def page() -> Any:
        return flask.Response(html, mimetype="text/html", headers={"Content-Security-Policy": _SECURITY})

    @app.get(f"{path}events")
    def events() -> Any:
        if session.viewers >= _MOST_VIEWERS:
            return f"{_MOST_VIEWERS} pages are open already", 503
        session.add_viewer(1)
        return flask.Response(_frames(session), mimetype="text/event-stream")

    def answer(act: Any) -> Any:
        try:
            return {"said": act()}
        except (UserError, OSError, ValueError) as error:
            return {"refused": str(error)}, 409

    @app.post(f"{path}set")
    def set_parameter() -> Any:
        asked = flask.request.get_json()
        return answer(lambda: session.set(str(asked["target"]), _number(asked["value"])))

    @app.post(f"{path}lose")
    def lose() -> Any:
        asked = flask.request.get_json()
        slots, seconds = asked.get("slots"), float(asked.get("seconds", 0.0))
        if not (isinstance(slots, int) and 0 < slots <= _MOST_SLOTS) and not 0.0 < seconds <= _MOST_SECONDS:
            return {"refused": f"an outage has 1 to {_MOST_SLOTS} slots, or at most {_MOST_SECONDS:g} s"}, 409
        return answer(lambda: session.lose(slots, seconds))

    @app.post(f"{path}save")
    def save() -> Any:
        return answer(session.save)

    @app.post(f"{path}stop")
    def stop() -> Any:
        if session.stop is None:
            return {"refused": "only a run that `agv-ncs run --live` has started can be stopped here"}, 409
        session.stop()
        return {"said": "asked the run to end"}

    return app


def _number(value: Any) -> float | None:
    if value is not None and (
        isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value)
    ):
        raise ValueError(f"must be a number, got {value!r}")
    return value


def _frames(session: WatchSession) -> Iterator[str]:
    """Frames until the session or the connection ends; the last one is of the session's end."""
    since, edition, seen, is_last = 0, Edition(), -1, False
    try:
        while not is_last:
            with session.changed:
                session.wait_for_frame(seen)
                seen, is_last = session.frames, session.is_closed
                content, since, edition = session.frame(since, edition)
            yield f"data: {content}\n\n"
    finally:
        session.add_viewer(-1)


@contextmanager
def served(session: WatchSession, host: str, port: int) -> Iterator[str]:
    """Serve the page meanwhile; gives its address. Port 0: any free one.

    Raises UserError if host or port cannot be used or Flask is not installed.
    """
    path = f"/{secrets.token_urlsafe(16)}/"
    app = app_of(session, path)
    # The buffer is flushed after each frame, so that one call sends a frame, not four.
    server = page_server(app, host, port, buffer=1 << 16)
    guard(app, server.port, (host, *(THIS_HOST if host in THIS_HOST else ())))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://{host}:{server.port}{path}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
