"""The command that drives the AGV in real time: the newest one, until it is too old."""

from __future__ import annotations

from agv_ros.messages import Command


class ZeroOrderHold:
    """Zero-order hold with a limit on age.

    `outdated` counts commands that are ignored: they came after a newer one, carry a stamp from the future and would
    hold until then, or came a second time. `stops` counts how often the AGV was stopped because it had no command.
    """

    def __init__(self, timeout_ns: int) -> None:
        self._timeout_ns = timeout_ns
        self._newest: Command | None = None
        self._now_ns: int | None = None
        self._stopped = False
        self.outdated = 0
        self.stops = 0

    def offer(self, command: Command) -> None:
        """Take a command; one that is older than the newest, or newer than the last instant, is ignored."""
        is_early = self._now_ns is not None and command.stamp_ns > self._now_ns
        is_late = self._newest is not None and command.stamp_ns < self._newest.stamp_ns
        if is_early or is_late or command == self._newest:
            self.outdated += 1
            return
        self._newest = command

    def at(self, stamp_ns: int) -> Command:
        """The command that holds at an instant: zero before the first and beyond the limit on age."""
        self._now_ns = stamp_ns
        newest = self._newest
        if newest is not None and newest.stamp_ns > stamp_ns:  # offered before the first instant was known
            self._newest = newest = None
            self.outdated += 1
        if newest is None:
            return Command(stamp_ns, 0.0, 0.0)
        too_old = stamp_ns - newest.stamp_ns > self._timeout_ns
        self.stops += too_old and not self._stopped
        self._stopped = too_old
        return Command(stamp_ns, 0.0, 0.0) if too_old else newest
