"""Vehicles: the motion of an AGV under a command in one sampling period."""
