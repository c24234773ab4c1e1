"""Which RMS deviation is right: that of the linear loop, of simulated laps, or of runs that show the rare outages.

The second moments of the linear loop are exact as long as outages do not lead far off the track. Simulated laps know
the whole loop, but where the square of the deviation has no variance they hardly show the outages that make its mean.
There importance sampling of the whole loop decides.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from agv_analysis.corridor.lap_loop import LapLoop
from agv_analysis.corridor.leaving import Leaving
from agv_analysis.corridor.sampled_deviation import sampled_deviation
from agv_analysis.corridor.stationary_deviation import StationaryDeviation
from agv_analysis.json_values import finite
from agv_analysis.link.channel_fit import Estimate
from agv_analysis.link.markov_channel import Chain
from agv_analysis.metrics.deviation import DIVERGED
from agv_analysis.metrics.distance_text import metres

FIRST_ORDER, SAMPLED, SIMULATED = (
    "second moments of the linear loop", "importance sampling of the nonlinear loop", "simulated laps",
)  # fmt: skip

_ALIKE = 0.02
"""Relative difference of the first order from the interval of simulated laps at which it is right."""

_NONE = 1e-9
"""Deviation that is none but for rounding [m]."""


@dataclass(frozen=True)
class RmsDeviation:
    """Stationary RMS distance from the reference [m]."""

    value: float | None
    """None: to first order it settles, but nothing says whether the whole loop's is that; inf: it does not settle."""
    interval: tuple[float, float] | None
    """Of 95 %; None: it is not estimated but computed."""
    method: str
    simulated: Estimate
    """Of the simulated laps; inf where one diverged."""
    first_order: float | None
    """By the second moments of the linear loop, inf where they do not settle; None: not computed, `reason` says why."""
    reason: str

    def __str__(self) -> str:
        laps = f"{_with_interval(self.simulated)} in the simulated laps"
        if self.first_order is None:
            return f"{laps}; not known to first order: {self.reason}"
        if not math.isfinite(self.first_order):
            return f"{laps}; to first order its mean square does not settle"
        first = f"{metres(self.first_order)} to first order"
        others = f"{first}, {laps}"
        if self.value is None:
            return f"no answer: {self.reason}; {others}"
        if self.method == SAMPLED and self.interval is not None:
            return f"{_with_interval(Estimate(self.value, *self.interval))} by {SAMPLED}; {others}"
        return others if self.method == FIRST_ORDER else f"{laps}; {first} is not right"

    def notes(self) -> Iterator[str]:
        """What must be said of it."""
        if self.method == SAMPLED or self.value is None:
            yield (
                "the square of the deviation has no variance under this channel: long outages that hardly any "
                "simulated lap shows make a large part of its mean, so the RMS of laps comes out too small"
            )

    def to_json(self) -> dict[str, Any]:
        """The figures by name [m]."""
        return {
            "rms_deviation": None if self.value is None else finite(self.value),
            "rms_deviation_interval": None if self.interval is None else [finite(end) for end in self.interval],
            "rms_deviation_method": self.method,
            "rms_deviation_reason": self.reason or None,
            "rms_first_order": None if self.first_order is None else finite(self.first_order),
            "rms_simulated": finite(self.simulated.value),
            "rms_simulated_interval": [finite(self.simulated.low), finite(self.simulated.high)],
        }


def rms_deviation(
    loop: LapLoop, chain: Chain | None, stationary: StationaryDeviation | None, reason: str, found: Leaving
) -> RmsDeviation:
    """Of a loop under a channel whose laps are simulated, and what its second moments say or why there are none."""
    laps = found.rms_interval
    of_laps = laps.value, (laps.low, laps.high), SIMULATED, laps
    if stationary is None or chain is None:
        return RmsDeviation(*of_laps, None, reason)
    first = stationary.rms
    if not math.isfinite(first):
        return RmsDeviation(math.inf, None, FIRST_ORDER, laps, first, "")
    if stationary.has_heavy_tail and first > _NONE:
        a = loop.linear.along_gain
        sampled = None if a is None else sampled_deviation(loop, chain, a, stationary.drift)
        if sampled is not None:
            return RmsDeviation(sampled.value, (sampled.low, sampled.high), SAMPLED, laps, first, "")
        return RmsDeviation(
            None, None, FIRST_ORDER, laps, first, "long outages make it, which no runs of this loop show"
        )
    if laps.low * (1.0 - _ALIKE) <= first <= max(_NONE, laps.high * (1.0 + _ALIKE)):
        return RmsDeviation(first, None, FIRST_ORDER, laps, first, "")
    return RmsDeviation(*of_laps, first, "the loop is not linear where outages lead")


def _with_interval(found: Estimate) -> str:
    if found.low == found.high or not found.value <= DIVERGED:
        return metres(found.value)
    return f"{metres(found.value)} ({metres(found.low)} .. {metres(found.high)})"
