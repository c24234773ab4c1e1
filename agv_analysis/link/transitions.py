"""Transitions of recorded outcomes, and the Gilbert channels that they leave possible.

With p = P(lost after delivered) and r = P(delivered after lost) the transitions are binomial counts, and given them p
and r have independent beta distributions. Prior: p by Jeffreys, Beta(1/2, 1/2); r Beta(1/2, 1), uniform in sqrt(r),
which expects longer outages than Jeffreys' prior does: a recording that has not shown how long outages are must not
take them for short ones. A few outages outweigh either.

An outage that is still open where the recording ends adds slots that did not recover and nothing else, which is what a
censored observation is. Pairs of slots with a step missing between them are not transitions.

Source: Anderson and Goodman, Statistical Inference about Markov Chains, Ann. Math. Stat. 28, 1957; priors: Brown, Cai
and DasGupta, Interval Estimation for a Binomial Proportion, Stat. Science 16, 2001.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from agv_analysis.link.large_arrays import parts
from agv_analysis.link.reception_intervals import Outcomes, Steps
from agv_analysis.metrics.outages import is_unbroken
from agv_analysis.run import Floats

SAMPLES = 4000
"""Channels drawn from a posterior: probabilities are good to 0.005, at 0.95 to 0.003."""

TAIL = 0.0225
"""Share of a posterior at each end that a 95 % interval leaves out, with some room for counts that are small."""

_FEW = 10
"""Outages below which the interval's upper end is that of the more pessimistic posterior."""

_SEED = 1


@dataclass(frozen=True)
class Transitions:
    """Counts of pairs of successive slots."""

    to_lost: float
    """Lost after delivered."""
    delivered: float
    """Delivered slots that have a successor."""
    to_delivered: float
    """Delivered after lost."""
    missed: float
    """Lost slots that have a successor."""

    @property
    def p(self) -> float | None:
        """Maximum-likelihood estimate; None if nothing was delivered."""
        return self.to_lost / self.delivered if self.delivered else None

    @property
    def r(self) -> float | None:
        """Maximum-likelihood estimate; None if nothing was lost."""
        return self.to_delivered / self.missed if self.missed else None

    @property
    def estimate(self) -> tuple[float, float]:
        """(p, r), by maximum likelihood where that is in (0, 1]; the posterior mean of r where no outage ended."""
        p = (self.to_lost + 0.5) / (self.delivered + 1.0) if self.p is None else self.p
        return p, self.r or (self.to_delivered + 0.5) / (self.missed + 1.5)

    def times(self, factor: float) -> Transitions:
        """What a recording `factor` times as long would show if it went on as it was."""
        counts = (self.to_lost, self.delivered, self.to_delivered, self.missed)
        return Transitions(*(factor * count for count in counts))

    def posterior(self, size: int = SAMPLES) -> tuple[Floats, Floats]:
        """Draws of p and r, each of shape (size,); the same at each call (generator PCG64, seed 1)."""
        rng = np.random.default_rng(_SEED)
        p = rng.beta(self.to_lost + 0.5, self.delivered - self.to_lost + 0.5, size)
        r = rng.beta(self.to_delivered + 0.5, self.missed - self.to_delivered + 1.0, size)
        return np.clip(p, 1e-300, 1.0), np.clip(r, 1e-300, 1.0)

    def pessimistic_posterior(self, size: int = SAMPLES) -> tuple[Floats, Floats]:
        """As `posterior`, as if half an outage more had begun and up to a whole one less had ended, where any was seen.

        For what is said of a link to be wrong no more often than it claims, which a posterior holds only on average.
        """
        rng = np.random.default_rng(_SEED)
        begun = self.to_lost + (0.5 if self.to_lost == 0 else 1.0)
        ended = max(0.5, self.to_delivered - min(0.5, 0.25 * self.to_delivered))
        p = rng.beta(begun, self.delivered - self.to_lost + 0.5, size)
        r = rng.beta(ended, self.missed - self.to_delivered + 1.0, size)
        return np.clip(p, 1e-300, 1.0), np.clip(r, 1e-300, 1.0)


def interval_of(transitions: Transitions, figure: Callable[[Floats, Floats], Floats]) -> tuple[float, float]:
    """95 % interval of a figure of Gilbert channels (p, r), larger for more losses; wider upwards for few outages."""
    drawn = figure(*transitions.posterior())
    low, high = np.quantile(drawn, [TAIL, 1.0 - TAIL])
    if transitions.to_lost < _FEW:
        high = max(high, np.quantile(figure(*transitions.pessimistic_posterior()), 1.0 - TAIL))
    return float(low), float(high)


def count_transitions(k: Steps, lost: Outcomes) -> Transitions:
    """Transitions of the outcomes of slots `k`, increasing, shape (N,)."""
    counts = np.zeros(4, dtype=np.int64)
    for part in parts(len(lost) - 1, k, lost):
        before, after = lost[part], lost[part.start + 1 : part.stop + 1]
        if not is_unbroken(k):
            known = np.diff(k[part.start : part.stop + 1]) == 1
            before, after = before[known], after[known]
        counts += [np.count_nonzero(of) for of in (~before & after, ~before, before & ~after, before)]
    to_lost, delivered, to_delivered, missed = counts.tolist()
    return Transitions(to_lost, delivered, to_delivered, missed)


Probability = TypeVar("Probability", float, Floats)


def loss_rate(p: Probability, r: Probability) -> Probability:
    """pi = p / (p + r) of Gilbert channels."""
    return p / (p + r)


def mean_age(p: Probability, r: Probability) -> Probability:
    """E[n_ul] = pi / r of Gilbert channels, in steps."""
    return loss_rate(p, r) / r
