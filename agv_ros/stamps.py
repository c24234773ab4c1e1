"""The grid of sampling instants: stamp of step k and back.

A step's number always comes from a message's stamp, never from counting callbacks: a lost, repeated or reordered
message then cannot shift the loop's time.
"""

from __future__ import annotations

from typing import NamedTuple

NS_PER_S = 1_000_000_000

LATEST_NS = 2**31 * NS_PER_S - 1
"""The latest instant [ns] that a stamp of ROS can hold."""


class OffGridError(ValueError):
    """A stamp that is not a sampling instant t_k with k >= 0."""


def to_nanoseconds(seconds: float) -> int:
    """Nearest whole nanosecond of a duration or instant [s]."""
    return round(seconds * NS_PER_S)


class Grid(NamedTuple):
    """Sampling instants t_k = start_ns + k ts_ns."""

    start_ns: int
    ts_ns: int

    @classmethod
    def of(cls, start_time: float, ts: float) -> Grid:
        """Grid that starts at `start_time` [s] with sampling period `ts` [s]."""
        return cls(to_nanoseconds(start_time), to_nanoseconds(ts))

    def stamp(self, k: int) -> int:
        """Instant t_k [ns] of step k."""
        return self.start_ns + k * self.ts_ns

    def step(self, stamp_ns: int) -> int:
        """Step k whose instant is `stamp_ns`.

        Raises OffGridError if the stamp lies between two steps or before the first.
        """
        k, rest = divmod(stamp_ns - self.start_ns, self.ts_ns)
        if rest or k < 0:
            raise OffGridError(
                f"stamp {stamp_ns / NS_PER_S:.9f} s is not on the grid {self.start_ns / NS_PER_S} s + "
                f"k * {self.ts_ns / NS_PER_S} s: do all nodes have the same ts and start_time?"
            )
        return k


MAX_LEAP = 1_000_000
"""Most steps between two messages of a run that are accepted: 83 minutes at 5 ms."""

MAX_FIRST = 100_000_000
"""Latest step at which a node may join a running loop: 5.8 days at 5 ms."""


AGREEING = 10
"""So many messages in a row, each within the window of the one before, show that the loop itself has leapt."""


class Steps:
    """Steps of a running loop: as `Grid.step`, but a wrong stamp cannot send a node far into the future.

    A stamp more than `window` steps after the furthest one is refused, unless those before it, one after the other,
    agree with it: then the messages are right, and the loop has paused or leapt.
    """

    def __init__(self, grid: Grid, window: int = MAX_LEAP) -> None:
        self._grid, self.window = grid, window
        self._last: int | None = None
        self._beyond = 0
        """Step of the last stamp that was refused, and how many in a row agree with each other."""
        self._agreeing = 0

    def of(self, stamp_ns: int) -> int:
        """Step of a stamp. Raises OffGridError for no sampling instant, or one too far after the newest one."""
        k = self._grid.step(stamp_ns)
        latest = MAX_FIRST if self._last is None else self._last + self.window
        if k > latest and not self._agrees(k):
            raise OffGridError(
                f"stamp {stamp_ns / NS_PER_S:.9f} s is step {k}, the furthest one seen was {self._last}; "
                f"steps up to {latest} are accepted: do all nodes have the same start_time?"
            )
        # What comes late, or begins a run anew, does not take the window back: those after it would be beyond it.
        self._last, self._agreeing = k if self._last is None else max(k, self._last), 0
        return k

    def _agrees(self, k: int) -> bool:
        """Has the loop leapt to step k, as enough messages in a row say?"""
        follows = self._agreeing > 0 and 0 < k - self._beyond <= self.window
        self._agreeing, self._beyond = self._agreeing + 1 if follows else 1, k
        return self._last is not None and self._agreeing >= AGREEING and k <= self._last + MAX_FIRST


class NearestSteps:
    """Steps of stamps that are on no grid, as another robot's: each is assigned to the nearest step since the first."""

    def __init__(self, ts_ns: int) -> None:
        self._ts_ns = ts_ns
        self._first_ns = 0
        self._last = -1
        self._back = Backwards(BACK_NS)

    def of(self, stamp_ns: int) -> int:
        """Step of a stamp; one before the first, or more than MAX_LEAP steps past the last, is a new first one.

        So is the last of AGREEING stamps in a row that are far behind the newest: the clock has gone back. Raises
        OffGridError for the stamp 0, which means no time.
        """
        if stamp_ns == 0:
            raise OffGridError("the stamp is 0, which means 'no time': its sender must set header.stamp")
        k = (stamp_ns - self._first_ns + self._ts_ns // 2) // self._ts_ns
        if self._back.has_gone_back(stamp_ns) or self._last < 0 or not 0 <= k <= self._last + MAX_LEAP:
            self._first_ns, k = stamp_ns, 0
            self._back = Backwards(BACK_NS, stamp_ns)
        self._last = k
        return k


BACK_NS = NS_PER_S
"""What is so far [ns] behind the newest stamp was not overtaken on its way."""


class Backwards:
    """Tells a clock that has gone back, as by a reset simulator or a recording that begins again, from late messages.

    It has once AGREEING stamps in a row, each after the one before it, are far behind the newest.
    """

    def __init__(self, far_ns: int, newest_ns: int = 0) -> None:
        self._far_ns, self._newest_ns = far_ns, newest_ns
        self._before_ns, self._agreeing = 0, 0

    def has_gone_back(self, stamp_ns: int) -> bool:
        """Is this the stamp by which that is known?"""
        if stamp_ns > self._newest_ns - self._far_ns:
            self._newest_ns, self._agreeing = max(self._newest_ns, stamp_ns), 0
            return False
        follows = self._agreeing > 0 and stamp_ns > self._before_ns
        self._agreeing, self._before_ns = self._agreeing + 1 if follows else 1, stamp_ns
        if self._agreeing < AGREEING:
            return False
        self._newest_ns, self._agreeing = stamp_ns, 0
        return True
