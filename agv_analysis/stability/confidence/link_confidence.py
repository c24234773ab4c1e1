"""How sure a mean-square verdict on a recording is: P(E[e^2] dies out | the outcomes recorded).

A recording is finite. What it shows of the link is taken apart in this order:

1. outages that repeat exactly are judged by the multiplier of their own period (`floquet`);
2. where the link changed (`change_points`) each segment is judged by itself, and the worst one decides;
3. if a Gilbert channel describes the outages (`goodness_of_fit`), the posterior of (p, r) decides (`growth_posterior`);
4. else the intervals between receptions as they are (`interval_growth`), with a tail that may be heavier than what was
   seen of it.

Between 5 % and 95 % nothing is decided.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from agv_analysis.link.change_points import Segment, Stationarity, stationarity
from agv_analysis.link.goodness_of_fit import Goodness
from agv_analysis.link.periodic_outages import period_of
from agv_analysis.link.reception_intervals import Outcomes, Steps
from agv_analysis.link.transitions import count_transitions
from agv_analysis.metrics.confidence import percent_after_of
from agv_analysis.stability.confidence.growth_posterior import moved
from agv_analysis.stability.confidence.segment_confidence import SegmentConfidence, segment_confidence
from agv_analysis.stability.linear_loop import LinearLoop


@dataclass(frozen=True)
class LinkConfidence:
    """What the outcomes of a recording say of the loop, and how surely."""

    segments: tuple[SegmentConfidence, ...]
    """Stretches of the recording over which the link did not change, in the order of time."""
    stationarity: Stationarity

    @property
    def worst(self) -> SegmentConfidence:
        """The segment that decides: the least sure to be stable, among equals the one of the largest growth."""
        return min(self.segments, key=lambda segment: (segment.probability_stable, -segment.growth))

    @property
    def probability_stable(self) -> float:
        """P(E[e^2] dies out | data), of the worst segment."""
        return self.worst.probability_stable

    @property
    def growth(self) -> float:
        """Point estimate of the growth of E[e^2], logarithm per step, of the worst segment."""
        return self.worst.growth

    @property
    def growth_interval(self) -> tuple[float, float]:
        """Its 95 % interval."""
        return self.worst.growth_interval

    @property
    def record_seconds_more(self) -> float | None:
        """About how much longer to record until it is decided [s]; None: it is, or no length is known to help."""
        return self.worst.record_seconds_more

    @property
    def goodness(self) -> Goodness:
        """Does a Gilbert channel describe the worst segment?"""
        return self.worst.goodness

    @property
    def method(self) -> str:
        """How the worst segment was judged: gilbert, renewal, dependent intervals, periodic or exact predictor."""
        return self.worst.method

    @property
    def reason(self) -> str:
        """One sentence: what is said of the loop, and why."""
        worst = self.worst
        where = ""
        if len(self.segments) > 1:
            where = (
                f"the link changed, and from {worst.seconds[0]:g} s to {worst.seconds[1]:g} s (steps {worst.begin} to "
                f"{worst.end}), with {worst.loss_rate:.1%} lost, "
            )
        said = {
            "stable": "the mean square of the error dies out",
            "unstable": "the mean square of the error grows",
            "undecided": "the recording does not show whether the mean square of the error dies out",
        }[worst.word]
        more, sure = self.record_seconds_more, percent_after_of(worst.probability_stable or math.ulp(0.0))
        longer = "" if more is None else f"; recording about {more:g} s more would probably decide it"
        return f"{where}{said}: {worst.why} (the error dies out with a probability {sure}){longer}"

    def to_json(self) -> dict[str, Any]:
        """`confidence`, `growth_interval`, `record_seconds_more`, `stationarity`, and the segments."""
        return {
            "confidence": self.probability_stable,
            "growth_interval": [value if np.isfinite(value) else None for value in self.growth_interval],
            "record_seconds_more": self.record_seconds_more,
            "stationarity": {
                **self.stationarity.to_json(),
                "segments": [
                    {
                        "begin": segment.begin,
                        "end": segment.end,
                        "loss_rate": segment.loss_rate,
                        "method": segment.method,
                        "confidence": segment.probability_stable,
                        "growth": segment.growth if np.isfinite(segment.growth) else None,
                    }
                    for segment in self.segments
                ],
            },
        }


def link_confidence(loop: LinearLoop, k: Steps, lost: Outcomes, ts: float) -> LinkConfidence:
    """Judge a loop by the outcomes `lost` of the slots `k`, increasing, shape (N,), N >= 1; `ts` is their period [s].

    Raises ValueError for no slots, or a period that is not the loop's.
    """
    if not len(k) or len(k) != len(lost):
        raise ValueError(f"k and lost must have one length, at least 1, got {len(k)} and {len(lost)}")
    if ts != loop.ts:
        raise ValueError(f"ts must be the loop's, {loop.ts}, got {ts}")
    is_periodic = period_of(k, lost) is not None
    found = Stationarity(None, (), (Segment(0, len(k)),)) if is_periodic else stationarity(k, lost)
    move = moved(loop, count_transitions(k, lost))
    parts = (slice(segment.begin, segment.end) for segment in found.segments)
    judged = (segment_confidence(loop, k[part], lost[part], int(k[0]), move) for part in parts)
    return LinkConfidence(tuple(judged), found)
