"""Independent losses."""

from __future__ import annotations


def bernoulli(u: float, p: float) -> bool:
    """Lost with probability `p`, given `u` uniform in [0, 1).

    Loss rate p; an outage lasts l slots with probability p^(l-1) (1 - p), so 1 / (1 - p) on average.
    """
    return u < p
