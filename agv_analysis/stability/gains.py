"""The best gain K_x, by what one wants of it: the error along a straight track, which K_x alone governs.

With a = T_s K_x the objectives are rates per step, the smaller the better:

    no outages        |1 - a|                          a = 1: deadbeat
    delay             largest root of z^n (z - 1) + a  a = n^n / (n+1)^(n+1): the two largest roots meet
    bursts            max over L <= n + 1 of |1 - a L|^(1/L)
    mean_square       spectral radius of the second moments under a channel
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from agv_analysis.stability.chain import Chain
from agv_analysis.stability.mean_square import along_spectral_radius


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


def best_kx(chain: Chain, ts: float) -> dict[str, float]:
    """Best K_x [1/s] by objective under a channel; delay and bursts for its mean burst, rounded up."""
    n = math.ceil(chain.mean_burst - 1e-9)
    best = {
        "no_outages": 1.0,
        "delay": best_for_delay(n),
        "bursts": best_for_bursts(n)[0],
        "mean_square": best_in_mean_square(chain)[0],
    }
    return {objective: a / ts for objective, a in best.items()}


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
