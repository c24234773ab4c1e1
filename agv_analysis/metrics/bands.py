"""The bands of the convergence metrics, which a recorded run and a simulated batch share."""

from __future__ import annotations

TOLERANCE = 0.01
"""Absolute band of settling: 1 cm; 0.01 rad for an angle."""

SHARE = 0.02
"""Relative band of settling: 2 % of the initial error, or of the largest deviation of a command."""

NEGLIGIBLE = 1e-9
"""An initial error up to this size [m, rad] is rounding, of which no share is taken."""

CRITICAL_TIME = 0.25
"""Longest settling [s] of a critically damped command after its last saturated sample."""

FORGOTTEN = 0.01
"""The initial error is forgotten when what is left of it stays below this share of its narrower band of settling."""

FORGOTTEN_STEPS = 40
"""For so many steps it has to stay there: in an outage two AGVs may pass each other without having come together."""


def forgotten_below(initial: float) -> float:
    """What may be left [m, m, rad] of an initial error [m] that is forgotten."""
    return FORGOTTEN * min(TOLERANCE, SHARE * initial) if initial > NEGLIGIBLE else FORGOTTEN * TOLERANCE
