"""How punctual a periodic loop is: jitter of its period and missed deadlines."""

from __future__ import annotations

from collections import deque

import numpy as np

_WINDOW = 100_000


class Punctuality:
    """Statistics of ticks that are due every `period_ns`.

    A tick belongs to the nearest multiple of the period. Each multiple without a tick is a missed deadline.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._first_ns = 0
        self._last_ns = 0
        self._due = 0
        self._jitter_ns: deque[int] = deque(maxlen=_WINDOW)
        self.missed = 0

    def start(self, now_ns: int) -> None:
        """The instant of tick 0 on a steady clock."""
        self._first_ns = self._last_ns = now_ns

    def tick(self, now_ns: int) -> int:
        """Record a tick; returns its number."""
        number = (now_ns - self._first_ns + self._period_ns // 2) // self._period_ns
        if number > self._due:
            self.missed += number - self._due - 1
            self._jitter_ns.append(abs(now_ns - self._last_ns - self._period_ns))
            self._due, self._last_ns = number, now_ns
        return number

    def summary(self) -> dict[str, float]:
        """|period - T_s| [s] at p50, p99 and at most, over the last 100 000 ticks, and the missed deadlines."""
        jitter = np.array(self._jitter_ns, dtype=np.float64) * 1e-9
        if not len(jitter):
            return {"jitter p50": 0.0, "jitter p99": 0.0, "jitter max": 0.0, "missed deadlines": float(self.missed)}
        p50, p99, largest = np.percentile(jitter, [50.0, 99.0, 100.0])
        return {
            "jitter p50": float(p50),
            "jitter p99": float(p99),
            "jitter max": float(largest),
            "missed deadlines": float(self.missed),
        }
