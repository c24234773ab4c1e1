"""What a channel does to its messages, without a loop: losses, bursts and ages, beside their closed form.

For a channel that is a Markov chain (T, g), with D = diag(1 - g) and pi the stationary distribution, the last j slots
are all lost with probability P(n_ul >= j) = pi D (T D)^(j-1) 1; the age's distribution follows by differences.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from agv_analysis.compiled.functions import compiled, numbers
from agv_analysis.link.channel_fit import ChannelFit, fit_channel
from agv_analysis.link.markov_channel import Chain, chain_of
from agv_analysis.metrics.outages import LinkOutages, Outcomes, Steps, ages, link_outages
from agv_analysis.run import Floats
from agv_analysis.simulation.channel_outcomes import ChannelRealisation
from agv_analysis.simulation.link_loop import empty_trace, listen
from agv_plant.channels.rayleigh import fades_per_metre, loss_rate
from agv_plant.parameters import ChannelParameters


class Expected(NamedTuple):
    """What theory says of a channel; None where it says nothing."""

    loss_rate: float | None = None
    mean_burst: float | None = None
    mean_age: float | None = None


_SHORTEST_FADE = 3.0
"""Mean length of a fade in slots from which on theory, which knows no slots, says how long an outage is."""


@dataclass(frozen=True)
class ChannelStudy:
    """Slots of a channel, and what they come to."""

    channel: ChannelParameters
    lost: Outcomes
    """Outcomes of the slots, True where lost, shape (N,)."""
    age: Steps
    """Slots since the last delivered one, shape (N,)."""
    outages: LinkOutages
    chain: Chain | None
    """The channel as a Markov chain; None if it is none."""
    late: float = 0.0
    """Share of the messages that are not lost and come in a later slot than their own."""
    distance: float = 0.0
    """How far the AGV drove [m]."""

    @property
    def expected(self) -> Expected:
        """What theory says of the channel."""
        c = self.channel
        if self.chain is not None:
            age = self.chain.mean_age if not c.delays and math.isfinite(self.chain.mean_age) else None
            return Expected(self.chain.loss_rate, self.chain.mean_burst, age)
        if c.model == "rayleigh" and not c.schedule:
            fades, rate = fades_per_metre(c.carrier, c.margin) * self.distance, loss_rate(c.margin)
            lasts = rate * len(self.lost) / fades if fades > 0.0 else 0.0
            return Expected(rate, lasts if lasts > _SHORTEST_FADE else None)
        return Expected()

    @property
    def fit(self) -> ChannelFit:
        """The model that the slots themselves speak for."""
        return fit_channel(self.lost)

    @property
    def age_shares(self) -> Floats:
        """Share of slots with age 0, 1, 2, ..., up to the largest that occurred."""
        return np.asarray(np.bincount(self.age) / len(self.age))

    @property
    def expected_age_shares(self) -> Floats | None:
        """P(n_ul = j) in closed form, as long as `age_shares`; None for late messages or without a Markov chain."""
        if self.chain is None or self.channel.delays:
            return None
        return age_distribution(self.chain, len(self.age_shares))

    def to_json(self) -> dict[str, Any]:
        """Figures by name; null where nothing is known or nothing is finite."""
        expected, shares = self.expected, self.expected_age_shares
        return {
            "model": self.channel.model,
            "slots": self.outages.slots,
            "lost": self.outages.lost,
            "loss_rate": self.outages.loss_rate,
            "mean_burst": self.outages.mean_burst,
            "longest": self.outages.longest,
            "histogram": {str(length): count for length, count in self.outages.histogram.items()},
            "mean_age": self.outages.age.mean,
            "late": self.late,
            "age_shares": self.age_shares.tolist(),
            "closed_form": None if expected == Expected() else {
                **expected._asdict(),
                "age_shares": None if shares is None else shares.tolist(),
            },
        }  # fmt: skip


def study(
    channel: ChannelParameters, seed: int, link: str, slots: int, ts: float, places: Floats | None = None
) -> ChannelStudy:
    """The first `slots` slots of a channel: those that a run with this seed meets on this link.

    `places` are those of the AGV in frame `map` [m], shape (slots, 2); without them it stands at the origin. Raises
    TraceError for a trace that cannot be used or must not be outrun.
    """
    realisation, k = ChannelRealisation(seed, slots, ts), np.arange(slots)
    places = np.zeros((slots, 2)) if places is None else places
    distance = float(np.hypot(*np.diff(places, axis=0).T).sum())
    if channel.is_direct:
        lost = realisation.outcomes(channel, link)
        age = ages(k, lost)
        return ChannelStudy(channel, lost, age, link_outages(k, lost, age, ts), chain_of(channel), distance=distance)
    trace, inputs = empty_trace(slots), realisation.link_inputs(channel, link)
    compiled(listen)(inputs, trace, numbers(places))
    age, late = k - trace.held, float(np.mean(np.asarray(inputs.waits)[~trace.lost] > 0))
    return ChannelStudy(
        channel, trace.lost, age, link_outages(k, trace.lost, age, ts), chain_of(channel), late, distance
    )


def age_distribution(chain: Chain, count: int) -> Floats:
    """Stationary P(n_ul = j) for j = 0 .. count - 1, shape (count,)."""
    lost = 1.0 - chain.delivery
    beyond = [1.0]  # P(n_ul >= j)
    state = chain.stationary * lost
    for _ in range(count):
        beyond.append(float(state.sum()))
        state = state @ chain.transition * lost
    return -np.diff(np.array(beyond))


def fitted(lost: Outcomes, channel: ChannelParameters) -> ChannelParameters:
    """The model fitted to outcomes, as parameters of a channel; those that the fit does not know stay."""
    fit = fit_channel(lost)
    if fit.model == "gilbert_elliott" and fit.p is not None and fit.r is not None:
        return replace(channel, model=fit.model, p=fit.p.value, r=fit.r.value, h=0.0, k=1.0)
    return replace(channel, model=fit.model, p=fit.loss_rate.value)
