"""How often a link fails a loop: of a channel in closed form, of a measurement with intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from agv_analysis.json_values import finite
from agv_analysis.link.channel_fit import Estimate
from agv_analysis.link.link_figures import ROUND_TRIP, LinkFigures
from agv_analysis.link.markov_channel import Chain, gilbert_elliott
from agv_analysis.link.reception_intervals import reception_intervals
from agv_analysis.link.transitions import count_transitions, interval_of
from agv_analysis.metrics.confidence import CONFIDENCE, clopper_pearson
from agv_analysis.requirements.availability import Availability, availability_of, packets_for
from agv_analysis.run import Floats


@dataclass(frozen=True)
class LinkAvailability:
    """What a link gives a loop that survives outages of so many slots."""

    unavailability: Estimate
    mtbf: Estimate
    """Mean time between failures [s]; inf where none was seen, or none can be."""
    loss_rate: Estimate
    latency: float | None
    """The longest time under way of what is not lost [s]; of a measurement its 99th percentile; None: not known."""
    failures: int | None = None
    """That were seen; None for a channel."""
    packets: int | None = None
    """That were seen; None for a channel."""
    assumption: str = ""
    interval: float | None = None
    """Time between packets [s]; None for a channel."""

    @property
    def availability(self) -> Estimate:
        """1 less the unavailability."""
        found = self.unavailability
        return Estimate(1.0 - found.value, 1.0 - found.high, 1.0 - found.low)

    def more_packets(self, availability: float) -> int | None:
        """Packets still to be measured without a failure until this availability is proved; None if one was seen."""
        if self.packets is None or self.failures:
            return None
        return max(0, packets_for(availability) - self.packets)

    def to_json(self) -> dict[str, Any]:
        """`availability`, `unavailability`, `mtbf_s`, `loss_rate`, and the interval of each, null for no end."""
        named = {
            "availability": self.availability,
            "unavailability": self.unavailability,
            "mtbf_s": self.mtbf,
            "loss_rate": self.loss_rate,
        }
        figures: dict[str, Any] = {}
        for name, estimate in named.items():
            figures[name] = finite(estimate.value)
            figures[f"{name}_interval"] = [finite(estimate.low), finite(estimate.high)]
        return {
            **figures,
            "latency_s": self.latency,
            "failures": self.failures,
            "packets": self.packets,
            "assumption": self.assumption,
        }


def _exactly(value: float) -> Estimate:
    return Estimate(value, value, value)


def of_channel(chain: Chain, n: int, ts: float, latency: float = 0.0) -> LinkAvailability:
    """Of a link that is this chain, for a loop that survives `n` >= 0 slots of `ts` [s]."""
    found = availability_of(chain, n, ts)
    return LinkAvailability(
        _exactly(found.unavailability), _exactly(found.mtbf), _exactly(chain.loss_rate), latency,
        assumption="the link is the channel of the scenario",
    )  # fmt: skip


def of_measurement(figures: LinkFigures, survival: float) -> LinkAvailability:
    """Of a measured link, for a loop that survives outages of `survival` [s]; intervals of 95 %.

    A failure is an outage that lasts longer. Where a Gilbert channel describes the losses the intervals are those of
    the channels that the measurement leaves possible; else those of how many failures there were and how long.
    """
    direction = figures.fitted
    k, lost, interval = direction.k, direction.lost, figures.measured.interval or survival or 1.0
    n = math.floor(survival / interval + 1e-9)
    found = reception_intervals(k, lost)
    lengths = np.concatenate((found.outages, [found.longest_open] if found.longest_open else []))
    excess = np.maximum(0.0, lengths - n)
    failures, packets = int(np.count_nonzero(excess)), len(k)
    share = float(excess.sum()) / packets
    fits = direction.fit.goodness.fits
    rate = clopper_pearson(failures, packets)
    if failures == 0:
        high = 1.0 - (1.0 - CONFIDENCE) ** (1.0 / packets)
        unavailability = Estimate(0.0, 0.0, high)
        rate = (0.0, high)
        assumption = "no failure was seen: the bounds are those of independent packets"
    elif fits:
        seen = count_transitions(k, lost)
        unavailability = Estimate.about(share, *interval_of(seen, lambda p, r: _unavailability(p, r, n)))
        assumption = "a Gilbert channel describes the losses"
    else:
        unavailability = _of_failures(share, excess[excess > 0.0], rate, packets)
        assumption = "failures are taken for independent of each other; no model of the losses between them"
    if direction.name == ROUND_TRIP:
        assumption += "; they are of round trips, since on which way a packet was lost is not known"
    up = packets - float(excess.sum())
    mtbf = Estimate.about(
        interval * up / failures if failures else math.inf,
        interval * (1.0 - unavailability.high) / rate[1],
        interval / rate[0] if rate[0] > 0.0 else math.inf,
    )
    spread = figures.whole.delay
    return LinkAvailability(
        unavailability, mtbf, direction.loss_rate or direction.fit.loss_rate,
        None if spread is None else spread.percentiles[-1], failures, packets, assumption, interval,
    )  # fmt: skip


def _unavailability(p: Floats, r: Floats, n: int) -> Floats:
    """U of Gilbert channels, p / (p + r) (1 - r)^n."""
    return np.asarray(p / (p + r) * (1.0 - r) ** n)


def _of_failures(share: float, excess: Floats, rate: tuple[float, float], packets: int) -> Estimate:
    """From how many failures there were and how long each was: their rate times their mean length, each at its ends.

    A mean of lengths that are about exponential has the spread of a gamma distribution.
    """
    drawn = np.random.default_rng(1).gamma(len(excess), 1.0 / len(excess), 4000)
    short, long = np.quantile(1.0 / drawn, [0.025, 0.975])
    mean = float(excess.mean())
    return Estimate.about(share, rate[0] * mean * float(short), min(1.0, rate[1] * mean * float(long)))


def fitted_availability(figures: LinkFigures, survival: float) -> Availability:
    """Of the Gilbert channel fitted to a measurement, in its own packets."""
    interval = figures.measured.interval or survival or 1.0
    p, r = figures.fitted.fit.transitions.estimate
    return availability_of(gilbert_elliott(p, r), math.floor(survival / interval + 1e-9), interval)
