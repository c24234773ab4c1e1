"""Distances for people."""

from __future__ import annotations

from agv_analysis.metrics.deviation import DIVERGED

_MILLIMETRES, _SMALLEST = 1e-3, 1e-6
"""Distances [m] below which they are in mm, and below which how small they are says no more."""


DIVERGES = "diverges"
"""What is said of an AGV, a deviation or a speed that is too large for its number to say more."""


def metres(value: float) -> str:
    """A distance [m] in three digits; of one that no track is long enough for only that the AGV diverges."""
    if not value <= DIVERGED:
        return DIVERGES
    if 0.0 < value < _SMALLEST:
        return f"below {_SMALLEST / _MILLIMETRES:g} mm"
    return f"{value / _MILLIMETRES:.3g} mm" if 0.0 < value < _MILLIMETRES else f"{three_digits(value)} m"


def at_most(value: float) -> str:
    """A largest distance [m], as `metres`."""
    return metres(value) if value < _SMALLEST or not value <= DIVERGED else f"at most {metres(value)}"


def speed_text(value: float) -> str:
    """A speed [m/s] in three digits; of one that no AGV drives only that it diverges."""
    return f"{three_digits(value)} m/s" if abs(value) <= DIVERGED else DIVERGES


def three_digits(value: float) -> str:
    """A number in three digits, never with an exponent for being large."""
    shown = f"{value:.3g}"
    return shown if abs(value) < 1.0 else f"{float(shown):.15g}"
