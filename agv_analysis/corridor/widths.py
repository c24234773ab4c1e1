"""A corridor about the reference, and how much of its width a deviation uses."""

from __future__ import annotations

import math
from typing import NamedTuple

from agv_cloud.parameters import ErrorDetectorParameters
from agv_cloud.reference.point import ReferencePoint
from agv_cloud.tracking_error import tracking_error
from agv_plant.vehicle.motion import Motion


class Widths(NamedTuple):
    """Largest deviations of the AGV from its reference posture that are allowed [m]; inf where there is no limit."""

    distance: float
    along: float
    across: float

    @property
    def half_width(self) -> float:
        """The half-width across the track, which is that in every direction if there is no other along it."""
        return min(self.distance, self.across)


def widths_of(detector: ErrorDetectorParameters) -> Widths | None:
    """The corridor of a scenario; None if it has none.

    `corridor` alone bounds the distance from the reference posture. With `corridor_along` it bounds the deviation
    across the track, and that one the deviation along it.
    """
    if detector.corridor == 0.0:
        return None
    if detector.corridor_along == 0.0:
        return Widths(detector.corridor, math.inf, math.inf)
    return Widths(math.inf, detector.corridor_along, detector.corridor)


def deviation(motion: Motion, reference: ReferencePoint) -> tuple[float, float, float]:
    """Where the AGV is, seen from its reference: along the track and across it [m], ahead and left positive; turned."""
    return tracking_error(motion.x, motion.y, motion.theta, reference.x, reference.y, reference.theta)


def share_of(along: float, across: float, widths: Widths) -> float:
    """How much of the corridor a deviation uses: above 1 it is outside, inf where it is not a number."""
    share = max(
        math.sqrt(along * along + across * across) / widths.distance,
        abs(along) / widths.along,
        abs(across) / widths.across,
    )
    return share if math.isfinite(share) else math.inf
