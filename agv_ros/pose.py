"""A pose in the plane, the one type for it."""

from __future__ import annotations

from typing import NamedTuple


class Pose(NamedTuple):
    """X = (x, y, theta) [m, m, rad], in frame `map` unless said otherwise; theta is never wrapped: it counts turns."""

    x: float
    y: float
    theta: float
