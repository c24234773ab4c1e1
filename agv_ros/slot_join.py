"""Pairing a slot's verdict with the message that it speaks of.

Theory of operation. The relay sends two messages for a slot: the forwarded one, if it was delivered, and the verdict,
always. They travel on two topics, so either may come first. The verdict names the stamp of the freshest message that
the receiver holds behind the channel; the receiver acts on the verdict once it holds exactly that message. Thus what a
node computes depends on stamps alone, never on the order of arrival. The error detector joins poses with uplink slots,
the plant in lockstep commands with downlink slots: this join is the barrier that makes the loop deterministic.

No clock, no thread, no ROS in here: messages go in, pairs that are complete come out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from agv_ros.wire import Slot


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


class SlotJoin(Generic[M]):
    """Holds messages and slots until they fit together.

    `outdated` counts slots and messages that came too late to matter, `unanswered` slots whose message never came.
    """

    def __init__(self, start_ns: int) -> None:
        self._start_ns = start_ns
        self._arrived: dict[int, M | None] = {}
        self._waiting: list[Slot] = []
        self._held: M | None = None
        self._settled_ns = 0
        self._last_slot_ns = 0
        self.outdated = 0
        self.unanswered = 0

    def add_message(self, message: M) -> list[Joined[M]]:
        """Take a message; returns the slots that were waiting for it, oldest first."""
        if message.stamp_ns < self._settled_ns and message.stamp_ns != self._start_ns:
            self.outdated += 1
            return []
        self._arrived[message.stamp_ns] = message
        return self._complete()

    def reject(self, stamp_ns: int) -> list[Joined[M]]:
        """The message with this stamp came but cannot be used: its slot goes on with the message held before."""
        self._arrived.setdefault(stamp_ns, None)
        return self._complete()

    def add_slot(self, slot: Slot) -> list[Joined[M]]:
        """Take a slot; returns it, and any before it, once the message that it names is here."""
        if slot.stamp_ns == self._start_ns:
            self._restart()
        elif slot.stamp_ns < self._last_slot_ns:
            self.outdated += 1
            return []
        self._waiting.append(slot)
        return self._complete()

    def _restart(self) -> None:
        """Step 0 begins a run: nothing of a run before it is held."""
        self._held, self._settled_ns, self._last_slot_ns = None, 0, 0
        self._waiting.clear()
        self._arrived = {ns: message for ns, message in self._arrived.items() if ns == self._start_ns}

    def _complete(self) -> list[Joined[M]]:
        done: list[Joined[M]] = []
        while True:
            ready = [i for i, slot in enumerate(self._waiting) if self._is_here(slot.freshest_ns)]
            if not ready:
                return done
            self.unanswered += ready[0]
            done.append(self._settle(self._waiting[ready[0]]))
            del self._waiting[: ready[0] + 1]

    def _is_here(self, stamp_ns: int) -> bool:
        return stamp_ns == self._settled_ns or stamp_ns in self._arrived

    def _settle(self, slot: Slot) -> Joined[M]:
        message = self._arrived.pop(slot.freshest_ns, None)
        if message is not None:
            self._held = message
        self._settled_ns = slot.freshest_ns
        self._arrived = {ns: later for ns, later in self._arrived.items() if ns > slot.freshest_ns}
        self._last_slot_ns = slot.stamp_ns
        return Joined(slot, self._held)
