"""Loss rate and mean age of a link that is not a Markov chain: parts of the recording, weighed anew at random.

The recording is cut at receptions into parts much longer than an outage, and each part gets a random weight: the
Bayesian bootstrap, of blocks, because successive outages need not be independent.

Source: Rubin, The Bayesian Bootstrap, Ann. Statist. 9, 1981; Kuensch, The Jackknife and the Bootstrap for General
Stationary Observations, Ann. Statist. 17, 1989.
"""

from __future__ import annotations

import itertools

import numpy as np

from agv_analysis.link.large_arrays import parts, release
from agv_analysis.link.reception_intervals import Outcomes, Steps, reception_intervals
from agv_analysis.run import Floats

SAMPLES = 1000

_SEED = 1

_MOST, _FEWEST = 100, 8
"""Parts of a recording."""


def weights(parts: int, samples: int = SAMPLES) -> Floats:
    """Random weights that sum to 1, flat Dirichlet, shape (samples, parts); the same at each call."""
    drawn = np.random.default_rng(_SEED).standard_exponential((samples, parts))
    return np.asarray(drawn / drawn.sum(axis=1, keepdims=True))


def age_and_loss_samples(k: Steps, lost: Outcomes) -> tuple[Floats, Floats] | tuple[None, None]:
    """Mean ages [steps] and loss rates, each of shape (SAMPLES,), of outcomes of the slots `k`.

    None where receptions are too few. With intervals L between receptions: E[L (L - 1) / 2] / E[L] and E[L - 1] / E[L].
    """
    L = reception_intervals(k, lost).between_receptions
    count = min(_MOST, int(np.sqrt(2 * len(L))))
    if count < _FEWEST:
        return None, None
    upto = 0
    for part in parts(len(L), L):
        upto += int(L[part].sum())
    wanted, ends, upto = np.linspace(0.0, float(upto), count + 1)[1:-1], np.ones(count - 1, dtype=np.int64), 0
    for part in parts(len(L), L):  # how many of them end before each of the places wanted
        sums = upto + np.cumsum(L[part])
        ends += np.searchsorted(sums, wanted)
        upto = int(sums[-1])
    begins = np.unique(np.append(0, np.minimum(ends, len(L) - 1)))
    sums = np.array([_sums(L[first:end]) for first, end in itertools.pairwise([*begins.tolist(), len(L)])])
    slots, ages, losses = (weights(len(begins)) @ sums).T
    return ages / slots, losses / slots


def _sums(L: Steps) -> list[float]:
    """Of intervals: slots, ages of all slots, losses."""
    found = [float(values.sum()) for values in (L, L * (L - 1) // 2, L - 1)]
    release(L)
    return found
