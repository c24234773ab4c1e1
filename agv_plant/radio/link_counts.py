"""What a link counts of its messages, whatever they are."""

from __future__ import annotations

import math

from agv_plant.channels.model import GOOD
from agv_plant.radio.channel import SlotOutcome
from agv_plant.radio.delay import EXPIRED


class LinkCounts:
    """Counts of one direction of the radio."""

    def __init__(self) -> None:
        self.sent = 0
        self.lost = 0
        self.longest = 0
        """Most messages lost in a row."""
        self.delayed = 0
        """Messages that came, or will come, later than at once."""
        self.copies = 0
        """Messages that came, or will come, a second time."""
        self.expired = 0
        """Messages of those lost that would have come too old."""
        self._run = 0

    def count(self, outcome: SlotOutcome, is_late: bool) -> None:
        """Count the message of a slot."""
        self.sent += 1
        self.lost += outcome.lost
        self.expired += outcome.cause == EXPIRED
        self.delayed += is_late
        self._run = self._run + 1 if outcome.lost else 0
        if self._run > self.longest:
            self.longest = self._run

    def note(self, outcome: SlotOutcome, *more: str) -> str:
        """Why a message that has just been counted was lost, and more about it: words `name=value`."""
        if not (outcome.lost or more) and outcome.state == GOOD and math.isnan(outcome.gain):
            return ""  # most of them, and the loop waits for each
        facts = [f"cause={outcome.cause}", f"run={self._run}"] if outcome.lost else []
        facts += more
        facts += [f"state={outcome.state}"] if outcome.state != GOOD else []
        facts += [] if math.isnan(outcome.gain) else [f"gain={outcome.gain:.2f}"]
        return " ".join(facts)

    def facts(self, name: str) -> dict[str, str]:
        """The counts as a node reports them, of the link called `name`."""
        rate = self.lost / self.sent if self.sent else 0.0
        return {
            f"{name} sent": str(self.sent),
            f"{name} lost": str(self.lost),
            f"{name} loss rate": f"{rate:.6f}",
            f"{name} longest outage [slots]": str(self.longest),
            f"{name} delayed": str(self.delayed),
            f"{name} duplicated": str(self.copies),
            f"{name} expired": str(self.expired),
        }
