"""How often a rare event happens, by importance splitting.

A process that runs on forever, slot by slot, under a channel that is a Markov chain, comes near to an event and goes
back. How near is a number, its importance: an age, say, or a distance. The event is that it reaches the last of some
levels. With `home` for the states from which it has come back (the importance below the first level, a fresh message):

    rate of the event = rate at which the first level is reached from home
                        x P(second level before home | first reached) x P(third | second) x ...

Each probability is estimated by runs of its own, which begin with the states in which the level before was reached, so
none of them is rare. An event that is reached again without having been home in between counts once.

Source: Allen, Valeriani and ten Wolde, Forward flux sampling for rare event simulations, J. Phys.: Condens. Matter 21,
2009. Everything but `rate_of` runs as plain Python and compiled.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from agv_analysis.link.channel_fit import Estimate
from agv_analysis.link.markov_channel import Chain
from agv_analysis.run import Floats
from agv_analysis.simulation.batch import cores
from agv_analysis.simulation.parts import run_parts
from agv_ros.substitution import Replacements

FEW = 0.02
"""Share of the runs from a level up to which it does not matter that they were ended; with more there is no rate."""

REPLICATES = 16
"""Independent estimates that are put together."""

_STUDENT = 2.131449546
"""Of an estimate from so many with unknown variance: quantile 0.975 of Student's t with 15 degrees."""


class Work(NamedTuple):
    """How much is driven for one estimate."""

    base: int
    """Slots of the run that looks for the first level."""
    trials: int
    """Runs from each level to the next."""
    longest: int
    """Slots after which a run that has neither reached a level nor come home is ended."""


def advance(state: Any, lost: bool, k: int, rng: Any, process: Any) -> tuple[Any, float, bool]:
    """The state after slot k with this outcome, its importance, and whether a fresh message has come.

    A placeholder for that of the process that is asked about, by default an age: see `age_after`.
    """
    return age_after(state, lost)


def age_after(age: int, lost: bool) -> tuple[int, float, bool]:
    """The age of information as a process, in slots: it reaches n at the n-th loss in a row."""
    age = age + 1 if lost else 0
    return age, float(age), age == 0


def next_state(state: int, cumulative: Floats, u: float) -> int:
    """The state of a chain after `state`, from a number uniform in [0, 1); rows of probabilities, summed up."""
    for following in range(cumulative.shape[1] - 1):
        if u < cumulative[state, following]:
            return following
    last: int = cumulative.shape[1] - 1
    return last


def split(
    process: Any, start: Any, cumulative: Floats, delivery: Floats, levels: Floats, work: Work, rng: Any, hits: Floats
) -> int:
    """One estimate: into hits[0] how often the first level was reached from home, into hits[j] level j from the last.

    `start` is a state at home before slot 0, `cumulative` and `delivery` those of the channel's chain. Returns the
    number of runs that were ended without having reached a level or home.
    """
    state, channel, is_home, ended = start, 0, True, 0
    entries = [(start, 0, 0, 0.0)]
    entries.clear()
    for k in range(work.base):
        lost = k > 0 and rng.random() >= delivery[channel]
        channel = next_state(channel, cumulative, rng.random())
        state, importance, is_fresh = advance(state, lost, k, rng, process)
        if is_home and importance >= levels[0]:
            hits[0] += 1.0
            is_home = False
            entries.append((state, k + 1, channel, importance))
        elif is_fresh and importance < levels[0]:
            is_home = True
        if not math.isfinite(importance):  # it will not come back: begin again
            state, is_home = start, True
    for level in range(1, len(levels)):
        if len(entries) == 0:
            return ended
        reached = [entries[0]]
        reached.clear()
        for trial in range(work.trials):
            pick = min(len(entries) - 1, int((trial + rng.random()) * len(entries) / work.trials))
            state, k, channel, importance = entries[pick]
            last = min(k + work.longest, work.base + work.longest)
            is_over = importance >= levels[level]
            if is_over:
                hits[level] += 1.0
                reached.append((state, k, channel, importance))
            while not is_over:
                lost = rng.random() >= delivery[channel]
                channel = next_state(channel, cumulative, rng.random())
                state, importance, is_fresh = advance(state, lost, k, rng, process)
                k += 1
                if importance >= levels[level]:
                    hits[level] += 1.0
                    reached.append((state, k, channel, importance))
                    is_over = True
                elif is_fresh and importance < levels[0]:
                    is_over = True
                elif k >= last:
                    ended += 1
                    is_over = True
            if ended > FEW * work.trials:
                return ended
        entries = reached
    return ended


class Rate(NamedTuple):
    """How often an event happens."""

    per_slot: Estimate
    """Expected number of events in a slot, with its 95 % interval."""
    ended: int
    """Runs that were ended without having reached a level or home; if they are many, the rate is unknown."""
    runs: int
    """All runs."""


def rate_of(
    processes: Sequence[Any], start: Any, chain: Chain, levels: Sequence[float], work: Work, seed: int,
    parts: Replacements | None = None,
) -> Rate:  # fmt: skip
    """The rate at which a process reaches the last of the levels, increasing; `parts` gives its `advance`.

    `processes` are what `advance` is given, one for each of the REPLICATES, which run side by side.
    """
    found, ended = np.zeros((REPLICATES, len(levels))), np.zeros(REPLICATES, dtype=np.int64)
    cumulative, of_levels = np.cumsum(chain.transition, axis=1), np.array(levels)

    def estimate(i: int) -> None:
        rng = np.random.Generator(np.random.Philox(key=[seed, i]))
        arguments = cumulative, chain.delivery, of_levels, work, rng, found[i]
        ended[i] = run_parts(split, parts or {}, processes[i], start, *arguments)

    with ThreadPoolExecutor(cores()) as pool:
        list(pool.map(estimate, range(REPLICATES)))
    runs = REPLICATES * work.trials * (len(levels) - 1)
    if ended.max() > FEW * work.trials:
        return Rate(_UNKNOWN, int(ended.sum()), runs)
    return Rate(_pooled(found, work), int(ended.sum()), runs)


_UNKNOWN = Estimate(0.0, 0.0, 1.0)


def _pooled(hits: Floats, work: Work) -> Estimate:
    """The rate by all replicates, of which `hits` has a row each, with the interval of its logarithm by the jackknife.

    The probability of each level is estimated from all of them before these are multiplied: a mean of their products
    would be skew, with its spread and itself too small at once. Unknown where it rests on a single replicate.
    """
    whole = _log_rate(hits, work)
    without = np.array([_log_rate(np.delete(hits, i, axis=0), work) for i in range(len(hits))])
    if not np.isfinite(without).all():
        return _UNKNOWN
    spread = math.sqrt((1.0 - 1.0 / len(hits)) * float(np.square(without - without.mean()).sum()))
    low, value, high = (math.exp(min(whole + times * spread, 0.0)) for times in (-_STUDENT, 0.0, _STUDENT))
    return Estimate(value, low, high)


def _log_rate(hits: Floats, work: Work) -> float:
    """Logarithm of the rate; -inf if the last level was never reached."""
    started = (hits[:, :-1] > 0.0).sum(axis=0) * work.trials
    of_levels = hits[:, 1:].sum(axis=0)
    if hits[:, 0].sum() == 0.0 or (of_levels == 0.0).any():
        return -math.inf
    return float(math.log(hits[:, 0].mean() / work.base) + np.log(of_levels / started).sum())


def tail_rate(chain: Chain) -> float:
    """By what factor the probability of an outage falls with each slot that it is longer, in the end."""
    losing = chain.transition * (1.0 - chain.delivery)
    return float(np.abs(np.linalg.eigvals(losing)).max())


def age_levels(chain: Chain, last: int, first: int) -> list[int]:
    """Ages from `first` to `last`, such that the next one is reached with a probability of about a quarter."""
    decay = tail_rate(chain)
    apart = max(1, round(math.log(_SHARE) / math.log(decay))) if 0.0 < decay < 1.0 else 1
    return sorted({*range(min(first, last), last, apart), last})


_SHARE = 0.25
