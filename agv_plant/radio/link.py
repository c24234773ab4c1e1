"""One direction of the radio: a channel, the messages under way in it, and what the receiver holds after a slot."""

from __future__ import annotations

import heapq
from typing import NamedTuple

from agv_plant.channels.position_dependent import NOWHERE
from agv_plant.radio.channel import Channel
from agv_plant.radio.delay import soonest, whole_slots
from agv_plant.radio.link_counts import LinkCounts
from agv_ros.messages import DELAYED, DELIVERED, LOST, Slot
from agv_ros.stamps import MAX_LEAP, Grid, NearestSteps, Steps


class Passage(NamedTuple):
    """Result of a slot of the link: its outcome, and the messages that arrive in it, in order."""

    slot: Slot
    arrived: list[bytes]


class Link(LinkCounts):
    """A channel with the messages under way in it, the memory of the receiver behind it, and a count of what happened.

    Theory of operation. A slot is taken by the message of its step. What is not lost joins those under way, once or
    twice, with its instant of arrival; then all arrive that are due, in the order of these instants. So the slot says
    what the receiver holds after them, and both are functions of the stamps alone. A message that is sent again at once
    has the same outcome; if it is lost, the freshest one that has come through comes again, for a receiver that was
    started again meanwhile and has forgotten it.
    """

    def __init__(self, channel: Channel, grid: Grid, keeps_to_grid: bool = True, window: int = MAX_LEAP) -> None:
        super().__init__()
        self.channel = channel
        self._steps = Steps(grid, window) if keeps_to_grid else NearestSteps(grid.ts_ns)
        self._freshest_ns = 0
        self._freshest: list[bytes] = []
        self._sent_ns = -1
        self._under_way: list[tuple[int, float, int, int, bytes]] = []
        self._order = 0

    def limit_window(self, steps: int) -> None:
        """From now on a stamp on the grid may be this many steps after the newest one."""
        if isinstance(self._steps, Steps):
            self._steps.window = steps

    def transmit(self, stamp_ns: int, message: bytes = b"", place: tuple[float, float] = NOWHERE) -> Passage:
        """The slot of the message with this stamp, sent when the AGV is at `place` [m].

        Raises OffGridError if the stamp is not a sampling instant but should be one.
        """
        k = self._steps.of(stamp_ns)
        if k == 0:  # begins a run: whatever is held or under way of a run before it is past
            self._freshest_ns, self._freshest, self._under_way = 0, [], []
        outcome = self.channel.outcome(k, *place)
        wait = 0 if outcome.lost else self._send(k, stamp_ns, message)
        self.count(outcome, wait > 0)
        arrived = []
        while self._under_way and self._under_way[0][0] <= k:
            *_, sent_ns, data = heapq.heappop(self._under_way)
            arrived.append(data)
            if sent_ns >= self._freshest_ns:
                self._freshest_ns, self._freshest = sent_ns, [data]
        is_again, self._sent_ns = stamp_ns == self._sent_ns, stamp_ns
        if is_again and not arrived:
            arrived = [*self._freshest]
        word = LOST if outcome.lost else DELAYED if wait else DELIVERED
        note = self.note(outcome, *([f"delay={wait}"] if wait else []))
        return Passage(Slot(stamp_ns, self._freshest_ns, word, note), arrived)

    def _send(self, k: int, stamp_ns: int, message: bytes) -> int:
        """Put a message, and its copy if there is one, under way; returns the slots until the first of them arrives."""
        first, copy = self.channel.delays(k)
        for delay in (first, copy):
            if delay >= 0.0:
                arrival = k + whole_slots(delay), k + delay
                heapq.heappush(self._under_way, (*arrival, self._order, stamp_ns, message))
                self._order += 1
        self.copies += first >= 0.0 and copy >= 0.0
        return soonest(first, copy)
