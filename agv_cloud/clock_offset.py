"""The freshest pose at an edge that steps by its own clock, and what that clock says in the AGV's time.

Theory of operation. Behind a real radio lost slots are not announced, and two hosts have two clocks. The edge therefore
steps by its own clock, in the time of the AGV's stamps. Own time minus stamp is the clocks' offset plus
the time that a pose was under way; the least of the last while is taken for the offset, so that the edge is late by the
least delay and never ahead. It is forgotten after 10 to 20 s, since one clock may run slower than the other.

A stamp that is more than a second away from that time is rejected; but if this persists, the AGV or its clock has been
restarted, and the edge begins again with the last of these stamps. Where both clocks are one, a simulator's on /clock,
they go back together, when it is reset or a recording begins again: then the next pose of the new time is a beginning.

No clock, no thread, no ROS in here: poses and instants go in.
"""

from __future__ import annotations

from agv_ros.messages import StampedPose
from agv_ros.stamps import NS_PER_S

WINDOW_NS = 10 * NS_PER_S
"""Least offsets are taken over this time and the one before it."""

ACCEPTED_NS = NS_PER_S
"""A stamp may be this far from the time that the edge knows."""

IN_A_ROW = 5
"""This many rejected stamps, one after the other, are a new beginning."""


class FreshestPose:
    """Keeps the freshest pose and the AGV's time; instants are [ns], `now_ns` on the edge's own clock.

    `future` counts stamps that were more than a period ahead of the time that the edge knew, rejected or not;
    `outdated` poses that came after a fresher one, or a second time; `beginnings` the runs: 1 is the first one.
    """

    def __init__(self, ts_ns: int) -> None:
        self._ts_ns = ts_ns
        self.pose: StampedPose | None = None
        self.first_ns = 0
        """Stamp of the first pose of the run."""
        self._least_ns = self._least_before_ns = self._window_since_ns = 0
        self._rejected = 0
        self._now_ns = 0
        self.future = 0
        self.outdated = 0
        self.beginnings = 0

    @property
    def offset_ns(self) -> int:
        """Own time minus the AGV's, plus the least time under way; 0 before the first pose."""
        return min(self._least_ns, self._least_before_ns)

    def time(self, now_ns: int) -> int:
        """The AGV's time."""
        return now_ns - self.offset_ns

    def offer(self, pose: StampedPose, now_ns: int) -> bool:
        """Take a pose that has just come; is it now the freshest one?"""
        ahead_ns = pose.stamp_ns - self.time(now_ns)
        # A clock that was set has gone back, too, but the stamps have not.
        went_back, self._now_ns = now_ns < self._now_ns - self._ts_ns, now_ns
        is_other_time = self.pose is not None and (pose.stamp_ns < self.pose.stamp_ns or abs(ahead_ns) > ACCEPTED_NS)
        if self.pose is None or (went_back and is_other_time):
            self._begin(pose, now_ns)
            return True
        self.future += ahead_ns > self._ts_ns
        if abs(ahead_ns) > ACCEPTED_NS:
            self._rejected += 1
            self.outdated += ahead_ns < 0
            if self._rejected == IN_A_ROW:
                self._begin(pose, now_ns)
            return self._rejected == 0
        self._rejected = 0
        self._learn(now_ns - pose.stamp_ns, now_ns)
        if pose.stamp_ns <= self.pose.stamp_ns:
            self.outdated += 1
            return False
        self.pose = pose
        return True

    def _begin(self, pose: StampedPose, now_ns: int) -> None:
        self.pose, self.first_ns = pose, pose.stamp_ns
        self._least_ns = self._least_before_ns = now_ns - pose.stamp_ns
        self._window_since_ns = now_ns
        self._rejected = 0
        self.beginnings += 1

    def _learn(self, difference_ns: int, now_ns: int) -> None:
        if now_ns - self._window_since_ns > WINDOW_NS:
            self._least_before_ns, self._least_ns = self._least_ns, difference_ns
            self._window_since_ns = now_ns
        self._least_ns = min(self._least_ns, difference_ns)
