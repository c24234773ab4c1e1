"""A lossy channel as a finite Markov chain, and what follows from it in closed form.

In state i the message of a slot is delivered with probability g_i; afterwards the state changes by the row T_i. With
D = diag(1 - g) and the stationary distribution pi:

    loss rate                pi D 1
    mean age of information  E[n_ul] = pi D (I - T D)^-1 1   (the sum over j of P(the last j lost))
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats
from agv_plant.parameters import ChannelParameters, RelayParameters

MOST_STATES = 1000
"""A channel with more is judged by what a run of it shows: matrices over all states would not fit into memory."""


@dataclass(frozen=True)
class Chain:
    """A finite Markov chain of a channel's states."""

    transition: Floats
    """T, probability of state j after state i, shape (m, m); rows sum to 1."""
    delivery: Floats
    """g, probability of delivery in each state, shape (m,)."""

    @functools.cached_property
    def stationary(self) -> Floats:
        """pi, share of slots in each state, shape (m,)."""
        size = len(self.delivery)
        if cycle_of(self.transition) is not None:
            return np.full(size, 1.0 / size)
        equations = np.vstack((self.transition.T - np.eye(size), np.ones(size)))
        return np.asarray(np.linalg.lstsq(equations, np.append(np.zeros(size), 1.0), rcond=None)[0])

    @property
    def loss_rate(self) -> float:
        """Share of slots that are lost."""
        return min(1.0, max(0.0, float(self.stationary @ (1.0 - self.delivery))))  # rounding may leave [0, 1]

    @property
    def mean_burst(self) -> float:
        """Mean number of consecutive losses, 0 where nothing is lost."""
        lost = 1.0 - self.delivery
        begins = float((self.stationary * self.delivery) @ self.transition @ lost)
        return self.loss_rate / begins if begins > 0.0 else 0.0

    @property
    def mean_age(self) -> float:
        """E[n_ul]: mean number of steps since the freshest pose that the edge holds; inf if none ever arrives."""
        D = np.diag(1.0 - self.delivery)
        system = np.eye(len(D)) - self.transition @ D
        if np.linalg.cond(system) > 1e14:
            return float("inf")
        return float(self.stationary @ D @ np.linalg.solve(system, np.ones(len(D))))

    def burst_lengths(self, tail: float = 1e-17, longest: int = 1_000_000) -> Floats:
        """P(L = l), l = 1, 2, ...: probability that a reception is followed by the next one l steps later.

        Cut off where less than `tail` is left, at `longest` at the latest.
        """
        if len(self.delivery) == 1:
            return _geometric(float(self.delivery[0]), tail, longest)
        state = self.stationary * self.delivery
        found: list[float] = []
        state, left = state / state.sum(), 1.0
        while left > tail and len(found) < longest:
            state = state @ self.transition
            found.append(float(state @ self.delivery))
            state = state * (1.0 - self.delivery)
            left = float(state.sum())  # not 1 less what was found: its rounding alone would exceed the tail
        return np.array(found)


def _geometric(delivery: float, tail: float, longest: int) -> Floats:
    if delivery >= 1.0:
        return np.ones(1)
    last = longest if delivery <= 0.0 else math.ceil(math.log(tail) / math.log1p(-delivery))
    return np.asarray(delivery * (1.0 - delivery) ** np.arange(min(longest, max(1, last))))


def bernoulli(p: float) -> Chain:
    """Independent losses with probability `p`."""
    return Chain(np.ones((1, 1)), np.array([1.0 - p]))


def gilbert_elliott(p: float, r: float, h: float = 0.0, k: float = 1.0) -> Chain:
    """The channel of `agv_plant.channels.gilbert_elliott`: states good and bad, with netem's parameters."""
    return Chain(np.array([[1.0 - p, p], [r, 1.0 - r]]), np.array([k, h]))


def bursty(loss_rate: float, mean_burst: float) -> Chain:
    """The Gilbert channel (h = 0, k = 1) with a loss rate below 1, a mean burst of at least `shortest_mean_burst`."""
    r = 1.0 / mean_burst
    return gilbert_elliott(min(1.0, r * loss_rate / (1.0 - loss_rate)), r)


def shortest_mean_burst(loss_rate: float) -> float:
    """Smallest mean burst that a channel of this loss rate can have: receptions, too, last one slot at least."""
    return max(1.0, loss_rate / (1.0 - loss_rate))


def chain_of(channel: ChannelParameters) -> Chain | None:
    """The chain of a channel's parameters; None for a model that is not a Markov chain of at most `MOST_STATES` states.

    A single outage (burst with a start_step) is over some day: to the long run the channel is perfect. What a schedule
    changes is not a chain, nor what is sent again.
    """
    if channel.schedule or channel.reliable:
        return None
    if channel.model == "perfect" or (channel.model == "burst" and channel.start_step >= 0):
        return bernoulli(0.0)
    if channel.model == "bernoulli":
        return bernoulli(channel.p)
    if channel.model == "gilbert_elliott":
        return gilbert_elliott(channel.p, channel.r, channel.h, channel.k)
    if channel.model == "burst" and channel.n < MOST_STATES:
        return Chain(np.roll(np.eye(channel.n + 1), 1, axis=1), np.eye(channel.n + 1)[0])
    return None


def why_no_chain(channel: ChannelParameters) -> str:
    """What keeps a channel from being a chain, as the end of a sentence about it."""
    if channel.schedule:
        return "is changed by its schedule"
    if channel.reliable:
        return "is reliable, so that its losses are late bursts"
    return f"has more than {MOST_STATES} states" if channel.model == "burst" else "is not a finite Markov chain"


def cycle_of(transition: Floats) -> NDArray[np.int64] | None:
    """The states of a chain in the order in which it goes through them all, forever; None if it does anything else."""
    after = transition.argmax(axis=1)
    if not np.array_equal(transition, np.eye(len(after))[after]):
        return None
    states = [0]
    while after[states[-1]] != 0 and len(states) < len(after):
        states.append(int(after[states[-1]]))
    return np.array(states) if len(states) == len(after) and after[states[-1]] == 0 else None


def renewal_chain(relay: RelayParameters) -> Chain | None:
    """The uplink as a chain whose outages have independent lengths.

    None if it is none, if its messages come late, or if the downlink does anything to its own.
    """
    uplink, downlink = relay.uplink, relay.downlink
    is_late = any(link.delay > 0.0 or link.jitter > 0.0 for link in (uplink, downlink))
    if is_late or downlink.model != "perfect" or downlink.schedule:
        return None
    if uplink.model == "gilbert_elliott" and (uplink.h, uplink.k) != (0.0, 1.0):
        return None
    return chain_of(uplink)
