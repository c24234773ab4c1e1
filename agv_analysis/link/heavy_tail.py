"""Have the outages a tail so heavy that their mean square may not exist?

The outages above a length u are held against two tails: geometric, which has all moments, and Pareto's, x^-alpha, which
has a second moment only if alpha > 2 (Hill, Ann. Statist. 3, 1975). It is heavy where Pareto's is the likelier and
alpha - 2 is not positive by two standard errors, for all outages, their longer half or their longest fifth. Short and
long ones of two kinds look like that, too; not those of which five come within a tenth of the longest, which have a
largest length.
"""

from __future__ import annotations

import math

import numpy as np

from agv_analysis.link.reception_intervals import Steps
from agv_analysis.run import Floats

_SHARES = (1.0, 0.5, 0.2)

_ALIKE = 5
"""With alpha = 2 the fifth longest outage comes so close to the longest in one of 1000 recordings."""

_LEAST = 10
"""Fewest lengths of which a tail can be told."""


def tail_is_heavy(outages: Steps, advantage: float = 0.0) -> bool:
    """May outages of these lengths [slots] have no second moment?

    `advantage` is how much larger the log likelihood of Pareto's tail must be.
    """
    ordered = np.sort(outages).astype(np.float64)
    if len(ordered) < _LEAST or (ordered[-_ALIKE] >= 0.9 * ordered[-1] and ordered[-1] > 1.0):
        return False
    tails = [ordered[-max(_LEAST, int(share * len(ordered))) :] for share in _SHARES]
    return any(_is_heavy(tail, advantage) for tail in tails)


def _is_heavy(tail: Floats, advantage: float) -> bool:
    # Lengths are whole numbers, each standing for what rounds to it.
    u, count = tail[0] - 0.5, len(tail)
    alpha = count / float(np.log(tail / u).sum())
    ends = np.log(tail + 0.5), np.log(tail - 0.5)
    pareto = float(np.log(np.exp(-alpha * (ends[1] - math.log(u))) - np.exp(-alpha * (ends[0] - math.log(u)))).sum())
    hit = count / float((tail - tail[0] + 1.0).sum())
    geometric = count * math.log(hit) + (float((tail - tail[0]).sum()) * math.log1p(-hit) if hit < 1.0 else 0.0)
    return pareto - geometric > advantage and alpha - 2.0 * alpha / math.sqrt(count) <= 2.0
