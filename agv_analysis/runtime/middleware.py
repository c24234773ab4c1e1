"""Which ROS and which middleware this process has."""

from __future__ import annotations

import os
from importlib import metadata

from rclpy.utilities import get_rmw_implementation_identifier


def middleware() -> dict[str, str]:
    """Distribution, version of rclpy, where it is from, and the middleware that its nodes talk by.

    Raises ImportError where there is no ROS, or none whose middleware can be loaded.
    """
    import rclpy

    try:
        version = metadata.version("rclpy")
    except metadata.PackageNotFoundError:
        version = "unknown"
    return {
        "distribution": os.environ.get("ROS_DISTRO", "") or "none sourced",
        "rclpy": version,
        "path": str(rclpy.__path__[0]),
        "middleware": get_rmw_implementation_identifier(),
    }
