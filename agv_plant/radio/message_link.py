"""One direction of the radio for messages of any kind, which need not say when they were sent."""

from __future__ import annotations

import heapq
from typing import Generic, NamedTuple, TypeVar

from agv_plant.channels.position_dependent import NOWHERE
from agv_plant.radio.channel import Channel
from agv_plant.radio.link_counts import LinkCounts
from agv_ros.messages import DELAYED, DELIVERED, LOST

M = TypeVar("M")


class Fate(NamedTuple):
    """What becomes of a message."""

    outcome: str
    """`delivered`, `lost` or `delayed`."""
    arrivals: tuple[int, ...]
    """When it arrives [ns], and when its copy does; () if it is lost."""
    note: str
    """Its slot, and why it was lost or how late it is: words `name=value`."""


class MessageLink(LinkCounts):
    """The channel of one direction, which asks each message for its slot by the instant at which it is sent.

    With a period a slot lasts so long, and all messages in it have one fate; without, each message takes the next slot.
    Slot 0, which is never lost, is the one before the first message. Delays are not rounded to slots here.
    """

    def __init__(self, channel: Channel, ts_ns: int, has_period: bool) -> None:
        """`ts_ns`: length of a slot [ns], as the channel knows it."""
        super().__init__()
        self.channel = channel
        self._ts_ns, self._has_period = ts_ns, has_period
        self._first_ns: int | None = None

    def transmit(self, now_ns: int, place: tuple[float, float] = NOWHERE) -> Fate:
        """The fate of a message that is sent now, when the AGV is at `place` [m]. Instants [ns] never go back."""
        k = self._slot(now_ns)
        outcome = self.channel.outcome(k, *place)
        if outcome.lost:
            self.count(outcome, False)
            return Fate(LOST, (), self.note(outcome, f"slot={k}"))
        delays = [round(slots * self._ts_ns) for slots in self.channel.delays(k) if slots >= 0.0]
        self.copies += len(delays) - 1
        is_late = min(delays) > 0
        self.count(outcome, is_late)
        late = (f"delay={min(delays) * 1e-9:.6f}",) if is_late else ()
        word = DELAYED if is_late else DELIVERED
        return Fate(word, tuple(now_ns + delay for delay in delays), self.note(outcome, f"slot={k}", *late))

    def _slot(self, now_ns: int) -> int:
        if self._first_ns is None:
            self._first_ns = now_ns
        return 1 + (now_ns - self._first_ns) // self._ts_ns if self._has_period else 1 + self.sent


class UnderWay(Generic[M]):
    """Messages that arrive later, in the order of their instants; those of one instant as they were sent."""

    def __init__(self) -> None:
        self._waiting: list[tuple[int, int, M]] = []
        self._order = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, arrival_ns: int, message: M) -> None:
        """A message is under way until `arrival_ns`."""
        heapq.heappush(self._waiting, (arrival_ns, self._order, message))
        self._order += 1

    def arrived(self, now_ns: int) -> list[M]:
        """Those that have arrived by now, which are then no longer under way."""
        found = []
        while self._waiting and self._waiting[0][0] <= now_ns:
            found.append(heapq.heappop(self._waiting)[2])
        return found
