"""Confidence intervals of probabilities."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

CONFIDENCE = 0.95


def clopper_pearson(hits: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Exact confidence interval of a probability after `hits` in `trials`.

    Its ends are the probabilities under which as many hits, or as few, have probability (1 - confidence) / 2. Source:
    Clopper and Pearson, Biometrika 26, 1934.
    """
    rest = (1.0 - confidence) / 2.0
    low = 0.0 if hits == 0 else _crossing(lambda p: 1.0 - _at_most(hits - 1, trials, p) - rest)
    high = 1.0 if hits == trials else _crossing(lambda p: rest - _at_most(hits, trials, p))
    return low, high


def percent(probability: float) -> str:
    """A probability in three digits, never rounded to certainty."""
    if 0.999 < probability < 1.0:
        return "above 99.9 %"
    return "below 0.1 %" if 0.0 < probability < 0.001 else f"{100.0 * probability:.3g} %"


def percent_after_of(probability: float) -> str:
    """The same, as it stands behind "a probability": `of 95.7 %`, `above 99.9 %`."""
    return _after_of(percent(probability))


def computed(probability: float) -> str:
    """A probability that was computed and is neither 0 nor 1, although floats may round it there.

    Of a rare event not in per cent, and not more exactly than its model can be.
    """
    if probability < _RAREST:
        return f"below {_RAREST:g}"
    return f"{probability:.2g}" if probability < 0.001 else percent(min(probability, math.nextafter(1.0, 0.0)))


def computed_after_of(probability: float) -> str:
    """The same, as it stands behind "a probability"."""
    return _after_of(computed(probability))


def _after_of(shown: str) -> str:
    return shown if shown[0].isalpha() else f"of {shown}"


_RAREST = 1e-12
"""No channel's parameters are known so well that a smaller probability could be told from another."""


def _at_most(hits: int, trials: int, p: float) -> float:
    """P(X <= hits) for X binomial, 0 < p < 1."""
    k = np.arange(hits + 1)
    ways = np.cumsum(np.log(np.concatenate(([1.0], (trials - k[:-1]) / k[1:]))))
    return min(1.0, float(np.exp(ways + k * math.log(p) + (trials - k) * math.log1p(-p)).sum()))


def _crossing(rising: Callable[[float], float]) -> float:
    """Zero of a rising function on (0, 1), by bisection to the last bit."""
    low, high = 0.0, 1.0
    while True:
        middle = 0.5 * (low + high)
        if middle in (low, high):
            return middle
        low, high = (middle, high) if rising(middle) < 0.0 else (low, middle)
