"""Pairing a slot's outcome with the message that it refers to.

Theory of operation. The relay sends two messages for a slot: the forwarded one, if it was delivered, and the outcome,
always. They travel on two topics, so either may come first. The outcome names the stamp of the freshest message that
the receiver holds behind the channel; the receiver acts on the outcome once it holds exactly that message. Thus what a
node computes depends on stamps alone, never on the order of arrival. The error detector joins poses with uplink slots,
the plant in lockstep commands with downlink slots: this join is the barrier that makes the loop deterministic.

Each topic keeps its order, so step 0 parts one run from the next on either side: its message from the messages before
it, its slot from the slots before it, whichever of the two comes first. A recording that is played again from the
middle of a run has no step 0: there slots in a row that are long past begin a run. A relay that was started again in
between does not know what it has passed on before, and names no message: then what the receiver holds is the freshest.

No clock, no thread, no ROS in here: messages go in, pairs that are complete come out.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from agv_ros.messages import Slot
from agv_ros.stamps import BACK_NS, Backwards


class Stamped(Protocol):
    """A message that carries its instant."""

    @property
    def stamp_ns(self) -> int:
        """Stamp [ns]."""
        ...


M = TypeVar("M", bound=Stamped)


@dataclass(frozen=True)  # not a NamedTuple: Python 3.10 has no generic ones
class Joined(Generic[M]):
    """A slot with the freshest message held at it; None if there has been none that could be used."""

    slot: Slot
    message: M | None


MOST_WAITING = 20_000
"""Messages and slots that wait for each other at most: as many as a subscription may have unread.

An executor that has fallen behind takes all that one subscription has unread before it comes to the next one.
"""


class MessageSync(Generic[M]):
    """Holds messages and slots until they fit together.

    `outdated` counts slots and messages that came too late to matter, or a second time, and were put aside;
    `unanswered` counts slots whose message never came, `beginnings` the runs that began with one.
    """

    def __init__(self, start_ns: int) -> None:
        self._start_ns = start_ns
        self._arrived: OrderedDict[int, M | None] = OrderedDict()  # by stamp, the oldest first
        self._waiting: deque[Slot] = deque()
        self._named: Counter[int] = Counter()  # by how many of the waiting slots each stamp is named
        self._held: M | None = None
        self._settled_ns = 0
        self._last_slot_ns = 0
        self._is_ahead = False  # the messages have begun a run whose slot 0 has not come yet
        self._back = Backwards(BACK_NS)
        self.beginnings = 0
        self.outdated = 0
        self.unanswered = 0

    def add_message(self, message: M) -> list[Joined[M]]:
        """Take a message; returns the slots that were waiting for it, oldest first."""
        if message.stamp_ns == self._start_ns:
            self._arrived.clear()
            self._is_ahead = all(slot.stamp_ns != self._start_ns for slot in self._waiting)
        elif not self._is_ahead and self._is_known(message.stamp_ns):
            self.outdated += 1
            return []
        self._keep(message.stamp_ns, message)
        return self._complete(message.stamp_ns)

    def _keep(self, stamp_ns: int, message: M | None) -> None:
        is_last = not self._arrived or stamp_ns > next(reversed(self._arrived))
        self._arrived[stamp_ns] = message
        if not is_last:
            self._arrived = OrderedDict(sorted(self._arrived.items()))

    def _is_known(self, stamp_ns: int) -> bool:
        """Has this message been here, or a fresher one been used?"""
        return stamp_ns <= self._settled_ns or self._arrived.get(stamp_ns) is not None

    def reject(self, stamp_ns: int) -> list[Joined[M]]:
        """The message with this stamp came but cannot be used: its slot goes on with the message held before."""
        if stamp_ns not in self._arrived:
            self._keep(stamp_ns, None)
        return self._complete(stamp_ns)

    def add_slot(self, slot: Slot) -> list[Joined[M]]:
        """Take a slot; returns it, and any before it, once the message that it names is here."""
        has_gone_back = self._back.has_gone_back(slot.stamp_ns)
        if slot.stamp_ns == self._start_ns or has_gone_back:
            self.beginnings += 1
            self._restart()
        elif slot.stamp_ns < self._last_slot_ns:
            self.outdated += 1
            return []
        elif slot.freshest_ns == 0 and self._held is not None:
            slot = slot._replace(freshest_ns=self._waiting[-1].freshest_ns if self._waiting else self._settled_ns)
        self._waiting.append(slot)
        self._named[slot.freshest_ns] += 1
        return self._complete(slot.freshest_ns)

    def _restart(self) -> None:
        """Step 0 begins a run: nothing of a run before it is held."""
        if (self._last_slot_ns or self._waiting) and not self._is_ahead:
            self._arrived = OrderedDict((ns, one) for ns, one in self._arrived.items() if ns == self._start_ns)
        self._held, self._settled_ns, self._last_slot_ns, self._is_ahead = None, 0, 0, False
        self._waiting.clear()
        self._named.clear()

    def _complete(self, stamp_ns: int) -> list[Joined[M]]:
        """The slots that can go on, now that the message with this stamp is here or a slot names it: no others can."""
        done: list[Joined[M]] = []
        while self._named[stamp_ns] and (stamp_ns == self._settled_ns or stamp_ns in self._arrived):
            while (slot := self._next_slot()).freshest_ns != stamp_ns:
                self.unanswered += 1
            done.append(self._settle(slot))
        self._forget_what_waits_in_vain()
        return done

    def _next_slot(self) -> Slot:
        slot = self._waiting.popleft()
        self._named[slot.freshest_ns] -= 1
        if not self._named[slot.freshest_ns]:
            del self._named[slot.freshest_ns]
        return slot

    def _forget_what_waits_in_vain(self) -> None:
        """If one of the two topics is silent, the other must not fill the memory."""
        while len(self._waiting) > MOST_WAITING:
            self._next_slot()
            self.unanswered += 1
        while len(self._arrived) > MOST_WAITING:
            del self._arrived[next(iter(self._arrived))]
            self.outdated += 1

    def _settle(self, slot: Slot) -> Joined[M]:
        message = self._arrived.pop(slot.freshest_ns, None)
        if message is not None:
            self._held = message
        self._settled_ns = slot.freshest_ns
        while self._arrived and (oldest := next(iter(self._arrived))) <= slot.freshest_ns:
            del self._arrived[oldest]
            self.outdated += 1  # overtaken before it was needed
        self._last_slot_ns = slot.stamp_ns
        return Joined(slot, self._held)
