"""The channel that has a service's availability and mean time between failures, for a loop that survives n slots.

A Gilbert channel (p, r) fails such a loop, as of `availability`, for 1 / r slots on average each time, since an outage
that has outlived n slots goes on as any other does. With the unavailability U and the mean time between failures T

    r = T_s (1 - U) / (T U),    p / (p + r) (1 - r)^n = U

so both figures together are one Gilbert channel, or none. One figure alone, or a loss rate, says nothing of how long a
failure lasts: then losses are taken for independent, U = p^(n + 1). Which outages of up to n slots come with it is the
channel's answer, not the service's: a service may have any of them while it is available.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from agv_analysis.link.markov_channel import Chain, bernoulli, gilbert_elliott

_BISECTIONS = 200


class ServiceChannel(NamedTuple):
    """The channel of a service's figures."""

    chain: Chain | None
    why: str
    """What it is, or why there is none."""
    failure: float | None
    """Mean length of a failure [s]: how much longer than n slots an outage lasts that is longer; None: not known."""


def channel_of_service(
    availability: float | None, mtbf: float | None, n: int, ts: float, loss_rate: float | None = None
) -> ServiceChannel:
    """The channel of a service with an availability below 1, a mean time between failures `mtbf` [s], or both.

    For a loop that survives outages of up to `n` >= 0 slots of `ts` [s]. `loss_rate` counts where neither is given.
    """
    if availability is not None and mtbf is not None:
        return _gilbert(1.0 - availability, mtbf, n, ts)
    if availability is not None:
        p = (1.0 - availability) ** (1.0 / (n + 1))
    elif mtbf is not None:
        p = _loss_of(mtbf, n, ts)
    elif loss_rate is not None:
        p = loss_rate
    else:
        return ServiceChannel(None, "nothing is said of how often it fails", None)
    return ServiceChannel(bernoulli(p), f"independent losses, p {p:.4g}", ts / (1.0 - p) if p < 1.0 else math.inf)


def _gilbert(unavailability: float, mtbf: float, n: int, ts: float) -> ServiceChannel:
    failure = mtbf * unavailability / (1.0 - unavailability)
    r = ts / failure
    if r > 1.0 + 1e-9:
        return ServiceChannel(
            None,
            f"no channel: a failure would last {1e3 * failure:.4g} ms on average, less than the {1e3 * ts:.4g} ms from "
            "one message to the next",
            failure,
        )
    r = min(1.0, r)
    tail = (1.0 - r) ** n
    share = unavailability / tail if tail > 0.0 else math.inf
    p = r * share / (1.0 - share) if share < 1.0 else math.inf
    if p > 1.0:
        return ServiceChannel(
            None,
            f"no Gilbert channel: failures of {1e3 * failure:.4g} ms on average, so often, are not rare enough among "
            f"outages of up to {n} slots",
            failure,
        )
    return ServiceChannel(
        gilbert_elliott(p, r), f"a Gilbert channel, p {p:.4g}, r {r:.4g}: the only one of these figures", failure
    )


def _loss_of(mtbf: float, n: int, ts: float) -> float:
    """Probability of independent losses p with the mean time between failures T_s (1 - p^(n+1)) / ((1-p) p^(n+1))."""
    low, high = -700.0, 0.0  # of log p
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        p, log_u = math.exp(middle), (n + 1) * middle
        log_mtbf = math.log(ts) + math.log(-math.expm1(log_u)) - math.log(-math.expm1(middle)) - log_u
        low, high = (middle, high) if log_mtbf > math.log(mtbf) else (low, middle)
        if p == 1.0:
            break
    return math.exp(low)
