"""Vehicles: what an AGV makes of a command in one sampling period."""
