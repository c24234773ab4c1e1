"""A channel model fitted to recorded outcomes: independent losses or bursts, by maximum likelihood, and which of them.

A series of outcomes l(1) .. l(N) is a two-state Markov chain with p = P(lost after delivered) and r = P(delivered after
lost): the Gilbert channel, netem's gemodel with h = 0, k = 1. Given the first outcome its maximum-likelihood estimates
are shares of transitions. Independent losses are the case p + r = 1 within it, so twice the difference of the log
likelihoods is compared with the chi-square distribution of one degree of freedom.

Source: Anderson and Goodman, Statistical Inference about Markov Chains, Ann. Math. Stat. 28, 1957.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.markov_channel import Chain, bernoulli, gilbert_elliott
from agv_analysis.metrics.confidence import clopper_pearson

SIGNIFICANCE = 0.01
"""Independent losses are rejected where outcomes this bursty would be rarer than this under them."""


@dataclass(frozen=True)
class Estimate:
    """A probability with its 95 % confidence interval."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, hits: int, trials: int) -> Estimate:
        """Share of hits in independent trials, at least one; exact interval (Clopper and Pearson)."""
        return cls(hits / trials, *clopper_pearson(hits, trials))


@dataclass(frozen=True)
class ChannelFit:
    """Both models as fitted, and which of them the outcomes support."""

    loss_rate: Estimate
    """p of independent losses; its interval holds for these alone, bursts make the true one wider."""
    p: Estimate | None
    """Lost after delivered; None if nothing was delivered."""
    r: Estimate | None
    """Delivered after lost; None if nothing was lost."""
    p_value: float | None
    """Probability of outcomes this bursty (or this regular) if losses were independent; None without both outcomes."""

    @property
    def model(self) -> str:
        """The simplest model that the outcomes do not reject: perfect, bernoulli or gilbert_elliott."""
        if self.loss_rate.value == 0.0:
            return "perfect"
        return "gilbert_elliott" if self.p_value is not None and self.p_value < SIGNIFICANCE else "bernoulli"

    @property
    def chain(self) -> Chain:
        """The fitted model as a Markov chain."""
        if self.model == "gilbert_elliott" and self.p is not None and self.r is not None:
            return gilbert_elliott(self.p.value, self.r.value)
        return bernoulli(self.loss_rate.value)

    @property
    def mean_burst(self) -> float:
        """Mean length of an outage in slots under the fitted model, inf if none ends, 0 without losses."""
        return self.chain.mean_burst


def fit_channel(lost: NDArray[np.bool_]) -> ChannelFit:
    """Fit to outcomes, True where lost, shape (N,), N >= 1."""
    before, after = lost[:-1], lost[1:]
    to_lost = int(np.count_nonzero(~before & after))
    to_delivered = int(np.count_nonzero(before & ~after))
    delivered, missed = int(np.count_nonzero(~before)), int(np.count_nonzero(before))
    return ChannelFit(
        loss_rate=Estimate.of(int(np.count_nonzero(lost)), len(lost)),
        p=Estimate.of(to_lost, delivered) if delivered else None,
        r=Estimate.of(to_delivered, missed) if missed else None,
        p_value=_p_value(to_lost, delivered, to_delivered, missed) if delivered and missed else None,
    )


def _p_value(to_lost: int, delivered: int, to_delivered: int, missed: int) -> float:
    lost = to_lost + missed - to_delivered
    bursts = _log_likelihood(to_lost, delivered) + _log_likelihood(to_delivered, missed)
    ratio = 2.0 * (bursts - _log_likelihood(lost, delivered + missed))
    return math.erfc(math.sqrt(max(0.0, ratio) / 2.0))  # chi-square of one degree: P(X^2 > ratio)


def _log_likelihood(hits: int, trials: int) -> float:
    """Largest log likelihood of `hits` in `trials`; 0 log 0 = 0."""
    return sum(count * math.log(count / trials) for count in (hits, trials - hits) if count)
