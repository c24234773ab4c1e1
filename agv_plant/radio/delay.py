"""Delays on top of any channel: when does a message arrive that is not lost, and does it arrive twice?

As netem does it: uniform in delay +- jitter, a copy with a delay of its own. Where the jitter exceeds a slot, messages
overtake each other. Times are rounded up to whole slots, since the relay passes on in the slot of arrival.

Source: tc-netem(8), `delay` and `duplicate`.
"""

from __future__ import annotations

import math

NEVER = -1
"""In place of a time under way: there is no copy, or it expires before it comes."""

EXPIRED = "expired"
"""Cause of a loss: the message would have come, but older than its lifetime."""

_ROUNDING = 1e-9
"""Slots by which a delay may exceed whole ones: 0.015 s are more than three slots of 0.005 s in floating point."""


def delay_in_slots(u: float, delay: float, jitter: float, ts: float) -> float:
    """Time under way in slots, uniform in delay +- jitter [s] but not below 0, given `u` uniform in [0, 1)."""
    return max(0.0, (delay + jitter * (2.0 * u - 1.0)) / ts)


def whole_slots(slots: float) -> int:
    """Slots until the receiver has a message that is `slots` under way."""
    return math.ceil(slots - _ROUNDING)


def delays_of(
    k: int, u_delay: float, u_twice: float, u_copy: float, delay: float, jitter: float, duplicate: float,
    lifetime: float, ts: float,
) -> tuple[float, float]:  # fmt: skip
    """Times under way [slots] of the message of slot k and of its copy, NEVER if there is none.

    There is one with probability `duplicate`. What would be older than `lifetime` [s] in its slot of arrival never
    comes. The message of slot 0 arrives at once and alone: a run begins with the AGV known to the edge.
    """
    if k == 0:
        return 0.0, float(NEVER)
    first = in_time(delay_in_slots(u_delay, delay, jitter, ts), lifetime, ts)
    if u_twice >= duplicate:
        return first, float(NEVER)
    return first, in_time(delay_in_slots(u_copy, delay, jitter, ts), lifetime, ts)


def in_time(slots: float, lifetime: float, ts: float) -> float:
    """`slots` under way, or NEVER if that is longer than a lifetime [s]."""
    return slots if whole_slots(slots) <= lifetime / ts + _ROUNDING else float(NEVER)


def soonest(first: float, copy: float) -> int:
    """Whole slots until the receiver has the message or its copy, whichever comes first; NEVER if neither does."""
    if first < 0.0 or copy < 0.0:
        return whole_slots(max(first, copy))
    return whole_slots(min(first, copy))
