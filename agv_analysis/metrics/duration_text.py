"""Durations for people."""

from __future__ import annotations

import math

from agv_analysis.metrics.distance_text import three_digits

_UNITS = ((3.156e7, "years"), (86400.0, "days"), (3600.0, "h"), (60.0, "min"))


def duration_text(seconds: float, like: float | None = None) -> str:
    """A duration [s] in the largest unit of which it is two at least, or of which `like` is, with three digits."""
    if math.isinf(seconds):
        return "any time"
    size, unit = next((one for one in _UNITS if (seconds if like is None else like) >= 2.0 * one[0]), (1.0, "s"))
    return f"{three_digits(seconds / size)} {unit}"


def outage_text(seconds: float) -> str:
    """How long an outage lasts, or how old a pose is [s]: in ms, if it is long in s."""
    return f"{1e3 * seconds:.4g} ms" if seconds < 2.0 else f"{seconds:.4g} s"
