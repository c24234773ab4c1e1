"""Values as JSON can hold them."""

from __future__ import annotations

import math


def finite(value: float | None) -> float | None:
    """A number; None, JSON's null, for one that is infinite or NaN, since JSON has neither, and for none."""
    return value if value is not None and math.isfinite(value) else None
