"""The best gain K_x, by what one wants of it: the error along a straight track, which K_x alone governs.

With a = T_s K_x, K_x times true over commanded speed, the objectives are rates per step, the smaller the better:

    no outages        |1 - a|                          a = 1: deadbeat
    delay             largest root of z^n (z - 1) + a  a = n^n / (n+1)^(n+1): the two largest roots meet
    bursts            max over L <= n + 1 of |1 - a L|^(1/L)
    mean_square       spectral radius of the second moments under a channel
    almost_sure       E[log|1 - a L|] / E[L] under a channel, averaged over gains within a tenth of a

The last has no best gain without the average: at a = 1/L for any burst length L that occurs the exponent is -inf, and
that is so at that gain alone. No plant has its gain to the last digit. The average over a tolerance is finite
everywhere, and in closed form.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.markov_channel import Chain
from agv_analysis.run import Floats
from agv_analysis.stability.mean_square import along_spectral_radius

TOLERANCE = 0.1
"""Relative tolerance of a gain that is meant to be best almost surely."""

WHY_A_TOLERANCE = (
    f"averaged over gains within {TOLERANCE:.0%}: at a gain where 1 / (T_s K_x) is an integer the exponent itself is "
    "-inf, so that it has no best gain"
)


def best_for_delay(n: int) -> float:
    """Best a for a pose that is always `n` steps old; the rate is n / (n + 1)."""
    return float(n**n / (n + 1) ** (n + 1)) if n < 100 else float(np.exp(-n * np.log1p(1.0 / n)) / (n + 1))


def best_for_bursts(n: int) -> tuple[float, float]:
    """(Best a, its rate) for the worst repeated burst of up to `n` losses."""
    lengths = np.arange(1, n + 2)
    return minimum(lambda a: float((np.abs(1.0 - a * lengths) ** (1.0 / lengths)).max()), 0.0, 2.0 / (n + 1))


def best_in_mean_square(chain: Chain) -> tuple[float, float]:
    """(Best a, its rate) under random losses: the rate is that of E[e^2], per step."""
    return minimum(lambda a: along_spectral_radius(a, chain), 0.0, 2.0)


def best_almost_surely(chain: Chain, tolerance: float = TOLERANCE) -> tuple[float, float]:
    """(Best a, its rate) for almost every run: the rate is the mean exponent over gains within `tolerance` of a."""
    probabilities = chain.burst_lengths(tail=1e-9)
    lengths = np.arange(1, len(probabilities) + 1)
    mean = float(probabilities @ lengths)
    weighted = float(probabilities @ lengths**2) / mean  # mean length of the burst that a step falls into

    def rate(log_a: float) -> float:
        return float(probabilities @ _mean_log(math.exp(log_a), lengths, tolerance)) / mean

    # Each burst length has a dip of its own, as wide as the tolerance: the grid is finer than that.
    grid = np.arange(math.log(0.1 / weighted), math.log(2.0) + tolerance, tolerance / 4.0)
    nearest = float(grid[np.argmin([rate(x) for x in grid])])
    best, found = minimum(rate, nearest - tolerance / 2.0, nearest + tolerance / 2.0)
    return math.exp(best), found


def _mean_log(a: float, lengths: NDArray[np.int64], tolerance: float) -> Floats:
    """Mean of log|1 - x L| over x within `tolerance` of a, by the antiderivative u log|u| - u of log|u|."""
    low = np.asarray(1.0 - a * (1.0 + tolerance) * lengths)
    high = np.asarray(1.0 - a * (1.0 - tolerance) * lengths)
    return np.asarray((_antiderivative(high) - _antiderivative(low)) / (high - low))


def _antiderivative(u: Floats) -> Floats:
    return np.asarray(u * np.log(np.abs(u), where=u != 0.0, out=np.zeros_like(u)) - u)


def best_kx(chain: Chain, advance: float) -> dict[str, float]:
    """Best K_x [1/s] by objective under a channel; delay and bursts for its mean burst, rounded up.

    `advance` [s] is how far a commanded speed of 1 m/s moves the AGV along the track in a step: T_s if it is obeyed.
    """
    n = math.ceil(chain.mean_burst - 1e-9)
    best = {
        "no_outages": 1.0,
        "delay": best_for_delay(n),
        "bursts": best_for_bursts(n)[0],
        "mean_square": best_in_mean_square(chain)[0],
        "almost_sure": best_almost_surely(chain)[0],
    }
    return {objective: a / advance for objective, a in best.items()}


def minimum(f: Callable[[float], float], low: float, high: float) -> tuple[float, float]:
    """(x, f(x)) of the smallest value on [low, high], to 1e-6 of it: a grid, then finer ones about the best."""
    reach = high - low
    for _ in range(5):
        grid = np.linspace(low, high, 81)
        values = [f(float(x)) for x in grid]
        best = int(np.argmin(values))
        low, high = float(grid[max(0, best - 1)]), float(grid[min(80, best + 1)])
        if high - low < 1e-6 * reach:
            break
    return float(grid[best]), values[best]
