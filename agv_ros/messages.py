"""The loop's messages as plain values, and the words in them; `codec` puts them on the wire.

Instants are stamps [ns]; SI units, REP 103: x ahead, y to the left, yaw about +z.
"""

from __future__ import annotations

import math
from typing import NamedTuple

FRAME_MAP = "map"
FRAME_AGV = "base_link"
FRAME_REFERENCE = "reference"

DELIVERED = "delivered"
LOST = "lost"
DELAYED = "delayed"
"""What a slot says of its message; a delayed one comes in a later slot."""

CHANGED = "changed "
"""Key, before a parameter's name, under which a node's diagnostics say how it was changed last while the node ran."""

PUBLISHED = "published "
"""Key, before the topic's name, under which a node's diagnostics say how many messages it has published there."""

SQUARED_LENGTH = 0.01
"""How far the squared length of a rotation's quaternion may be from one."""


class InvalidMessageError(ValueError):
    """A message that must not enter the loop; the text says what is wrong with it."""


class StampedPose(NamedTuple):
    """geometry_msgs/PoseStamped: X_c at an instant; x, y [m], theta [rad] in frame `map`."""

    stamp_ns: int
    x: float
    y: float
    theta: float


class Command(NamedTuple):
    """geometry_msgs/TwistStamped: u at an instant; v [m/s], w [rad/s] in frame `base_link`."""

    stamp_ns: int
    v: float
    w: float


class TrackingError(NamedTuple):
    """nav_msgs/Odometry: the reference seen from the AGV; x_e, y_e [m], theta_e [rad], v_r [m/s], w_r [rad/s]."""

    stamp_ns: int
    x_e: float
    y_e: float
    theta_e: float
    v_r: float
    w_r: float


class Slot(NamedTuple):
    """sensor_msgs/TimeReference: the channel's outcome on one slot and the freshest stamp held behind it (0: none)."""

    stamp_ns: int
    freshest_ns: int
    outcome: str
    note: str = ""
    """More of the outcome, as in `cause=rayleigh run=3 gain=-23.81`: words `name=value` with a blank between them."""


def facts_in(note: str) -> dict[str, str]:
    """What a slot's note says, by name; words of another form are passed over."""
    return dict(word.split("=", 1) for word in note.split() if "=" in word)


def quaternion_of_yaw(theta: float) -> tuple[float, float]:
    """Components (z, w) of the unit quaternion that turns by `theta` [rad] about +z."""
    return math.sin(0.5 * theta), math.cos(0.5 * theta)


def yaw_of_quaternion(x: float, y: float, z: float, w: float) -> float:
    """Yaw [rad] in (-pi, pi] of a quaternion, which need not have length one exactly."""
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
