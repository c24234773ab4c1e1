"""A running loop as its topics tell it: each message becomes values of its step, and steps become points to draw."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator

from agv_analysis.metrics.bands import TOLERANCE
from agv_analysis.scenario import Scenario
from agv_analysis.watch.largest_of_last import LargestOfLast
from agv_analysis.watch.message_log import Heard
from agv_analysis.watch.step_ring import COLUMNS, StepRing
from agv_cloud.parameters import PATH
from agv_cloud.reference.reference import Reference
from agv_ros.codec import decode_command, decode_error, decode_slot, pose_decoder
from agv_ros.message_types import TWIST
from agv_ros.messages import DELAYED, LOST, InvalidMessageError
from agv_ros.stamps import AGREEING, to_nanoseconds

TOPICS = ("edge/slot", "agv/slot", "agv/pose", "edge/error", "edge/cmd_vel", "agv/cmd_vel", "/diagnostics")
"""What is heard; the number of a topic is its place here. They are taken from in this order: a slot is published after
its message, so the message of each slot is here by then."""

DIAGNOSTICS = TOPICS.index("/diagnostics")

MINUTES = 10.0
"""How far back is kept."""

POINT_SECONDS = 0.05
"""Time of the loop behind one point to draw: 20 a second."""

POINTS = ("time", "x", "y", "deviation", "speed", "age", "lost", "commands_lost")
"""A point: time since step 0 [s] of its last step, and where the AGV was then [m]; the largest deviation [m], the last
speed [m/s] and the largest age [s] in it; slots of up- and downlink that were lost in it."""

LOOK_BACK = 60.0
"""Time [s] of the loop over which the largest deviation is said."""

_MOST_STEPS = 2_000_000
"""Steps that are kept at most, in 180 MB."""

FAR = 60.0
"""A stamp so far [s] after the newest slot is not believed, unless others agree: not a node's window, as here messages
may be missed."""

_DEVIATION = POINTS.index("deviation")
_X, _X_E, _AGE = (COLUMNS.index(name) for name in ("x", "x_e", "age"))

_RECENT, _BEFORE = 20, 1.0
"""Steps in which the newest value is looked for first, and time [s] before them in which it is looked for then: of a
busy machine's messages a page may miss all of one topic for tenths of a second."""

_BEHIND, _MOST_BEHIND = 2, 60
"""Points are made so many points late, when the messages of their steps are here, and at most so many."""


class LiveLoop:
    """What was seen of one loop since it began, or since it was first heard."""

    def __init__(self, scenario: Scenario) -> None:
        plant, detector = scenario.plant, scenario.error_detector
        self.scenario = scenario
        self.ts = plant.ts
        self.steps_per_point = max(1, round(POINT_SECONDS / plant.ts))
        self.most_points = round(60.0 * MINUTES / (self.steps_per_point * plant.ts))
        self._ts_ns, self._start_ns = to_nanoseconds(plant.ts), to_nanoseconds(plant.start_time)
        self._window = math.ceil(FAR / plant.ts)
        self._on_grid = scenario.relay.stamps == "grid"
        self._is_timed = detector.trigger == "timer"
        is_known = detector.track != PATH and self._on_grid and not self._is_timed
        self._reference = Reference(detector) if is_known else None
        decode = pose_decoder(scenario.relay.pose_type)
        command = TOPICS.index("edge/cmd_vel" if scenario.relay.command_type == TWIST else "agv/cmd_vel")
        self._on: dict[int, Callable[[bytes], None]] = {
            TOPICS.index("edge/slot"): self._on_slot,
            TOPICS.index("agv/pose"): lambda data: self._on_pose(*decode(data)),
            command: self._on_command,
            TOPICS.index("agv/slot"): self._on_command_slot,
        }
        if self._reference is None:
            self._on[TOPICS.index("edge/error")] = self._on_error
        self.restarts = 0
        self._clear()

    def _clear(self) -> None:
        self.ring = StepRing(min(_MOST_STEPS, math.ceil(60.0 * MINUTES / self.ts)))
        self.rejected: Counter[str] = Counter()
        self.first = -1
        """The first slot that was seen."""
        self.slots = self.lost = self.command_slots = self.commands_lost = 0
        self.delayed = 0
        self.outage = self.longest_outage = 0
        """Length of the outage that goes on, and of the longest one [slots]."""
        self.skipped = 0
        """Slots that were not seen, between others that were."""
        self.points: list[list[float]] = []
        self.settled = -1
        """Number of the first point at which the AGV was less than 1 cm from its reference; -1: there is none."""
        self.settled_at: float | None = None
        """Its time [s]."""
        self.points_before = 0
        """Points that are kept no longer."""
        self._largest = LargestOfLast(max(1, round(LOOK_BACK / (self.steps_per_point * self.ts))))
        self._recent: list[list[float]] | None = None
        """Rows of the last steps, the newest first; None: messages have come since they were looked up."""
        self._last_slot = self._last_command_slot = -1
        self._next_point = -1
        self._newest_ns = 0
        self._origin_ns = self._start_ns if self._on_grid else -1
        self._beyond = 0
        """Slots in a row that are far after the newest one."""

    @property
    def k(self) -> int:
        """The newest step of which a slot was seen; -1: none."""
        return self._last_slot

    def take(self, messages: Iterable[Heard]) -> None:
        """Take in messages in the order of their topics and, of one topic, of time."""
        self._recent = None
        for topic, data, _ in messages:
            act = self._on.get(topic)
            if act is not None:
                try:
                    act(data)
                except InvalidMessageError:
                    self.rejected[TOPICS[topic]] += 1

    def _step(self, stamp_ns: int) -> int:
        """The step of a stamp; of a robot with a clock of its own the nearest one since the first."""
        if self._origin_ns < 0:
            self._origin_ns = stamp_ns
        k = (stamp_ns - self._origin_ns + self._ts_ns // 2) // self._ts_ns
        if k < 0:
            raise InvalidMessageError(f"stamp {stamp_ns} is before the first step")
        if 0 <= self._last_slot < k - self._window and self._beyond < AGREEING:
            raise InvalidMessageError(f"stamp {stamp_ns} is far after that of the newest slot")
        return k

    def _on_pose(self, stamp_ns: int, x: float, y: float, theta: float) -> None:
        self.ring.put(self._step(stamp_ns), "x", x, y, theta)

    def _on_slot(self, data: bytes) -> None:
        slot = decode_slot(data)
        is_beyond = slot.stamp_ns > self._newest_ns + self._window * self._ts_ns
        self._beyond = self._beyond + 1 if is_beyond and self._last_slot >= 0 else 0
        k, lost = self._step(slot.stamp_ns), slot.outcome == LOST
        if k == 0 and self._last_slot > 0:  # the loop has begun anew
            self.restarts += 1
            self._clear()
        if k <= self._last_slot:
            return
        age = (slot.stamp_ns - slot.freshest_ns) // self._ts_ns if slot.freshest_ns else math.nan
        self.ring.put(k, "age", float(age), float(lost))
        if self.first < 0:
            self.first, self._last_slot = k, k - 1
            self._next_point = -(-k // self.steps_per_point)
        self.skipped += k - self._last_slot - 1
        self._last_slot, self._newest_ns = k, slot.stamp_ns
        self.slots += 1
        self.lost += lost
        self.delayed += slot.outcome == DELAYED
        self.outage = self.outage + 1 if lost else 0
        self.longest_outage = max(self.longest_outage, self.outage)

    def _on_error(self, data: bytes) -> None:
        error = decode_error(data)
        self.ring.put(self._step(error.stamp_ns), "x_e", error.x_e, error.y_e, error.theta_e)

    def _on_command(self, data: bytes) -> None:
        command = decode_command(data)
        self.ring.put(self._step(command.stamp_ns), "v", command.v, command.w)

    def _on_command_slot(self, data: bytes) -> None:
        slot = decode_slot(data)
        lost = slot.outcome == LOST
        k = self._step(slot.stamp_ns)
        self.ring.put(k, "command_lost", float(lost))
        self._last_command_slot = max(k, self._last_command_slot)
        self.command_slots += 1
        self.commands_lost += lost
        self.delayed += slot.outcome == DELAYED

    # -- what is drawn and said ----------------------------------------------------------------------------------------

    def _deviation(self, k: int, row: list[float]) -> float:
        """Distance of the AGV's pose from the reference [m] at step k, of which `row` is known; NaN if it is not known.

        On a planner's path, or of a robot with a clock of its own, the reference of a step is not known here: there it
        is the tracking error where the edge had a fresh pose, and NaN elsewhere.
        """
        if self._reference is None:
            return math.hypot(row[_X_E], row[_X_E + 1]) if row[_AGE] == 0.0 else math.nan
        if math.isnan(row[_X]):
            return math.nan
        reference = self._reference[k]
        return math.hypot(row[_X] - reference.x, row[_X + 1] - reference.y)

    def make_points(self, is_over: bool = False) -> None:
        """Append the points whose steps are complete; of a loop that is over all but a part of one."""
        if self._next_point >= 0:  # of a long gap what is kept
            self._next_point = max(self._next_point, self._last_slot // self.steps_per_point - self.most_points)
        while self._next_point >= 0 and self._is_complete(self._next_point, is_over):
            begin = self._next_point * self.steps_per_point
            self.points.append(self._point(begin, begin + self.steps_per_point))
            if self.settled < 0 and self.points[-1][_DEVIATION] < TOLERANCE:
                self.settled, self.settled_at = self.points_before + len(self.points) - 1, self.points[-1][0]
            if self.settled >= 0:
                self._largest.add(self.points[-1][_DEVIATION])
            self._next_point += 1
        surplus = len(self.points) - self.most_points
        if surplus > 0:
            del self.points[:surplus]
            self.points_before += surplus

    def _is_complete(self, number: int, is_over: bool) -> bool:
        """Are the messages of a point's steps here, or not to be waited for any longer?"""
        end, seen = (number + 1) * self.steps_per_point, self._last_slot + 1
        if seen < end + (0 if is_over else _BEHIND * self.steps_per_point):
            return False
        answered = not self.command_slots or self._last_command_slot + 1 >= end
        return is_over or answered or seen >= end + _MOST_BEHIND * self.steps_per_point

    def _point(self, begin: int, end: int) -> list[float]:
        rows = self.ring.rows(begin, end).tolist()  # of some ten rows lists are faster than arrays
        deviation = max(_known([self._deviation(k, row) for k, row in enumerate(rows, begin)]), default=math.nan)
        of = {name: _known(values) for name, *values in zip(COLUMNS, *rows, strict=True)}
        x, y, v = (of[name][-1] if of[name] else math.nan for name in ("x", "y", "v"))
        age = max(of["age"], default=math.nan) * self.ts
        return [(end - 1) * self.ts, x, y, deviation, v, age, sum(of["lost"]), sum(of["command_lost"])]

    def recent_deviation(self) -> float:
        """The largest deviation [m] of the points of the last LOOK_BACK seconds; NaN if none is known.

        Only of points from the first one on at which it was below 1 cm, as a report takes it: before, it is the initial
        error.
        """
        return self._largest.value

    def latest(self, name: str) -> float:
        """The newest value that is known of a column; NaN if there is none in the last steps."""
        place = COLUMNS.index(name)
        return next((row[place] for row in self._newest_first() if not math.isnan(row[place])), math.nan)

    def latest_deviation(self) -> tuple[int, float]:
        """The newest step whose deviation is known, and it [m]; -1 and NaN if there is none in the last steps."""
        for back, row in enumerate(self._newest_first()):
            if not math.isnan(found := self._deviation(self.k - back, row)):
                return self.k - back, found
        return -1, math.nan

    def _newest_first(self) -> Iterator[list[float]]:
        """What is known of the steps from `k` back; the first ones are looked up once after each take."""
        begin = max(0, self.k + 1 - _RECENT)
        if self._recent is None:
            self._recent = self.ring.rows(begin, self.k + 1)[::-1].tolist()
        yield from self._recent
        yield from self.ring.rows(max(0, begin - math.ceil(_BEFORE / self.ts)), begin)[::-1].tolist()

    def not_covered(self) -> str:
        """Why the links are none of which the margin knows; empty if they are."""
        if self._is_timed:
            return "the edge steps by its own clock: save the bag, and agv-ncs analyse judges it"
        if self.commands_lost:
            return "commands are lost as well: save the bag, and agv-ncs analyse judges both links"
        if self.delayed:
            return "messages come late: save the bag, and agv-ncs analyse judges it"
        return ""


def _known(values: list[float]) -> list[float]:
    return [value for value in values if not math.isnan(value)]
