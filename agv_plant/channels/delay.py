"""Delays on top of any channel: when does a message arrive that is not lost, and does it arrive twice?

As netem does it: uniform in delay +- jitter, a copy with a delay of its own. Where the jitter exceeds a slot, messages
overtake each other. Times are rounded up to whole slots, since the relay passes on in the slot of arrival.

Source: tc-netem(8), `delay` and `duplicate`.
"""

from __future__ import annotations

import math

NEVER = -1
"""In place of a slot of arrival: there is no copy."""

_ROUNDING = 1e-9
"""Slots by which a delay may exceed whole ones: 0.015 s are more than three slots of 0.005 s to a computer."""


def delay_in_slots(u: float, delay: float, jitter: float, ts: float) -> float:
    """Time under way in slots, uniform in delay +- jitter [s] but not below 0, given `u` uniform in [0, 1)."""
    return max(0.0, (delay + jitter * (2.0 * u - 1.0)) / ts)


def whole_slots(slots: float) -> int:
    """Slots until the receiver has a message that is `slots` under way."""
    return math.ceil(slots - _ROUNDING)


def delays_of(
    k: int, u_delay: float, u_twice: float, u_copy: float, delay: float, jitter: float, duplicate: float, ts: float
) -> tuple[float, float]:
    """Times under way [slots] of the message of slot k and of its copy, NEVER if there is none.

    There is one with probability `duplicate`. The message of slot 0 arrives at once and alone: a run begins with the
    AGV known to the edge.
    """
    if k == 0:
        return 0.0, float(NEVER)
    first = delay_in_slots(u_delay, delay, jitter, ts)
    return first, delay_in_slots(u_copy, delay, jitter, ts) if u_twice < duplicate else float(NEVER)


def soonest(first: float, copy: float) -> int:
    """Whole slots until the receiver has the message or its copy, whichever comes first."""
    return whole_slots(first if copy < 0.0 else min(first, copy))
