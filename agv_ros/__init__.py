"""ROS plumbing that the AGV's side and the edge's side share."""
