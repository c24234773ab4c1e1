"""From a recorded bag to a run: recordings of this loop, and those of other robots."""
