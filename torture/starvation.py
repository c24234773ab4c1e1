"""How long processes were ready to run and had no processor: time of a busy machine, not of the program's.

Linux counts it for each thread (`/proc/<pid>/task/<tid>/schedstat`, nanoseconds on a run queue), so that it is measured
where it happens. A program that waits, sleeps or computes for too long gains nothing by it.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Iterable
from pathlib import Path

_PERIOD = 0.05
"""How often [s] it is looked, at most."""

_KEPT = round(10.0 / _PERIOD)


class Starvation:
    """Watches processes: in each span of time the thread counts that waited longest for a processor."""

    def __init__(self, pids: Iterable[int]) -> None:
        self._pids = tuple(pids)
        self._waited = self._read()
        self._at = time.monotonic()
        self.seconds = 0.0
        """For how long so far one of them at least had to wait; at most what has passed."""
        self._spans: deque[tuple[float, float]] = deque(maxlen=_KEPT)

    def look(self) -> None:
        """Add what they have waited since the last look; to be called again and again."""
        now = time.monotonic()
        if now - self._at < _PERIOD:
            return
        waited = self._read()
        # All that a thread has waited which was not there at the last look, it has waited since.
        longest = max((ns - self._waited.get(thread, 0) for thread, ns in waited.items()), default=0)
        spent = min(longest / 1e9, now - self._at)
        self.seconds += spent
        self._spans.append((now, spent))
        self._waited, self._at = waited, now

    def in_the_last(self, seconds: float) -> float:
        """The same of the last `seconds` before now; of 10 s at most."""
        since = time.monotonic() - seconds
        return sum(spent for at, spent in self._spans if at > since)

    def _read(self) -> dict[str, int]:
        """Nanoseconds on a run queue by thread; none of processes that have ended."""
        found: dict[str, int] = {}
        for pid in self._pids:
            with contextlib.suppress(OSError):
                for thread in Path(f"/proc/{pid}/task").iterdir():
                    found[thread.name] = int((thread / "schedstat").read_text().split()[1])
        return found
