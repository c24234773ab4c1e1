"""Loss rate and mean age of a link that is no Markov chain: parts of the recording, weighed anew at random.

The recording is cut at receptions into parts much longer than an outage, and each part gets a random weight: the
Bayesian bootstrap, of blocks, because successive outages need not be independent.

Source: Rubin, The Bayesian Bootstrap, Ann. Statist. 9, 1981; Kuensch, The Jackknife and the Bootstrap for General
Stationary Observations, Ann. Statist. 17, 1989.
"""

from __future__ import annotations

import numpy as np

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
    parts = min(_MOST, int(np.sqrt(2 * len(L))))
    if parts < _FEWEST:
        return None, None
    ends = np.searchsorted(np.cumsum(L), np.linspace(0.0, float(L.sum()), parts + 1)[1:-1]) + 1
    begins = np.unique(np.append(0, np.minimum(ends, len(L) - 1)))
    sums = np.stack([np.add.reduceat(values, begins) for values in (L, L * (L - 1) // 2, L - 1)]).astype(np.float64)
    slots, ages, losses = (weights(len(begins)) @ sums.T).T
    return ages / slots, losses / slots
