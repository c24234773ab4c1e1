"""When the edge steps behind a relay: once for each slot that it announces, lost or not.

Theory of operation. A slot may be answered once the pose that it names is here (`MessageSync`). A policy that uses the
commands which were sent waits for one thing more: the command that answers the step before, unless the next slot comes
first. No clock, no thread, no ROS in here: poses and slots go in, steps come out.
"""

from __future__ import annotations

from collections import deque

from agv_cloud.staleness.estimate import PoseEstimator
from agv_cloud.step import EdgeStep
from agv_ros.message_sync import Joined, MessageSync
from agv_ros.messages import Slot, StampedPose
from agv_ros.stamps import MAX_LEAP, Grid, Steps


class SlotStepping:
    """Turns poses and slots into steps; `blind` counts slots before the first pose, which cannot be answered."""

    def __init__(self, grid: Grid, window: int = MAX_LEAP) -> None:
        self._grid = grid
        self._steps = Steps(grid, window)
        self._sync: MessageSync[StampedPose] = MessageSync(grid.start_ns)
        self._ready: deque[Joined[StampedPose]] = deque()
        self._answered = -1
        self.blind = 0

    @property
    def unanswered(self) -> int:
        """Slots whose pose never came."""
        return self._sync.unanswered

    @property
    def beginnings(self) -> int:
        """Runs that began with a slot: 1 is the first."""
        return self._sync.beginnings

    @property
    def outdated(self) -> int:
        """Poses and slots that came too late to matter, or a second time."""
        return self._sync.outdated

    def step_of(self, stamp_ns: int) -> int:
        """Step of a stamp. Raises OffGridError for one that is not a sampling instant of the run."""
        return self._steps.of(stamp_ns)

    def limit_window(self, steps: int) -> None:
        """From now on a stamp may be this many steps after the newest one."""
        self._steps.window = steps

    def add_pose(self, pose: StampedPose) -> None:
        """Take a pose."""
        self._ready.extend(self._sync.add_message(pose))

    def reject_pose(self, stamp_ns: int) -> None:
        """The pose with this stamp came but cannot be used: its slot goes on with the pose held before."""
        self._ready.extend(self._sync.reject(stamp_ns))

    def add_slot(self, slot: Slot) -> None:
        """Take a slot."""
        self._ready.extend(self._sync.add_slot(slot))

    def next(self, estimator: PoseEstimator) -> EdgeStep | None:
        """The next step to take now, None if there is none; it counts as answered from here on."""
        while self._ready and self._may_answer(estimator):
            joined = self._ready.popleft()
            if joined.message is None:
                self.blind += 1
                continue
            self._answered = self._grid.step(joined.slot.stamp_ns)
            return EdgeStep(self._answered, self._grid.step(joined.message.stamp_ns), joined.message)
        return None

    def _may_answer(self, estimator: PoseEstimator) -> bool:
        """A prediction waits for the command that answers the step before, unless the next step comes first."""
        if not estimator.uses_commands or len(self._ready) > 1:
            return True
        k = self._grid.step(self._ready[0].slot.stamp_ns)
        return k - 1 != self._answered or estimator.has_command(k - 1)
