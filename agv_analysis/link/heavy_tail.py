"""Have the outages a tail so heavy that their mean square may not exist?

The longest fifth of the outages, above a length u, is held against two tails: exponential, which has all moments, and
Pareto's, P(x) ~ x^-alpha, which has a second moment only if alpha > 2 (Hill, Ann. Statist. 3, 1975). It is heavy where
Pareto's is the likelier and alpha - 2 is not positive by two standard errors; not where five outages come within a
tenth of the longest, which have a largest length.
"""

from __future__ import annotations

import math

import numpy as np

from agv_analysis.link.reception_intervals import Steps

_ALIKE = 5
"""With alpha = 2 the fifth longest outage comes so close to the longest in one of 1000 recordings."""

_LEAST = 20
"""Fewest outages of which a tail can be told."""


def tail_is_heavy(outages: Steps) -> bool:
    """May outages of these lengths [slots] have no second moment?"""
    if len(outages) < _LEAST:
        return False
    count = max(10, len(outages) // 5)
    ordered = np.sort(outages).astype(np.float64)
    if ordered[-_ALIKE] >= 0.9 * ordered[-1]:
        return False
    # Lengths are whole numbers, each standing for what rounds to it.
    u, tail = ordered[-count - 1] - 0.5, ordered[-count:]
    excess, log_excess = float((tail - u).mean()), float(np.log(tail / u).mean())
    exponential = -count * (math.log(excess) + 1.0)
    pareto = -count * (math.log(log_excess) + 1.0) - float(np.log(tail).sum())
    alpha = 1.0 / log_excess
    return pareto > exponential and alpha - 2.0 * alpha / math.sqrt(count) <= 2.0
