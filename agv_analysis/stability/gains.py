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
from dataclasses import dataclass

import numpy as np

from agv_analysis.link.markov_channel import Chain
from agv_analysis.stability.almost_sure import mean_log
from agv_analysis.stability.criteria.criterion import growth_text
from agv_analysis.stability.joint_spectral_radius import largest_n_along
from agv_analysis.stability.mean_square import along_spectral_radius
from agv_ros.counted import counted

TOLERANCE = 0.1
"""Relative tolerance of a gain that is meant to be best almost surely."""

RARE = 0.05
"""Probability of a longer outage in a run at which the longest that a gain is to survive is chosen."""

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
        return float(probabilities @ mean_log(math.exp(log_a), lengths, tolerance)) / mean

    # Each burst length has a dip of its own, as wide as the tolerance: the grid is finer than that.
    grid = np.arange(math.log(0.1 / weighted), math.log(2.0) + tolerance, tolerance / 4.0)
    nearest = float(grid[np.argmin([rate(x) for x in grid])])
    best, found = minimum(rate, nearest - tolerance / 2.0, nearest + tolerance / 2.0)
    return math.exp(best), found


@dataclass(frozen=True)
class GainChoice:
    """A gain that is best by one objective, and what it costs under the others, along a straight track."""

    kx: float | None
    """[1/s]; None where the objective has no answer."""
    reason: str = ""
    """Why there is none, or what must be known of it."""
    growth: float = math.nan
    """Growth (logarithm, per step) of E[e^2] under the channel."""
    survives: int = -1
    """Longest outages [slots] that it survives in any order, -1: not even none."""

    @property
    def is_usable(self) -> bool:
        """Does the mean square die out under the channel?"""
        return self.growth < 0.0

    @property
    def words(self) -> str:
        """Gain and costs in words."""
        if self.kx is None:
            return self.reason
        survives = (
            "no outage" if self.survives < 1 else f"outages of up to {self.survives} slot{'s' * (self.survives > 1)}"
        )
        costs = f"{growth_text(self.growth)}; survives {survives}"
        refused = "" if self.is_usable else "not recommended: "
        return f"{self.kx:.4g} 1/s ({refused}{f'{self.reason}; ' if self.reason else ''}{costs})"

    def to_json(self) -> dict[str, float | int | bool | None]:
        """The costs by name."""
        found = self.kx is not None
        return {
            "mean_square_growth": self.growth if math.isfinite(self.growth) else None,
            "mean_square_stable": self.is_usable if found else None,
            "survives_outages_of": self.survives if found else None,
            "recommended": found and self.is_usable,
        }


def longest_expected_outage(chain: Chain, slots: int) -> int | None:
    """Outage [slots] that is exceeded in `slots` slots with a probability of at most RARE or so; 0 without losses.

    By the expected number of longer ones. None if it is over a million.
    """
    lengths = chain.burst_lengths()
    receptions = slots / float(lengths @ np.arange(1, len(lengths) + 1))
    longer = receptions * (np.append(np.cumsum(lengths[::-1])[::-1], 0.0))  # of L >= 1, 2, ...
    rare = np.flatnonzero(longer <= RARE)
    return None if len(lengths) >= 1_000_000 or not len(rare) else int(rare[0]) - 1


def best_kx(chain: Chain, advance: float, slots: int) -> dict[str, GainChoice]:
    """Best K_x by objective under a channel, and what each costs.

    `advance` [s] is how far a commanded speed of 1 m/s moves the AGV along the track in a step: T_s if it is obeyed.
    Delay: of the mean outage, rounded up. Bursts: of the longest outage to be expected in `slots` slots.
    """
    mean, longest = math.ceil(chain.mean_burst - 1e-9), longest_expected_outage(chain, slots)
    nothing = "no answer: the scenario's uplink loses nothing, so no outage is to be survived"

    def choice(a: float, reason: str = "") -> GainChoice:
        survives = largest_n_along(a)
        radius = along_spectral_radius(a, chain)
        growth = math.log(radius) if radius > 1e-12 else -math.inf  # deadbeat: rounding is left
        return GainChoice(a / advance, reason, growth, -1 if survives is None else survives)

    best = {
        "no_outages": choice(1.0, "deadbeat"),
        "delay": choice(best_for_delay(mean), f"each pose {counted(mean, 'step')} old")
        if mean
        else GainChoice(None, nothing),
        "bursts": GainChoice(None, nothing),
        "mean_square": choice(best_in_mean_square(chain)[0]),
        "almost_sure": choice(best_almost_surely(chain)[0], WHY_A_TOLERANCE),
    }
    if longest is None:
        best["bursts"] = GainChoice(None, "no answer: outages of the scenario's uplink may last over a million slots")
    elif longest > 0:
        reason = (
            f"for outages of up to {counted(longest, 'slot')}; longer ones come in less than 5 % of runs of "
            f"{counted(slots, 'slot')}"
        )
        best["bursts"] = choice(best_for_bursts(longest)[0], reason)
    return best


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
