"""The command that drives the AGV in real time: the newest one, until it is too old."""

from __future__ import annotations

from collections import deque

from agv_ros.messages import Command


class ZeroOrderHold:
    """Zero-order hold with a limit on age.

    A command that is ahead of the clock, by `ahead_ns` at most, waits for its own instant: an edge with a clock of its
    own may be a little before the AGV, whose ticks have jitter, and goes on where these pause. `outdated` counts the
    commands that are ignored: they came after a newer one, are further ahead and would hold until then, or came a
    second time. `stops` counts how often the AGV was stopped because it had no command.
    """

    def __init__(self, timeout_ns: int, ahead_ns: int = 0) -> None:
        self._timeout_ns = timeout_ns
        self._ahead_ns = ahead_ns
        self._newest: Command | None = None
        self._waiting: deque[Command] = deque()
        self._now_ns: int | None = None
        self._stopped = False
        self.outdated = 0
        self.stops = 0

    def offer(self, command: Command) -> None:
        """Take a command; one that is older than the newest, or too far ahead of the last instant, is ignored."""
        ahead_ns = 0 if self._now_ns is None else command.stamp_ns - self._now_ns
        if 0 < ahead_ns <= self._ahead_ns and (not self._waiting or command.stamp_ns > self._waiting[-1].stamp_ns):
            self._waiting.append(command)
            return
        is_late = self._newest is not None and command.stamp_ns < self._newest.stamp_ns
        if ahead_ns > 0 or is_late or command == self._newest:
            self.outdated += 1
            return
        self._newest = command

    def at(self, stamp_ns: int) -> Command:
        """The command that holds until an instant: zero before the first and beyond the limit on age."""
        while self._waiting and self._waiting[0].stamp_ns < stamp_ns:  # the period that it is for has begun
            if self._newest is None or self._newest.stamp_ns < self._waiting[0].stamp_ns:
                self._newest = self._waiting.popleft()
            else:
                self._waiting.popleft()
                self.outdated += 1
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
