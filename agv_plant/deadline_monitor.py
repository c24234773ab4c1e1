"""Timing of a periodic loop: jitter of its period and missed deadlines."""

from __future__ import annotations

import math

import numpy as np

_WINDOW = 20_000

_DURATIONS = ("jitter p50", "jitter p99", "jitter max")
"""What of a summary is in seconds."""


class DeadlineMonitor:
    """Statistics of ticks that are due every `period_ns`, up to number `last`.

    A tick belongs to the nearest multiple of the period. Each multiple without a tick is a missed deadline. After the
    last one none is due, so a late tick at the end of a run misses no more than were left.
    """

    def __init__(self, period_ns: int, last: float = math.inf) -> None:
        self._period_ns = period_ns
        self._last = last
        self._first_ns = 0
        self._last_ns = 0
        self._due = 0
        # A ring in one piece: asked once a second, it must not take the time that it measures.
        self._jitter_ns = np.zeros(_WINDOW, dtype=np.int64)
        self._count = 0
        self.missed = 0

    def start(self, now_ns: int) -> None:
        """The instant of tick 0 on a steady clock."""
        self._first_ns = self._last_ns = now_ns

    def tick(self, now_ns: int) -> int:
        """Record a tick; returns its number."""
        nearest = (now_ns - self._first_ns + self._period_ns // 2) // self._period_ns
        number = int(min(nearest, self._last))
        if number > self._due:
            self.missed += number - self._due - 1
            self._jitter_ns[self._count % _WINDOW] = abs(now_ns - self._last_ns - self._period_ns)
            self._count += 1
            self._due, self._last_ns = number, now_ns
        return number

    def summary(self) -> dict[str, float]:
        """|period - T_s| [s] at p50, p99 and at most, over the last 20 000 ticks, and the missed deadlines."""
        jitter = self._jitter_ns[: min(self._count, _WINDOW)] * 1e-9
        p50, p99, largest = np.percentile(jitter, [50.0, 99.0, 100.0]) if len(jitter) else (0.0, 0.0, 0.0)
        return {
            **dict(zip(_DURATIONS, (float(p50), float(p99), float(largest)), strict=True)),
            "missed deadlines": float(self.missed),
        }

    def facts(self) -> dict[str, str]:
        """The same as diagnostics have it, with the unit in the name."""
        return {f"{name} [s]" if name in _DURATIONS else name: f"{value:.6g}" for name, value in self.summary().items()}
