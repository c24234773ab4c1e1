"""The reference as a path to look at: one lap or a whole path, thinned, as a latched message for RViz and its like."""

from __future__ import annotations

from agv_cloud.parameters import ErrorDetectorParameters
from agv_cloud.reference.path_track import PathTrack
from agv_cloud.reference.point import ReferencePoint
from agv_cloud.reference.reference import Reference, lap_steps

LONGEST = 50_000
"""Steps that are looked at, at most: a node should not take long to come up."""

MOST_POINTS = 500


def path_points(reference: Reference, parameters: ErrorDetectorParameters) -> list[ReferencePoint]:
    """One lap of the reference, evenly thinned to 500 points, with its first and its last step.

    Of a lap of more than 50 000 steps, and of a track from a file beyond `lap_time`, only the beginning.
    """
    return thinned(reference, min(lap_steps(parameters), LONGEST))


def thinned(reference: Reference | PathTrack, last: int) -> list[ReferencePoint]:
    """At most 500 points, evenly spaced, from step 0 to step `last`, and that one."""
    stride = -(-last // (MOST_POINTS - 1))
    return [reference[k] for k in (*range(0, last, stride), last)]
