"""RMS deviation near the border of stability, against importance sampling of the nonlinear loop.

There the square of the deviation has no variance: what makes its mean are outages that no run of a sensible length
shows. So the intervals between receptions are drawn from other distributions, and each run weighs as much as it is more
likely under the channel. In an excursion that begins with the k-th interval of n the drawn ones are P b^2 for the k-th
and P m^2 for those after it, with x -> m x + b along a straight track; k is drawn, too, and the weight is that of the
mixture of all k, and of no excursion at all, so that it has a bound.

Source: Veach and Guibas, Optimally Combining Sampling Techniques, SIGGRAPH 1995 (the balance heuristic).
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from agv_analysis.corridor.sampled_deviation import sampled_deviation
from agv_analysis.corridor.stationary_deviation import stationary_deviation
from agv_analysis.link.markov_channel import gilbert_elliott
from agv_analysis.run import Floats
from agv_analysis.stability.scenario_loop import lap_of
from test.agv_analysis.corridor.test_single_outage import scenario
from test.agv_analysis.corridor.test_stationary_deviation import loop_of

numba = pytest.importorskip("numba")

TS, KX, KY, KTHETA = 0.005, 25.0, 1.0, 2.0
RUNS, INTERVALS = 60_000, 100
NO_EXCURSION = 0.15
"""Share of the runs that are drawn from the channel itself."""


@numba.njit
def square_sum(lap: Floats, begin: int, lengths: NDArray[np.int64]) -> float:
    """Sum of the squared distance over the last interval of a run of Kanayama's law on Euler's unicycle."""
    n, k, found = len(lap), begin, 0.0
    x, y, theta = lap[k % n, 0], lap[k % n, 1], lap[k % n, 2]
    x_r, y_r, theta_r = x, y, theta
    for j in range(len(lengths)):
        x_h, y_h, theta_h = x, y, theta
        for _ in range(lengths[j]):
            if j == len(lengths) - 1:
                found += (x_r - x) ** 2 + (y_r - y) ** 2
            v_r, w_r = lap[k % n, 3], lap[k % n, 4]
            x_e = math.cos(theta_h) * (x_r - x_h) + math.sin(theta_h) * (y_r - y_h)
            y_e = math.cos(theta_h) * (y_r - y_h) - math.sin(theta_h) * (x_r - x_h)
            theta_e = theta_r - theta_h
            v, w = v_r * math.cos(theta_e) + KX * x_e, w_r + v_r * (KY * y_e + KTHETA * math.sin(theta_e))
            x, y, theta = x + TS * v * math.cos(theta), y + TS * v * math.sin(theta), theta + TS * w
            x_r, y_r = x_r + TS * v_r * math.cos(theta_r), y_r + TS * v_r * math.sin(theta_r)
            theta_r, k = theta_r + TS * w_r, k + 1
    return found


@numba.njit
def sampled(lap: Floats, cumulative: Floats, logs: Floats, share: Floats, found: Floats) -> None:
    """Weighed sums of many runs; rows of `cumulative` and `logs`: P, the k-th interval, later ones, the k-th and last.

    Distributions of an interval, and logarithms of their ratios to P; `share` of excursions from each k, and of none.
    """
    np.random.seed(1)
    count, upto = len(share) - 1, np.cumsum(share)
    lengths = np.empty(count, dtype=np.int64)
    for i in range(len(found)):
        first = np.searchsorted(upto, np.random.random())
        for j in range(count):
            row = 0 if j < first else (2 if j > first else (3 if j == count - 1 else 1))
            lengths[j] = np.searchsorted(cumulative[row], np.random.random()) + 1
        mixture, after = share[count], 0.0
        for k in range(count - 1, -1, -1):
            mixture += share[k] * math.exp(logs[3 if k == count - 1 else 1, lengths[k] - 1] + after)
            after += logs[2, lengths[k] - 1]
        found[i] = square_sum(lap, np.random.randint(len(lap)), lengths) / mixture


def by_importance_sampling(lap: Floats, p: float, r: float) -> tuple[float, float]:
    """RMS deviation of the loop under a Gilbert channel [m], and the half of its 95 % interval."""
    L = np.arange(1, int(-100.0 / math.log1p(-r)))
    P = np.where(L == 1, 1.0 - p, p * r * (1.0 - r) ** np.maximum(L - 2, 0))
    P /= P.sum()
    a = TS * KX
    m, b = 1.0 - a * L, a * L * (L - 1) / 2
    weights = np.stack((np.ones(len(L)), b**2 + 1e-3, m**2, np.cumsum((b - a * (L - 1)) ** 2) + 1e-3))
    means = weights @ P
    with np.errstate(divide="ignore"):
        logs = np.log(weights / means[:, None])
    share = means[2] ** np.arange(INTERVALS - 1, -1, -1.0)
    share = np.append((1.0 - NO_EXCURSION) * share / share.sum(), NO_EXCURSION)
    found = np.empty(RUNS)
    sampled(lap, np.cumsum(weights * P / means[:, None], axis=1), logs, share, found)
    square, error = found.mean() / (P @ L), found.std() / math.sqrt(RUNS) / (P @ L)
    return math.sqrt(square), 0.5 * 1.96 * error / math.sqrt(square)


@pytest.mark.parametrize(
    ("track", "r", "ratio"),
    [("line", 0.05, 1.0), ("paper", 0.1, 1.0), ("paper", 0.05, 1.085)],
    ids=["line, near the border", "oval", "oval, metres away: beyond the first order"],
)
def test_it_is_that_of_runs_that_show_the_rare_outages(track: str, r: float, ratio: float) -> None:
    lap = f"error_detector.track={track}", "error_detector.lap_time=100.0"
    chosen = scenario(*lap, "relay.uplink.p=0.02", f"relay.uplink.r={r}")
    loop = loop_of(chosen)
    expected = stationary_deviation(loop, loop.linear, gilbert_elliott(0.02, r))
    found, half = by_importance_sampling(lap_of(chosen), 0.02, r)
    assert expected.has_heavy_tail
    assert half < 0.025 * found
    assert expected.rms == pytest.approx(ratio * found, rel=0.03)
    a = loop.linear.along_gain
    assert a is not None
    sampled = sampled_deviation(loop, gilbert_elliott(0.02, r), a, expected.drift)
    assert sampled is not None
    assert sampled.low - half <= found <= sampled.high + half
    assert sampled.high - sampled.low < 0.05 * found


def test_where_outages_are_short_the_square_has_a_variance() -> None:
    chosen = scenario("relay.uplink.p=0.02", "relay.uplink.r=0.2")
    loop = loop_of(chosen)
    assert not stationary_deviation(loop, loop.linear, gilbert_elliott(0.02, 0.2)).has_heavy_tail
