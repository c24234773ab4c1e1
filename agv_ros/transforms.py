"""Where the loop's frames are, on /tf: for RViz and other users of tf2; not part of the loop.

tf2_msgs belongs to ROS and is in no wheel, so it may be absent; then nothing is sent.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from agv_ros.codec import encode_transform
from agv_ros.messages import StampedPose

if TYPE_CHECKING:
    from agv_ros.node import LoopNode

TOPIC = "/tf"
"""One for all AGVs, as tf2's listeners expect it; a frame's prefix tells them apart."""

_DEPTH = 100
"""Messages that are kept for a slow listener, as tf2_ros keeps them."""


class TransformBroadcaster:
    """Sends the pose of one frame in frame `map`, as long as there is a subscriber."""

    def __init__(self, node: LoopNode[Any], frame: str) -> None:
        self._frame = node.settings.frame_prefix + frame
        kind = _message_type()
        self._publisher: Any = None if kind is None else node.create_publisher(kind, TOPIC, _DEPTH)

    @property
    def available(self) -> bool:
        """Is tf2_msgs installed?"""
        return self._publisher is not None

    def send(self, pose: StampedPose) -> None:
        """The frame is there at the pose's stamp."""
        if self._publisher is not None and self._publisher.get_subscription_count():
            self._publisher.publish(encode_transform(pose, self._frame))


def _message_type() -> Any:
    """tf2_msgs/TFMessage, None where it is not installed."""
    try:
        return importlib.import_module("tf2_msgs.msg").TFMessage
    except ImportError:
        return None
