"""What keeps other pages and other people out of the explorer, and what bounds a request.

A browser lets any page send requests to this machine, so a port of 127.0.0.1 is not a wall. The address that is printed
has a secret path, which no other page knows; a request must name this host, so that no name of an attacker's stands for
it, and if the browser says which page it comes from, that must be ours.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from agv_analysis.scenario import SCHEMAS, Scenario
from agv_cloud.reference.track_file import TrackFileError
from agv_plant.channels.trace import TraceError
from agv_ros.errors import UserError
from agv_ros.parameters import ParameterError, as_dict

MOST_BYTES = 2**20
"""Of the body of a request."""

MOST_STEPS = 500_000
"""Of a run that the page asks for: some 150 MB."""

_HEADERS = {
    "Cache-Control": "no-store", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY", "Cross-Origin-Resource-Policy": "same-origin",
}  # fmt: skip


THIS_HOST = ("127.0.0.1", "localhost")


def guard(server: Any, port: int, names: Sequence[str] = THIS_HOST) -> None:
    """Let a Flask server answer to pages of its own alone, on this port, and to requests of a bounded size.

    `names` are those by which a request may call this host.
    """
    flask: Any = importlib.import_module("flask")
    errors: Any = importlib.import_module("werkzeug.exceptions")
    hosts = {f"{name}:{port}" for name in names}
    origins = {f"http://{host}" for host in hosts}
    server.config["MAX_CONTENT_LENGTH"] = MOST_BYTES

    @server.before_request
    def check() -> None:
        request = flask.request
        if request.host not in hosts or request.headers.get("Origin", next(iter(origins))) not in origins:
            flask.abort(403)
        if request.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
            flask.abort(403)
        if "Transfer-Encoding" in request.headers:  # its length is not known beforehand
            flask.abort(411)

    @server.after_request
    def close_up(response: Any) -> Any:
        response.headers.update(_HEADERS)
        return response

    @server.errorhandler(Exception)
    def refuse(error: Exception) -> Any:
        """What the page itself never asks for, said without what is in this process or in its files."""
        if isinstance(error, errors.HTTPException):
            return error
        status = 503 if isinstance(error, MemoryError) else 400
        return f"the request is not understood ({type(error).__name__})", status


def check_request(base: Scenario, scenario: Scenario, folder: Path) -> Scenario:
    """The scenario that a page asks for. Raises ParameterError for more steps than `MOST_STEPS`, or files elsewhere.

    What `base` has, which its user has chosen, is allowed; other files are only those below `folder`.
    """
    most = max(MOST_STEPS, _steps(base))
    if not _steps(scenario) <= most:
        raise ParameterError(
            f"the page simulates {most:.0f} steps at most, got plant.duration / plant.ts = {_steps(scenario):g}"
        )
    for node in SCHEMAS:
        known = as_dict(getattr(base, node))
        for name, value in as_dict(getattr(scenario, node)).items():
            if name.endswith("_file") and value not in ("", known[name]) and not _is_below(folder, str(value)):
                raise ParameterError(f"{node}.{name} must be a file below {folder}, where the page was started")
    return scenario


def _steps(scenario: Scenario) -> float:
    return scenario.plant.duration / scenario.plant.ts


def _is_below(folder: Path, path: str) -> bool:
    try:
        return Path(path).resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError):
        return False


def said(error: UserError) -> str:
    """An error for the page: what is in a file is not shown."""
    if isinstance(error, (TraceError, TrackFileError)):
        return "the trace or track file cannot be used; `agv-ncs simulate` says why"
    return str(error)
