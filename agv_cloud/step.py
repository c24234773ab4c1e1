"""A step that the edge takes: its number, and the pose that it uses."""

from __future__ import annotations

from typing import NamedTuple

from agv_ros.messages import StampedPose


class EdgeStep(NamedTuple):
    """Step k, compared with a pose that was taken at step `taken` <= k."""

    k: int
    taken: int
    pose: StampedPose
