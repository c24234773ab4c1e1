"""Age of information as a Markov chain where messages are lost and late: which pose a step is answered from.

At each step the freshest message that arrives may be i slots old; it replaces the held one if it is fresher. With
independent losses and delays a message that has not arrived by the age of i - 1 slots does so at i with the hazard

    lambda_i = (1 - p) f_i / (1 - (1 - p) F_(i-1))        f, F: distribution of the slots under way

whatever became of the others, so the age n alone is a Markov chain: from n it becomes i <= n with probability
lambda_i (1 - lambda_(i-1)) ... (1 - lambda_0), else n + 1. Behind a constant delay losses may be any finite chain.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.markov_channel import Chain, chain_of
from agv_analysis.run import Floats
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.delay import whole_slots

_ROUNDING = 1e-9


class AgeChain(NamedTuple):
    """What arrives at a step, by the state of a Markov chain."""

    moves: Floats
    """Probability of each arrival and the state after it, shape (s, D + 2, s): one 0 .. D slots old, none.

    A step is answered from the message that arrives at it, or from the one before.
    """

    @property
    def oldest(self) -> int:
        """D, age of the oldest message that may arrive [slots]."""
        return int(self.moves.shape[1]) - 2

    @property
    def is_constant(self) -> bool:
        """Is each step answered from a message of the same age?"""
        return bool(np.all(self.moves[:, -2].sum(axis=1) == 1.0))


def slots_under_way(channel: ChannelParameters, ts: float) -> Floats:
    """P(a message that is not lost, or its copy, has arrived after i slots), i = 0, 1, ...; what expires never does."""
    most = whole_slots((channel.delay + channel.jitter) / ts)
    slots = np.arange(most + 1) + _ROUNDING
    if channel.jitter > 0.0:
        arrived = np.clip((slots * ts - channel.delay + channel.jitter) / (2.0 * channel.jitter), 0.0, 1.0)
    else:
        arrived = (slots * ts >= channel.delay).astype(np.float64)
    arrived[-1] = 1.0
    in_time = math.floor(min(channel.lifetime / ts, float(most)) + _ROUNDING)
    arrived[in_time + 1 :] = arrived[in_time]
    return np.asarray(arrived * (1.0 + channel.duplicate * (1.0 - arrived)))


def late(arrived: Floats, p: float) -> AgeChain:
    """Independent losses p and delays, `arrived` as of `slots_under_way`. A state is the age before, up to D."""
    heard = (1.0 - p) * np.insert(arrived, 0, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        hazard = np.nan_to_num(np.diff(heard) / (1.0 - heard[:-1]))
    D = len(hazard) - 1
    moves = np.zeros((D + 1, D + 2, D + 1))
    for n in range(D + 1):
        none = 1.0
        for i in range(n + 1):
            moves[n, i, i] = none * hazard[i]
            none *= 1.0 - hazard[i]
        moves[n, D + 1, min(n + 1, D)] = none
    return AgeChain(moves)


def behind_constant_delay(chain: Chain, slots: int) -> AgeChain:
    """Losses of any finite chain, and what is not lost always as many slots under way."""
    moves = np.zeros((len(chain.delivery), slots + 2, len(chain.delivery)))
    moves[:, slots] = chain.delivery[:, None] * chain.transition
    moves[:, slots + 1] = (1.0 - chain.delivery)[:, None] * chain.transition
    return AgeChain(moves)


def age_chain_of(channel: ChannelParameters, ts: float) -> AgeChain | None:
    """The chain of a link that may be late; None if it has none: random delays and losses with a memory, a schedule."""
    chain = chain_of(channel)
    if chain is None:
        return None
    arrived = slots_under_way(channel, ts)
    is_constant = channel.jitter == 0.0 and arrived[-1] == 1.0
    if is_constant:
        return behind_constant_delay(chain, len(arrived) - 1)
    return late(arrived, 1.0 - float(chain.delivery[0])) if len(chain.delivery) == 1 else None


def fitted_ages(n: NDArray[np.int64]) -> AgeChain:
    """The chain of recorded ages n_ul [slots], shape (N,): shares of what arrived after each age. A state is that age.

    Ages beyond the oldest message that arrived are one state, so outages of a Gilbert channel behind a constant delay
    are what they are. A state that nothing follows is taken to go on growing.
    """
    before, after = n[:-1], n[1:]
    arrives = after <= before
    D = int(after[arrives].max(initial=0))
    moves = np.zeros((D + 2, D + 2, D + 2))
    np.add.at(
        moves, (np.minimum(before, D + 1), np.where(arrives, after, D + 1), np.minimum(after, D + 1)), 1.0
    )  # fmt: skip
    total = moves.sum(axis=(1, 2))
    for s in np.flatnonzero(total == 0.0):
        moves[s, D + 1, min(s + 1, D + 1)] = total[s] = 1.0
    used = np.zeros(D + 2, dtype=bool)
    used[int(np.argmax(total))] = True  # what follows the usual ones: those of the beginning may never come again
    for _ in used:
        used |= (moves[used] > 0.0).any(axis=(0, 1))
    return AgeChain((moves / total[:, None, None])[np.ix_(used, np.ones(D + 2, dtype=bool), used)])
