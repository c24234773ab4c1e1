"""Both links as one Markov chain with four outcomes a step; so they may fail together.

Three ways to it: links that are independent of each other; those of the relay, of which the downlink draws the uplink's
random numbers in a share of the slots; and a chain fitted to recorded outcomes of both.

A run begins with both channels in their first state. States that they cannot come to from there are left out: two
periodic channels stay in step forever, and so do two equal ones that always share their numbers.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.channel_fit import SIGNIFICANCE
from agv_analysis.link.markov_channel import Chain
from agv_analysis.run import Floats

OUTCOMES = ((True, True), (True, False), (False, True), (False, False))
"""(is the pose delivered, is the command delivered)."""


class JointChain(NamedTuple):
    """Both links as one Markov chain with four outcomes a step; so links may fail together."""

    transition: Floats
    """T, probability of state t after state s, shape (s, s)."""
    outcomes: Floats
    """P(o | s): pose and command delivered, pose alone, command alone, neither; shape (s, 4)."""


def independent(uplink: Chain, downlink: Chain) -> JointChain:
    """Links that lose independently of each other."""
    return _reached(_apart(uplink, downlink), [0])


def _apart(uplink: Chain, downlink: Chain) -> JointChain:
    u, d = (grid.ravel() for grid in np.meshgrid(uplink.delivery, downlink.delivery, indexing="ij"))
    outcomes = [(u if pose else 1.0 - u) * (d if command else 1.0 - d) for pose, command in OUTCOMES]
    return JointChain(np.asarray(np.kron(uplink.transition, downlink.transition)), np.stack(outcomes, axis=1))


def _reached(links: JointChain, first: list[int]) -> JointChain:
    """The states that can be reached from those of the first slot."""
    reached = np.zeros(len(links.transition), dtype=bool)
    reached[first] = True
    for _ in range(len(reached)):
        reached |= (links.transition[reached] > 0.0).any(axis=0)
    states = np.flatnonzero(reached)
    return JointChain(links.transition[np.ix_(states, states)], links.outcomes[states])


def correlated(uplink: Chain, downlink: Chain, share: float) -> JointChain:
    """Links of which the downlink draws the uplink's random numbers in a `share` of the slots, as the relay's do.

    A message is lost if a number in [0, 1) is below p on a channel without memory, and delivered if it is below g on
    another; a channel leaves its state if another number is below the probability of that. A state is one of both
    channels and whether their numbers are the same in this slot. For channels of at most two states, and for those
    whose transitions are certain.
    """
    apart = _apart(uplink, downlink)
    if share == 0.0:
        return _reached(apart, [0])
    pairs = list(itertools.product(range(len(uplink.delivery)), range(len(downlink.delivery))))
    outcomes = [_outcomes_of_one_number(uplink, i, downlink, j) for i, j in pairs]
    moves = []
    for i, j in pairs:
        to_up, to_down = _leaving_first(uplink, i), _leaving_first(downlink, j)
        move = np.zeros((len(uplink.delivery), len(downlink.delivery)))
        move[np.ix_(to_up, to_down)] = _alike(uplink.transition[i, to_up], downlink.transition[j, to_down])
        moves.append(move.ravel())
    moved = np.concatenate((apart.transition, np.array(moves)))
    transition = np.hstack(((1.0 - share) * moved, share * moved))
    first = [len(pairs)] if share == 1.0 else [0, len(pairs)]
    return _reached(JointChain(transition, np.concatenate((apart.outcomes, outcomes))), first)


def _outcomes_of_one_number(uplink: Chain, i: int, downlink: Chain, j: int) -> Floats:
    """P of the four OUTCOMES in these states where one number decides both, shape (4,)."""
    lost_first = len(uplink.delivery) == 1, len(downlink.delivery) == 1
    parts = []
    for g, is_lost_first in zip((uplink.delivery[i], downlink.delivery[j]), lost_first, strict=True):
        parts.append(np.array([1.0 - g, g] if is_lost_first else [g, 1.0 - g]))
    both = _alike(*parts)
    both = both[::-1] if lost_first[0] else both
    return (both[:, ::-1] if lost_first[1] else both).ravel()


def fitted(pose_lost: NDArray[np.bool_], command_lost: NDArray[np.bool_]) -> JointChain | None:
    """The chain of both links fitted to recorded outcomes, shape (N,); None where nothing says that they depend.

    A state is an outcome of the slot; shares of transitions are their maximum-likelihood estimates. Against it stand
    two chains apart, by the ratio of likelihoods: chi-square of 8 degrees of freedom (Anderson and Goodman, Ann. Math.
    Stat. 28, 1957).
    """
    seen = 2 * pose_lost.astype(np.int64) + command_lost
    counts = np.bincount(4 * seen[:-1] + seen[1:], minlength=16).reshape(4, 4)
    apart = counts.reshape(2, 2, 2, 2)  # pose, command before; pose, command after
    of_pose, of_command = apart.sum(axis=(1, 3)), apart.sum(axis=(0, 2))
    ratio = 2.0 * (_log_likelihood(counts) - _log_likelihood(of_pose) - _log_likelihood(of_command))
    half = 0.5 * max(0.0, ratio)
    p_value = math.exp(-half) * sum(half**i / math.factorial(i) for i in range(4)) if half < 700.0 else 0.0
    if p_value >= SIGNIFICANCE:
        return None
    rows = counts.sum(axis=1)
    # Of an outcome that only the last slot has nothing follows: as good a guess as any is that nothing is lost next.
    transition = np.where(rows[:, None] > 0, counts / np.maximum(1, rows)[:, None], np.eye(4)[0])
    return _reached(JointChain(transition, np.eye(4)), [int(seen[0])])


def _leaving_first(chain: Chain, state: int) -> list[int]:
    """The states after `state`, itself as the last."""
    return [other for other in range(len(chain.delivery)) if other != state] + [state]


def _alike(first: Floats, second: Floats) -> Floats:
    """P(a, b) of two events decided by the same number in [0, 1): that falls into part a of one, part b of the other.

    Lengths of the parts, shapes (m,) and (n,), in order; shape (m, n).
    """
    ends, others = np.cumsum(first), np.cumsum(second)
    below = np.minimum(ends[:, None], others)  # P(part a or one before, part b or one before)
    return np.asarray(np.diff(np.diff(below, axis=0, prepend=0.0), axis=1, prepend=0.0))


def _log_likelihood(counts: NDArray[np.int64]) -> float:
    """Largest log likelihood of transitions, counted in a square matrix; 0 log 0 = 0."""
    seen = counts > 0
    shares = counts / np.maximum(1, counts.sum(axis=1, keepdims=True))
    return float((counts[seen] * np.log(shares[seen])).sum())
