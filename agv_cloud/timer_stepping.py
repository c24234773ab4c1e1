"""When the edge steps by its own clock: every sampling period of the AGV's time, from the first pose on.

No clock, no thread, no ROS in here: poses and instants go in, steps come out.
"""

from __future__ import annotations

from agv_cloud.clock_offset import FreshestPose
from agv_cloud.step import EdgeStep
from agv_ros.messages import StampedPose
from agv_ros.stamps import MAX_FIRST, NS_PER_S, Grid, Steps


class OutsideRunError(ValueError):
    """The first pose has a stamp that lies in no run with this start time."""


class TimerStepping:
    """Keeps the freshest pose, and says at each tick which step is due.

    `grid` is that of the run; with `from_first_pose` its step 0 is the instant of the first pose. `missed` counts the
    steps for which no tick came, `oldest_ns` is the largest age [ns] of a pose that was used.
    """

    def __init__(self, grid: Grid, from_first_pose: bool) -> None:
        self.grid = grid
        self.freshest = FreshestPose(grid.ts_ns)
        self._from_first_pose = from_first_pose
        self._steps = Steps(grid)
        self._answered = -1
        self.missed = 0
        self.oldest_ns = 0

    def step_of(self, stamp_ns: int) -> int:
        """Step of a stamp. Raises OffGridError for one that is not a sampling instant of the run."""
        return self._steps.of(stamp_ns)

    def add_pose(self, pose: StampedPose, now_ns: int) -> bool:
        """Take a pose that has just come, `now_ns` on the edge's clock; does a run begin with it?

        One begins with the first pose of the AGV, and when the AGV has been restarted. Raises OutsideRunError.
        """
        beginnings = self.freshest.beginnings
        self.freshest.offer(pose, now_ns)
        if self.freshest.beginnings == beginnings:
            return False
        self._begin()
        return True

    def _begin(self) -> None:
        first_ns, ts_ns = self.freshest.first_ns, self.grid.ts_ns
        if self._from_first_pose:
            self.grid = Grid(first_ns, ts_ns)
        elif not 0 <= first_ns - self.grid.start_ns <= MAX_FIRST * ts_ns:
            raise OutsideRunError(
                f"the first pose has the stamp {first_ns / NS_PER_S:.3f} s, which is in no run that begins at "
                f"start_time = {self.grid.start_ns / NS_PER_S:g} s: set it, or set error_detector.begin to first_pose"
            )
        self._steps = Steps(self.grid)
        self._answered = -1

    def tick(self, now_ns: int) -> EdgeStep | None:
        """The step that is due, `now_ns` on the edge's clock; None before the first pose, or if it has been taken."""
        pose = self.freshest.pose
        if pose is None:
            return None
        k = self._step_at(self.freshest.time(now_ns), self.grid.ts_ns // 100)
        if k <= self._answered:
            return None
        self.missed += k - self._answered - 1 if self._answered >= 0 else 0
        self._answered = k
        self.oldest_ns = max(self.oldest_ns, self.grid.stamp(k) - pose.stamp_ns)
        return EdgeStep(k, min(k, self._step_at(pose.stamp_ns, self.grid.ts_ns // 2)), pose)

    def _step_at(self, stamp_ns: int, early_ns: int) -> int:
        """The last step at an instant; one that is only `early_ns` ahead counts."""
        return max(0, (stamp_ns - self.grid.start_ns + early_ns) // self.grid.ts_ns)
