"""Staleness policy: the outdated pose is moved on by a model of the plant, under the commands sent since."""

from __future__ import annotations

from agv_cloud.reference.point import ReferencePoint
from agv_plant.vehicle.unicycle import integrate
from agv_ros.pose import Pose


def predict(
    held: Pose, target: Pose, reference: ReferencePoint, v: float, w: float, ts: float, arc: bool
) -> tuple[Pose, Pose]:
    """X_r(k) against the prediction of X_c(k), one step on from that of X_c(k-1) under the command (v, w) of then.

    With an exact model the loop is the one without outages, whatever n. The model is a unicycle without drive or slip;
    each command that was sent counts as obeyed, for the edge does not see what the downlink loses.
    """
    x, y, theta = integrate(arc, held.x, held.y, held.theta, v, w, ts)
    return Pose(x, y, theta), Pose(reference.x, reference.y, reference.theta)
