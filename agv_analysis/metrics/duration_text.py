"""Durations for people."""

from __future__ import annotations

import math

_UNITS = ((3.156e7, "years"), (86400.0, "days"), (3600.0, "h"), (60.0, "min"))


def duration_text(seconds: float) -> str:
    """A duration [s] in the largest unit of which it is two at least, with three digits."""
    if math.isinf(seconds):
        return "any time"
    return next((f"{seconds / size:.3g} {unit}" for size, unit in _UNITS if seconds >= 2.0 * size), f"{seconds:.3g} s")
