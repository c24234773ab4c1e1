"""The edge cloud: reference track, tracking error, control law."""
