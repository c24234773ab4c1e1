"""Steps of stamps that scatter by so much that single gaps do not tell how many periods they are.

Theory of operation. Stamp i of M is s_i = t_0 + T (i + e_i) + noise, where e_i counts the messages missing before it,
which never becomes less. Rounding gaps one by one makes two losses' worth of error of each stamp that is half a period
off. But a loss shifts all stamps behind it, and noise only one: so the sequence e is sought that fits best as a whole,
by dynamic programming over the few values that are possible at each stamp (Viterbi 1967). Each path follows the phase
t_0, for the period is only known to some digits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import compiled, numbers
from agv_analysis.recordings.messages_on_steps import Steps
from agv_analysis.run import Floats

_WIDTH = 5
"""Values of e that are followed at each stamp."""

_LOSS = 5.0
"""Cost of missing messages, as the logarithm of how much rarer they are than none."""

_FURTHER = 0.3
"""The same of each further one in a row."""

_GAIN = 0.02
"""Share of a stamp's deviation by which the phase follows it."""

_LEAST_SCATTER = 0.02
"""Periods."""


def refined_period(stamps: Steps, period: float) -> float:
    """The period [ns] from one that is nearly right, by ever longer distances, in which jitter counts ever less."""
    lag = 1
    while (lag := lag * 4) < len(stamps) // 4:
        distances = (stamps[lag:] - stamps[:-lag]).astype(np.float64)
        period = float(np.median(distances / np.maximum(1.0, np.rint(distances / period))))
    return period


def jittered_steps(stamps: Steps, period: float) -> Steps:
    """Step of each of the stamps [ns], shape (M,), that increase; 0 for the first."""
    period = refined_period(stamps, period)
    gaps = np.diff(stamps) / period
    scatter = float(np.median(np.abs(gaps - np.rint(gaps)))) * 1.4826 / np.sqrt(2.0)
    offsets = (stamps - stamps[0]) / period - np.arange(len(stamps))
    missing = np.asarray(compiled(most_likely)(numbers(offsets), max(scatter, _LEAST_SCATTER)), dtype=np.int64)
    steps: Steps = np.arange(len(stamps)) + missing - missing[0]
    return steps


def most_likely(offsets: Floats, scatter: float) -> NDArray[np.int64]:
    """Messages missing before each stamp, from the stamps' offsets [periods] if none were, shape (M,)."""
    count = len(offsets)
    before = np.zeros((count, _WIDTH), dtype=np.int64)
    lowest = np.zeros(count, dtype=np.int64)
    cost, phase = np.full(_WIDTH, np.inf), np.zeros(_WIDTH)
    cost[0] = 0.0
    best = 0
    for i in range(1, count):
        gain = max(_GAIN, 1.0 / (i + 1.0))
        centre = int(np.rint(offsets[i] - phase[best]))
        low = max(lowest[i - 1], centre - 2)
        lowest[i] = low
        now, follows = np.full(_WIDTH, np.inf), np.zeros(_WIDTH)
        for j in range(_WIDTH):
            for h in range(_WIDTH):
                lost = low + j - lowest[i - 1] - h
                if lost < 0 or cost[h] == np.inf:
                    continue
                deviation = offsets[i] - phase[h] - (low + j)
                total = cost[h] + 0.5 * (deviation / scatter) ** 2 + (_LOSS + _FURTHER * (lost - 1) if lost else 0.0)
                if total < now[j]:
                    now[j], before[i, j], follows[j] = total, h, phase[h] + gain * deviation
        best = int(np.argmin(now))
        cost, phase = now - now[best], follows
    found = np.zeros(count, dtype=np.int64)
    for i in range(count - 1, -1, -1):
        found[i] = lowest[i] + best
        best = before[i, best]
    return found
