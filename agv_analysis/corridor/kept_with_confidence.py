"""The inverse: the narrowest corridor that a lap keeps with a given confidence, and the largest speed at which it does.

By the largest share of the corridor that each of many simulated laps uses: the quantile of these shares is by how much
the corridor may be narrower, or must be wider. Its interval is that of order statistics, without a model. Of what
hardly any lap shows, importance splitting tells the probability, in corridors of several widths: it needs an uplink
that is a Markov chain, and alone loses messages.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from agv_analysis.corridor.lap_loop import LapLoop
from agv_analysis.corridor.leaving import LAPS, chain_alone, leaving
from agv_analysis.corridor.rare_leaving import leaving_rate
from agv_analysis.corridor.single_outage import roughly
from agv_analysis.corridor.widths import Widths, widths_of
from agv_analysis.json_values import finite
from agv_analysis.link.channel_fit import Estimate
from agv_analysis.metrics.distance_text import metres
from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_cloud.parameters import CSV, PATH
from agv_ros.errors import UserError

MOST = 0.99
"""Largest confidence that simulated laps are asked for; beyond it importance splitting is."""

_MOST_OF_ALL = 1.0 - 1e-12
"""Largest confidence: beyond it a share of the laps is no more than rounding of 1."""

_WIDEST, _WIDTHS = 2.0**20, 5
"""Largest multiple of the scenario's half-width that is tried, and widths between one that is left too often and twice
that, which is not."""

_BEYOND = 20
"""Laps, at least, that are expected beyond the quantile."""

_RANGE, _STEPS = 16.0, 7
"""The speed is searched for between its value divided and multiplied by this, in so many bisections."""

_TRACKS_WITHOUT = ("paper", CSV, PATH)
"""Tracks that have speeds of their own, or a path that comes later."""


@dataclass(frozen=True)
class Kept:
    """What a lap keeps with a confidence, under the scenario's link."""

    confidence: float
    width: Estimate
    """Half-width of the narrowest corridor [m], of the same shape as the scenario's."""
    speed: float | None
    """Largest speed [m/s] at which a lap keeps the scenario's corridor; None: `speed_reason` says why."""
    speed_reason: str
    laps: int | None
    """How many were simulated; None: it was found by importance splitting."""

    def rows(self) -> list[tuple[str, str]]:
        """Name and value of each figure, in plain text."""
        of_laps = f"{100.0 * self.confidence:g} % of all laps"
        width = f"{metres(self.width.value)} ({metres(self.width.low)} .. {metres(self.width.high)})"
        speed = (
            self.speed_reason if self.speed is None else f"{self.speed:.3g} m/s, with which {of_laps} keep the corridor"
        )
        return [("Narrowest corridor", f"{width}, which {of_laps} keep"), ("Largest speed", speed)]

    def to_json(self) -> dict[str, Any]:
        """The figures by name; SI units."""
        ends = (self.width.low, self.width.high)
        return {
            "confidence": self.confidence,
            "narrowest_half_width": finite(self.width.value),
            "narrowest_half_width_interval": [finite(end) for end in ends],
            "largest_speed": self.speed,
            "largest_speed_reason": self.speed_reason or None,
            "laps": self.laps,
        }


def kept_with_confidence(
    scenario: Scenario, confidence: float, laps: int | None = None, progress: Callable[[str], None] = lambda what: None
) -> Kept:
    """Of a scenario with a corridor. Raises UserError for one without, or for a confidence that laps cannot show."""
    widths = widths_of(scenario.error_detector)
    if widths is None:
        raise UserError("--confidence needs a corridor: give --corridor, or set error_detector.corridor")
    if not 0.0 < confidence <= _MOST_OF_ALL:
        raise UserError(f"--confidence must be above 0 and at most 1 - 1e-12, got {confidence!r}")
    if confidence > MOST:
        return _by_splitting(scenario, widths, confidence, progress)
    laps = laps or max(LAPS, math.ceil(_BEYOND / (1.0 - confidence)))
    progress("the narrowest corridor")
    found = quantile(_shares(scenario, laps), confidence)
    width = Estimate(*(value * widths.half_width for value in (found.value, found.low, found.high)))

    def keeps(faster: Scenario) -> bool:
        return quantile(_shares(faster, laps), confidence).value <= 1.0

    speed, reason = _largest_speed(scenario, keeps, progress)
    return Kept(confidence, width, speed, reason, laps)


def _by_splitting(scenario: Scenario, widths: Widths, confidence: float, progress: Callable[[str], None]) -> Kept:
    """Of a confidence beyond MOST. Raises UserError where splitting does not apply."""
    chain, rarely = chain_alone(scenario), 1.0 - confidence
    if chain is None:
        raise UserError(
            f"--confidence above {MOST:g} is found by importance splitting, which needs an uplink that is a Markov "
            "chain (bernoulli, gilbert_elliott), without delays, and no losses on the way back: this scenario's are "
            f"not; ask for {MOST:g} at most"
        )

    def left_in_a_lap(of: Scenario, factor: float = 1.0) -> Estimate:
        loop = LapLoop(of, Widths(*(factor * width for width in widths)))
        n = roughly(loop)
        if n is None:
            raise UserError(
                f"--confidence above {MOST:g} is found by splitting by the length of an outage, but no single outage "
                f"leads out of the corridor: ask for {MOST:g} at most"
            )
        rate = leaving_rate(loop, chain, n, of.relay.seed).per_slot if n >= 0 else Estimate(1.0, 1.0, 1.0)
        return Estimate(*(-math.expm1(-value * loop.steps) for value in (rate.value, rate.low, rate.high)))

    def tried(factor: float) -> Estimate:
        progress(f"how often {factor * widths.half_width:.3g} m are left")
        return left_in_a_lap(scenario, factor)

    factor = _width_left(tried, rarely)
    width = Estimate(*(value * widths.half_width for value in (factor.value, factor.low, factor.high)))
    speed, reason = _largest_speed(scenario, lambda faster: left_in_a_lap(faster).value <= rarely, progress)
    return Kept(confidence, width, speed, reason, None)


def _width_left(left: Callable[[float], Estimate], rarely: float) -> Estimate:
    """Multiple of the half-width of which the corridor is left with a probability, with its interval.

    The logarithm of the probability is interpolated between widths, and so are the ends of its interval.
    """
    wide, narrow = 1.0, 1.0
    while left(wide).value > rarely and wide < _WIDEST:
        narrow, wide = wide, 2.0 * wide
    while left(narrow).value <= rarely and narrow > 1.0 / _WIDEST:
        narrow, wide = 0.5 * narrow, narrow
    factors = np.geomspace(0.8 * narrow, 1.25 * wide, _WIDTHS)
    found = [left(factor) for factor in factors.tolist()]

    def crossed(ends: list[float]) -> float:
        logarithms = np.minimum.accumulate(np.log(np.maximum(ends, 1e-300)))
        return float(np.interp(-math.log(rarely), -logarithms, factors))

    value, low, high = (crossed([getattr(one, end) for one in found]) for end in ("value", "low", "high"))
    return Estimate.about(value, low, high)


def quantile(values: Floats, share: float) -> Estimate:
    """Quantile of a distribution by values drawn from it, shape (N,); its 95 % interval is that of order statistics."""
    ordered, count = np.sort(values), len(values)
    log_share, log_rest = math.log(share), math.log1p(-share)
    ways = np.array(
        [math.lgamma(count + 1) - math.lgamma(k + 1) - math.lgamma(count - k + 1) for k in range(count + 1)]
    )
    k = np.arange(count + 1)
    at_most = np.cumsum(np.exp(ways + k * log_share + (count - k) * log_rest))
    low, high = int(np.searchsorted(at_most, 0.025)), int(np.searchsorted(at_most, 0.975))
    value = ordered[min(count - 1, math.ceil(share * count) - 1)]
    above = ordered[high] if high < count else math.inf
    return Estimate.about(float(value), float(ordered[low - 1]) if low > 0 else 0.0, float(above))


def _shares(scenario: Scenario, laps: int) -> Floats:
    """Largest share of its corridor that each lap of a scenario uses, shape (laps,)."""
    widths = widths_of(scenario.error_detector)
    assert widths is not None
    return leaving(LapLoop(scenario, widths), None, laps).largest


def _largest_speed(
    scenario: Scenario, keeps_corridor: Callable[[Scenario], bool], progress: Callable[[str], None]
) -> tuple[float | None, str]:
    """The largest speed at which laps keep the corridor, or why there is none."""
    detector = scenario.error_detector
    if detector.track in _TRACKS_WITHOUT:
        return None, f"the track {detector.track} has speeds of its own, error_detector.speed does not change them"

    def keeps(speed: float) -> bool:
        progress(f"laps at {speed:.3g} m/s")
        return keeps_corridor(replace(scenario, error_detector=replace(detector, speed=speed)))

    slow, fast = detector.speed / _RANGE, min(detector.speed * _RANGE, 100.0)
    if keeps(fast):
        return None, f"it is kept at {fast:.3g} m/s, too, the fastest that was tried"
    if not keeps(slow):
        return None, f"it is not even kept at {slow:.3g} m/s"
    for _ in range(_STEPS):
        middle = math.sqrt(slow * fast)
        slow, fast = (middle, fast) if keeps(middle) else (slow, middle)
    return slow, ""
