"""Availability of a link for a loop that survives outages of n slots, in closed form from the link's Markov chain.

The service is unavailable in a slot if the freshest message is more than n slots old: the last n + 1 were lost. With
the chain (T, g), D = diag(1 - g), G = diag(g) and the stationary distribution pi

    unavailability                 U = pi D (T D)^n 1
    failures that begin, per slot  f = pi G T D (T D)^n 1
    mean time between failures     T_s (1 - U) / f          the time that the service is up, for each failure

Independent losses p: U = p^(n+1), and T_s (1 - p^(n+1)) / ((1 - p) p^(n+1)). Source of the terms: 3GPP TS 22.104 and
TS 22.261; reliability there is the mean time between failures.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from agv_analysis.link.markov_channel import Chain


class Availability(NamedTuple):
    """How often a link fails a loop."""

    unavailability: float
    """Share of the time; 1 less the availability."""
    failures: float
    """That begin, per slot."""
    mtbf: float
    """Mean time between failures [s]; inf without any."""

    @property
    def availability(self) -> float:
        """Share of the time in which the service is available."""
        return 1.0 - self.unavailability


def availability_of(chain: Chain, n: int, ts: float) -> Availability:
    """Of a link that is this chain, for a loop that survives outages of up to `n` >= 0 slots of `ts` [s]."""
    lost = 1.0 - chain.delivery
    pi = chain.stationary
    outage = _beyond(pi * lost, chain, n)
    begins = _beyond((pi * chain.delivery) @ chain.transition * lost, chain, n)
    unavailability = min(1.0, max(0.0, outage))
    mtbf = math.inf if begins <= 0.0 else ts * (1.0 - unavailability) / begins
    if chain.loss_rate >= 1.0:
        mtbf = 0.0
    return Availability(unavailability, max(0.0, begins), mtbf)


def _beyond(state: np.ndarray[tuple[int], np.dtype[np.float64]], chain: Chain, n: int) -> float:
    """The part of a distribution over states, in slots that are lost, that goes on to lose the next n as well."""
    step = chain.transition * (1.0 - chain.delivery)
    return float(state @ np.linalg.matrix_power(step, n) @ np.ones(len(step)))


def packets_for(availability: float, confidence: float = 0.95) -> int:
    """Packets without a single failure that prove an availability with this confidence: (1 - U)^N <= 1 - confidence.

    For failures that are independent of each other; where they come in bursts it takes more.
    """
    return math.ceil(math.log(1.0 - confidence) / math.log1p(-(1.0 - availability)))
