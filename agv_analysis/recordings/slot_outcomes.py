"""Outcomes of a link's slots from its recorded slots: age, what was lost, and why."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from agv_analysis.recordings.messages_on_steps import OnSteps, Steps, stamps_of
from agv_analysis.run import LinkSlots
from agv_ros.messages import DELAYED, DELIVERED, facts_in
from agv_ros.stamps import Grid


def slot_outcomes(slots: OnSteps, k: Steps, grid: Grid) -> tuple[Steps, NDArray[np.bool_], LinkSlots]:
    """Age n(k) in steps of what is held behind a channel, whether slot k was lost, and why; shapes (N,).

    A relay that was started again names no message before it has passed one on; what was held before still is. Where
    nothing has been received yet, the age is the number of steps since step 0.
    """
    index, there = slots.at(k)
    held_ns = np.where(there, stamps_of(slots.messages, "time_ref")[index], 0)
    held_ns = np.where(held_ns > 0, held_ns, np.maximum.accumulate(held_ns))
    age = np.where(held_ns > 0, k - (held_ns - grid.start_ns) // grid.ts_ns, k)
    source = slots.messages["source"][index]
    lost = there & (source != DELIVERED.encode()) & (source != DELAYED.encode())
    return age, lost, reasons(np.where(there, slots.messages["header.frame_id"][index], b""))


def reasons(notes: NDArray[np.bytes_]) -> LinkSlots:
    """What the notes of slots say, shape (N,). Those of older recordings are empty."""
    distinct, of = np.unique(notes, return_inverse=True)
    facts = [facts_in(note.decode("utf-8", "replace")) for note in distinct.tolist()]
    return LinkSlots(
        cause=np.array([fact.get("cause", "") for fact in facts], dtype=np.str_)[of],
        state=np.array([_number(fact, "state", 0.0) for fact in facts], dtype=np.int64)[of],
        gain=np.array([_number(fact, "gain", math.nan) for fact in facts])[of],
        delay=np.array([_number(fact, "delay", 0.0) for fact in facts], dtype=np.int64)[of],
    )


def _number(fact: Mapping[str, str], name: str, absent: float) -> float:
    """A number of a note; `absent` if it is not there, or none."""
    try:
        return float(fact.get(name, absent))
    except ValueError:
        return absent
