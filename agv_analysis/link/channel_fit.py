"""A channel model fitted to recorded outcomes: independent losses or bursts, by maximum likelihood, and which of them.

A series of outcomes l(1) .. l(N) is a two-state Markov chain with p = P(lost after delivered) and r = P(delivered after
lost): the Gilbert channel, netem's gemodel with h = 0, k = 1. Given the first outcome its maximum-likelihood estimates
are shares of transitions. Independent losses are the case p + r = 1 within it, so twice the difference of the log
likelihoods is compared with the chi-square distribution of one degree of freedom.

The share of lost slots has no binomial interval where losses come in bursts. Its interval, and that of the mean age of
information, follow from the posterior of (p, r) given the transitions (`transitions`); where the outcomes are those of
no such chain (`goodness_of_fit`), from parts of the recording drawn anew with random weights.

Source: Anderson and Goodman, Statistical Inference about Markov Chains, Ann. Math. Stat. 28, 1957.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from agv_analysis.link.goodness_of_fit import Goodness, goodness_of_fit
from agv_analysis.link.large_arrays import column_of, count_of, parts
from agv_analysis.link.markov_channel import Chain, bernoulli, gilbert_elliott
from agv_analysis.link.reception_intervals import Outcomes, Steps
from agv_analysis.link.resampling import age_and_loss_samples
from agv_analysis.link.transitions import TAIL, Transitions, count_transitions, interval_of, loss_rate, mean_age
from agv_analysis.metrics.confidence import clopper_pearson
from agv_analysis.run import Floats

SIGNIFICANCE = 0.01
"""Independent losses are rejected where outcomes this bursty would be rarer than this under them."""


@dataclass(frozen=True)
class Estimate:
    """A figure with its 95 % confidence interval."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, hits: int, trials: int) -> Estimate:
        """Share of hits in independent trials, at least one; exact interval (Clopper and Pearson)."""
        return cls(hits / trials, *clopper_pearson(hits, trials))

    @classmethod
    def about(cls, value: float, low: float, high: float) -> Estimate:
        """A value, and an interval that is made to hold it."""
        return cls(value, min(value, low), max(value, high))


@dataclass(frozen=True)
class ChannelFit:
    """Both models as fitted, and which of them the outcomes support."""

    loss_rate: Estimate
    """Share of the slots that were lost; the interval is that of the link's own rate, whatever the bursts."""
    mean_age: Estimate
    """E[n_ul] in steps; inf if nothing is ever received."""
    p: Estimate | None
    """Lost after delivered; None if nothing was delivered."""
    r: Estimate | None
    """Delivered after lost; None if nothing was lost."""
    p_value: float | None
    """Probability of outcomes this bursty (or this regular) if losses were independent; None without both outcomes."""
    transitions: Transitions
    goodness: Goodness
    """Is a Gilbert channel, which independent losses are a case of, compatible with the outcomes?"""

    @property
    def model(self) -> str:
        """The simplest model that the outcomes do not reject: perfect, bernoulli or gilbert_elliott."""
        if self.loss_rate.value == 0.0:
            return "perfect"
        return "gilbert_elliott" if self.p_value is not None and self.p_value < SIGNIFICANCE else "bernoulli"

    @property
    def chain(self) -> Chain:
        """The fitted model as a Markov chain.

        If no outage ended, r is not taken for 0, which nothing shows, but for what half a recovery would say.
        """
        if self.model == "gilbert_elliott" and self.p is not None and self.r is not None:
            return gilbert_elliott(*self.transitions.estimate)
        return bernoulli(self.loss_rate.value)

    @property
    def mean_burst(self) -> float:
        """Mean length of an outage in slots under the fitted model, 0 without losses, inf if all is lost."""
        return self.chain.mean_burst


def fit_channel(lost: Outcomes, k: Steps | None = None) -> ChannelFit:
    """Fit to outcomes, True where lost, shape (N,), N >= 1.

    They are those of the slots `k`, increasing; without `k` none is missing.
    """
    if k is None:
        k = column_of((np.arange(part.start, part.stop) for part in parts(len(lost))), np.int64)
    found, goodness = count_transitions(k, lost), goodness_of_fit(k, lost)
    ages, rates = age_and_loss_samples(k, lost) if not goodness.fits else (None, None)
    share = count_of(lost, lambda part: part) / len(lost)
    return ChannelFit(
        loss_rate=Estimate.about(share, *(interval_of(found, loss_rate) if rates is None else _quantiles(rates))),
        mean_age=Estimate.about(
            _mean_age(found, share), *(interval_of(found, mean_age) if ages is None else _quantiles(ages))
        ),
        p=_of_trials(found.to_lost, found.delivered),
        r=_of_trials(found.to_delivered, found.missed),
        p_value=_p_value(found) if found.delivered and found.missed else None,
        transitions=found,
        goodness=goodness,
    )


def _quantiles(samples: Floats) -> tuple[float, float]:
    low, high = np.quantile(samples, [TAIL, 1.0 - TAIL])
    return float(low), float(high)


def _of_trials(hits: float, trials: float) -> Estimate | None:
    return Estimate.of(int(hits), int(trials)) if trials else None


def _mean_age(found: Transitions, share: float) -> float:
    """By the estimates of p and r; what nothing is known of is not made up."""
    if share in (0.0, 1.0):
        return 0.0 if share == 0.0 else math.inf
    return float(mean_age(*found.estimate))


def _p_value(found: Transitions) -> float:
    lost = found.to_lost + found.missed - found.to_delivered
    bursts = _log_likelihood(found.to_lost, found.delivered) + _log_likelihood(found.to_delivered, found.missed)
    ratio = 2.0 * (bursts - _log_likelihood(lost, found.delivered + found.missed))
    return math.erfc(math.sqrt(max(0.0, ratio) / 2.0))  # chi-square of one degree: P(X^2 > ratio)


def _log_likelihood(hits: float, trials: float) -> float:
    """Largest log likelihood of `hits` in `trials`; 0 log 0 = 0."""
    return sum(count * math.log(count / trials) for count in (hits, trials - hits) if count)
