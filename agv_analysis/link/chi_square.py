"""Upper tail of the chi-square distribution of a whole number of degrees of freedom."""

from __future__ import annotations

import math


def chi_square_tail(x: float, degrees: int) -> float:
    """P(X^2 > x): a finite sum (Abramowitz and Stegun, Handbook of Mathematical Functions, 26.4.4 and 26.4.5)."""
    if x <= 0.0:
        return 1.0
    half = 0.5 * x
    odd = degrees % 2
    powers = (0.5 * odd + i for i in range(degrees // 2))
    tail = sum(math.exp(s * math.log(half) - half - math.lgamma(s + 1.0)) for s in powers)
    return min(1.0, tail + (math.erfc(math.sqrt(half)) if odd else 0.0))
