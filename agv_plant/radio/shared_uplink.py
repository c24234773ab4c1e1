"""One uplink for a whole fleet: a few resource blocks a slot, and a scheduler that chooses which poses are sent.

In every slot each of N vehicles has a new pose to send, and `blocks` of them may. A pose that is not sent is lost, for
the next one is newer; one that is sent is lost with probability p, independently. The schedulers:

    round_robin   the vehicles in turn: with N/R whole, a pose every N/R slots
    oldest_first  those whose pose at the edge is the oldest, the first of equals; without losses that is in turn
    random        any R of them, each set as likely as another: R/N of the slots

The oldest-pose-first rule minimises the mean age over all policies if losses are alike (Kadota et al., Scheduling
policies for minimizing age of information in broadcast wireless networks, IEEE/ACM Trans. Netw. 26(6), 2018). All
vehicles' relays work out the same schedule from the same seed, so none has to tell another.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64] | Sequence[float]
Ages = NDArray[np.int64] | list[int]
Flags = NDArray[np.bool_] | list[bool]

ROUND_ROBIN, OLDEST_FIRST, RANDOM = range(3)

SCHEDULERS = ("round_robin", "oldest_first", "random")
"""By name, each at the place of its number."""

_FIRST = -1.0
"""Comes before every number that a turn can be."""


def stream_of(link: str, vehicle: int) -> str:
    """Name of the stream of a vehicle's random numbers: the first for its turn, the second for its loss."""
    return f"{link}/vehicle {vehicle}"


def serve(
    k: int, blocks: int, scheduler: int, p: float, u_turn: Numbers, u_loss: Numbers, ages: Ages, lost: Flags
) -> None:
    """Slot k: whose pose is lost, into `lost`, and how old each is now at the edge, in `ages`; all of shape (N,).

    `u_turn` and `u_loss` are each vehicle's numbers of this slot, uniform in [0, 1).
    """
    vehicles = len(ages)
    for i in range(vehicles):
        lost[i] = True
    for turn in range(min(blocks, vehicles)):
        chosen = (k * blocks + turn) % vehicles
        if scheduler != ROUND_ROBIN:
            best = _FIRST
            for i in range(vehicles):
                wish = float(ages[i]) if scheduler == OLDEST_FIRST else u_turn[i]
                if lost[i] and wish > best:
                    chosen, best = i, wish
        lost[chosen] = False
    for i in range(vehicles):
        if not lost[i] and u_loss[i] < p:
            lost[i] = True
        ages[i] = ages[i] + 1 if lost[i] else 0


def serve_all(
    first: int, blocks: int, scheduler: int, p: float, u_turn: NDArray[np.float64], u_loss: NDArray[np.float64],
    ages: NDArray[np.int64], lost: NDArray[np.bool_],
) -> None:  # fmt: skip
    """The slots first, first + 1, ... one after the other: `u_turn`, `u_loss` and `lost` of shape (slots, N)."""
    for j in range(len(lost)):
        serve(first + j, blocks, scheduler, p, u_turn[j], u_loss[j], ages, lost[j])
