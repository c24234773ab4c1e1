"""What a node's process says to systemd: that it is up, that its executor still runs callbacks, that it ends.

Without systemd, where NOTIFY_SOCKET is not set, nothing is said. Source: sd_notify(3) and sd_watchdog_enabled(3) of
systemd.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping

READY, ALIVE, STOPPING = "READY=1", "WATCHDOG=1", "STOPPING=1"


def notify(state: str, environment: Mapping[str, str] = os.environ) -> None:
    """Send a state to the service manager; one that does not listen any more is no reason for a node to fail."""
    path = environment.get("NOTIFY_SOCKET", "")
    if not path.startswith(("/", "@")):
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
        try:
            sender.sendto(state.encode(), path.replace("@", "\0", 1) if path.startswith("@") else path)
        except OSError:
            return


def watchdog_period(environment: Mapping[str, str] = os.environ) -> float | None:
    """How often [s] this process has to say that it is alive: twice in the time allowed; None without a watchdog."""
    allowed = environment.get("WATCHDOG_USEC", "")
    meant = environment.get("WATCHDOG_PID", "") in ("", str(os.getpid()))
    return int(allowed) * 0.5e-6 if allowed.isdecimal() and int(allowed) > 0 and meant else None
