"""Of many values the one that a share of them does not exceed."""

from __future__ import annotations

import math

import numpy as np

from agv_analysis.run import Floats

P99 = 0.99


def not_exceeded(values: Floats, share: float) -> float:
    """The smallest of some values >= 0, shape (n,), that a share of them do not exceed; inf where one is no number.

    Only those above the mean are put into order, which are few, unless the one that is looked for is below it.
    """
    mean, beyond = float(values.mean()), len(values) - math.ceil(share * len(values))
    if not math.isfinite(mean):
        return math.inf
    large = values[values > mean]
    ordered = large if len(large) > beyond else values
    return float(np.partition(ordered, len(ordered) - 1 - beyond)[len(ordered) - 1 - beyond])
