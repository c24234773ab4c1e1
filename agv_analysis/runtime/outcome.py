"""How a run on ROS 2 ended."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

Progress = Callable[[int], None]
"""Called with the number of steps done, every now and then."""


@dataclass(frozen=True)
class Outcome:
    """How a run ended."""

    steps: int
    rate: float
    """Steps per second of wall time, without start-up and shut-down; 0 if there were too few to tell."""
    failure: str
    """Why the run ended early, empty if it did not."""
    recording: str
    """What the recorder says of the bag, empty without one."""
    recording_failure: str
    """Why the bag is not complete, empty if every message that was published is in it."""
