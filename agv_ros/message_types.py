"""Names of the message types that a topic may have, as parameters choose them."""

from __future__ import annotations

POSE, ODOMETRY = "pose", "odometry"

POSE_TYPES = (POSE, ODOMETRY)
"""geometry_msgs/PoseStamped or nav_msgs/Odometry."""

TWIST_STAMPED, TWIST = "twist_stamped", "twist"

COMMAND_TYPES = (TWIST_STAMPED, TWIST)
"""geometry_msgs/TwistStamped or geometry_msgs/Twist."""
