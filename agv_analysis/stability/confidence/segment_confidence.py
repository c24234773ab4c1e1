"""How sure it is that E[e^2] dies out under the link as one stretch of a recording shows it."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass

import numpy as np

from agv_analysis.link.goodness_of_fit import SIGNIFICANCE, Goodness, goodness_of_intervals
from agv_analysis.link.heavy_tail import tail_is_heavy
from agv_analysis.link.markov_channel import bernoulli
from agv_analysis.link.periodic_outages import period_of
from agv_analysis.link.reception_intervals import Intervals, Outcomes, Steps, reception_intervals
from agv_analysis.link.transitions import count_transitions
from agv_analysis.run import Floats
from agv_analysis.stability import mean_square
from agv_analysis.stability.confidence.growth_posterior import SURE, GrowthPosterior
from agv_analysis.stability.confidence.interval_growth import IntervalGrowth, grows_for_a_while, interval_growth
from agv_analysis.stability.floquet import drop_sequence
from agv_analysis.stability.linear_loop import MARGINAL, LinearLoop
from agv_ros.counted import counted

GILBERT, RENEWAL, BLOCKS, PERIODIC, PREDICTED = (
    "gilbert",
    "renewal",
    "dependent intervals",
    "periodic",
    "exact predictor",
)
"""Which judgement was used."""

_INTERVALS = 20
"""Fewest intervals between receptions, and outages, that are judged without a model."""

_LONGEST = 300.0

_HEAVY = "the longest outages are so long beside the others that their mean square may not exist"

_ADVANTAGE = 2.0
"""Log likelihood by which a heavy tail must be the likelier where geometric outages are not rejected."""

_FEW = 5
"""Outages below which a recording has seen few."""


@dataclass(frozen=True)
class SegmentConfidence:
    """What a stretch of a recording says of the loop."""

    begin: int
    """First step k."""
    end: int
    """Last step k."""
    seconds: tuple[float, float]
    """The same [s] since the first step of the recording; the end is that of the last step."""
    loss_rate: float
    outages: int
    method: str
    """gilbert, renewal, dependent intervals, periodic or exact predictor."""
    probability_stable: float
    growth: float
    """Point estimate, logarithm per step of E[e^2]."""
    growth_interval: tuple[float, float]
    """95 %."""
    record_seconds_more: float | None
    why: str
    """What the probability rests on, as the end of a sentence."""
    goodness: Goodness

    @property
    def word(self) -> str:
        """stable, unstable or undecided."""
        if self.probability_stable >= SURE:
            return "stable"
        return "unstable" if self.probability_stable <= 1.0 - SURE else "undecided"


@dataclass(frozen=True)
class _Found:
    method: str
    probability_stable: float
    growth: float
    interval: tuple[float, float]
    times_longer: float | None
    why: str


def segment_confidence(loop: LinearLoop, k: Steps, lost: Outcomes, first: int, move: float) -> SegmentConfidence:
    """Judge the outcomes of slots `k`, increasing, shape (N,), N >= 1, of a recording whose first step is `first`.

    `move` as of `growth_posterior.moved`.
    """
    intervals = reception_intervals(k, lost)
    goodness = goodness_of_intervals(intervals)
    found = _judge(loop, k, lost, intervals, goodness, move)
    seconds = len(k) * loop.ts
    decided = not 1.0 - SURE < found.probability_stable < SURE
    more = None if decided or found.times_longer is None else (found.times_longer - 1.0) * seconds
    return SegmentConfidence(
        begin=int(k[0]),
        end=int(k[-1]),
        seconds=(float(k[0] - first) * loop.ts, float(k[-1] + 1 - first) * loop.ts),
        loss_rate=float(np.mean(lost)),
        outages=len(intervals.outages) + (intervals.longest_open > 0),
        method=found.method,
        probability_stable=found.probability_stable,
        growth=found.growth,
        growth_interval=found.interval,
        record_seconds_more=None if more is None else _two_digits(max(more, 0.1 * seconds)),
        why=found.why,
        goodness=goodness,
    )


def _judge(loop: LinearLoop, k: Steps, lost: Outcomes, intervals: Intervals, goodness: Goodness, move: float) -> _Found:
    if loop.is_exact:
        return _of_exact_predictor(loop, lost)
    period = period_of(k, lost)
    if period is not None and not lost.all():
        return _of_period(loop, lost, period)
    enough = min(len(intervals.between_receptions), 4 * len(intervals.outages)) >= _INTERVALS
    if goodness.fits or not enough:
        posterior = GrowthPosterior(loop, count_transitions(k, lost), move)
        return _of_gilbert(posterior, intervals, goodness)
    return _of_intervals(loop, intervals, goodness, move)


def _of_exact_predictor(loop: LinearLoop, lost: Outcomes) -> _Found:
    if lost.all():
        return _Found(PREDICTED, 0.0, 0.0, (0.0, 0.0), None, "nothing was received")
    since = int(np.argmin(lost[::-1]))  # slots since the last pose: that outages leave nothing holds when one ends
    if since > len(lost) // 2:
        why = f"nothing was received in the last {since} of {counted(len(lost), 'slot')}"
        return _Found(PREDICTED, 0.5, 0.0, (0.0, 0.0), None, why)
    growth = mean_square.lap_growth(loop, bernoulli(0.0)) / loop.steps
    why = "the edge's model is exact, so that losses leave nothing of the error"
    return _Found(PREDICTED, float(growth < MARGINAL), growth, (growth, growth), None, why)


def _of_period(loop: LinearLoop, lost: Outcomes, period: int) -> _Found:
    """By the multiplier of the outcomes' own period; that they go on so is as sure as the periods seen make it."""
    periods, growth = len(lost) // period, growth_of_period(loop, lost[-period:])
    goes_on = (periods + 0.5) / (periods + 1.0)
    stable = growth < MARGINAL
    why = f"the outcomes repeat every {counted(period, 'slot')}, {periods} times, and over their period the error " + (
        "shrinks" if stable else "grows"
    )
    needed = 0.5 / (1.0 - SURE)
    probability = goes_on if stable else 1.0 - goes_on
    return _Found(PERIODIC, probability, growth, (growth, growth), max(1.0, needed / periods), why)


def growth_of_period(loop: LinearLoop, pattern: Outcomes) -> float:
    """Growth of E[e^2] (logarithm, per step) if outcomes, shape (P,), of which some are received, repeat forever."""
    steps = _whole(loop, len(pattern))
    from_reception = np.roll(pattern, -int(np.argmin(pattern)))
    return 2.0 * float(drop_sequence(loop, np.resize(from_reception, steps), 1)[0]) / steps


def _whole(loop: LinearLoop, period: int) -> int:
    """Steps of whole periods of the outcomes, about a lap of a loop that changes over it."""
    return period if loop.is_constant else period * max(1, round(loop.steps / period))


def _of_gilbert(posterior: GrowthPosterior, intervals: Intervals, goodness: Goodness) -> _Found:
    probability, count = posterior.probability_stable, len(intervals.outages)
    if goodness.fits:
        why = f"a Gilbert channel describes the outcomes, of {counted(count, 'complete outage')}"
        if count < _FEW:
            seen = counted(count, "complete outage was", "complete outages were")
            why = f"only {seen} seen" if count else "no complete outage was seen"
    else:  # too little to judge without a model, and the model is wrong: it may not be what makes the word green
        probability = min(probability, 0.5)
        few = counted(count, "complete outage is", "complete outages are")
        why = f"a Gilbert channel does not describe the outcomes, and {few} too few"
    if intervals.longest_open and intervals.longest_open >= intervals.outages.max(initial=0):
        why += (
            f"; an outage of at least {counted(intervals.longest_open, 'slot')} is cut off by an end of the recording"
        )
    if probability > 1.0 - SURE and goodness.fits and tail_is_heavy(intervals.outages, _ADVANTAGE):
        probability, why = min(probability, 0.5), _HEAVY
    undecided = 1.0 - SURE < probability < SURE
    longer = posterior.times_longer() if undecided and goodness.fits else None
    return _Found(GILBERT, probability, posterior.estimate, posterior.interval, longer, why)


def _of_intervals(loop: LinearLoop, intervals: Intervals, goodness: Goodness, move: float) -> _Found:
    lengths = intervals.between_receptions
    tested = (goodness.gap_lengths, goodness.longest_gap, goodness.independence)
    dependent = any(p is not None and p < SIGNIFICANCE for p in tested)
    found = interval_growth(loop, lengths, intervals.longest + 1, dependent, move)
    probability, heavy = found.probability_stable, tail_is_heavy(intervals.outages)
    why = "outages are those of no Gilbert channel, so the intervals between receptions were judged as they are"
    if found.block > 1:
        why += f", {found.block} at a time, because they depend on each other"
    if heavy and probability > 1.0 - SURE:  # else it grows with and without a mean square of theirs
        probability = min(probability, 0.5)
        why = _HEAVY
    elif probability > 0.5 and dependent and grows_for_a_while(loop, lengths):
        probability = 0.5
        why = "outages come in clusters within which the error grows, and it is not known how long these may last"
    elif probability < SURE and _share_of_longest(intervals) > 0.2:
        why += (
            f"; the longest outage of {counted(intervals.longest, 'slot')} alone makes up "
            f"{_share_of_longest(intervals):.0%} "
        )
        why += "of the sum of their squares"
    longer = None if heavy or probability == 0.5 else _times_longer(found, probability)
    return _Found(
        RENEWAL if found.block == 1 else BLOCKS, probability, found.growth, _interval(found.growth, found.samples),
        longer, why,
    )  # fmt: skip


def _share_of_longest(intervals: Intervals) -> float:
    squares = intervals.outages.astype(np.float64) ** 2
    longest = float(intervals.longest) ** 2
    others = float(squares.sum()) - (longest if intervals.longest == intervals.outages.max(initial=0) else 0.0)
    return longest / (others + longest)


def _times_longer(found: IntervalGrowth, probability: float) -> float | None:
    """The spread of a mean falls with the square root of the length; None where that is longer than is sensible."""
    if not 0.0 < probability < 1.0:
        return None
    normal = statistics.NormalDist()
    factor = (normal.inv_cdf(SURE) / max(abs(normal.inv_cdf(probability)), 1e-6)) ** 2
    return factor if factor <= _LONGEST else None


def _interval(estimate: float, samples: Floats) -> tuple[float, float]:
    low, high = np.quantile(samples, [0.0225, 0.9775])
    return min(estimate, float(low)), max(estimate, float(high))


def _two_digits(seconds: float) -> float:
    """Two significant digits: more would not be true of it."""
    return round(seconds, 1 - math.floor(math.log10(seconds))) if seconds > 0.0 else 0.0
