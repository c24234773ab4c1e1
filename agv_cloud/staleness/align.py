"""Staleness policy: the outdated pose is compared with the reference of its own instant."""

from __future__ import annotations

from agv_cloud.reference.point import ReferencePoint
from agv_ros.pose import Pose


def align(held: Pose, target: Pose, reference: ReferencePoint) -> tuple[Pose, Pose]:
    """X_r(k-n) against X_c(k-n): the bias of `hold` is gone, the stability limits are the same."""
    return held, target
