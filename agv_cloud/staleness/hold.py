"""The paper's staleness policy: the outdated pose is taken for the current one."""

from __future__ import annotations

from agv_cloud.reference.point import ReferencePoint
from agv_ros.pose import Pose


def hold(held: Pose, target: Pose, reference: ReferencePoint) -> tuple[Pose, Pose]:
    """X_r(k) against X_c(k-n) (the paper's eq. 16).

    Zero error is not an equilibrium: the AGV runs ahead by v_r n T_s.
    """
    return held, Pose(reference.x, reference.y, reference.theta)
