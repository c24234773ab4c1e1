"""A pose in the plane, the one type for it."""

from __future__ import annotations

import math
from typing import NamedTuple


class Pose(NamedTuple):
    """X = (x, y, theta) [m, m, rad], in frame `map` unless said otherwise; theta is never wrapped: it counts turns."""

    x: float
    y: float
    theta: float


class Direction(NamedTuple):
    """The direction of a heading: its cosine and sine."""

    cos: float
    sin: float


def direction_of(theta: float) -> Direction:
    """Of a heading [rad]."""
    return Direction(math.cos(theta), math.sin(theta))
