"""A reference from a path that is given as points, as a planner gives it, and driven at a constant speed.

Theory of operation. The points are joined by straight lines, and each corner is rounded by the arc that touches both of
its lines. The arc begins half of the shorter line before the corner, at most `corner` before it: the dense points of a
planner become one curve of arcs without straight parts, and a lone corner a bend of a size that can be driven. Along
this curve the reference moves by `speed` T_s in each step. Its heading is the direction to where it is one step later,
so it obeys the plant's recursion, as every other track does, while it never leaves the path.

Only what the points say of places counts: a planner sets their orientations to whatever it likes.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from agv_cloud.reference.point import ReferencePoint
from agv_plant.vehicle.unicycle import arc_step
from agv_ros.counted import counted

Point = tuple[float, float]

_SAME_PLACE = 1e-6
"""Points nearer than this to the one before them [m], or to the line's end [steps], are the same."""


class PathError(ValueError):
    """A path that cannot be driven; the text says why."""


class _Piece(NamedTuple):
    """A line or an arc: where it begins by arc length `s` [m], and its curvature [1/m]."""

    s: float
    x: float
    y: float
    theta: float
    curvature: float


class Curve:
    """The points joined by lines and arcs, by arc length. Raises PathError for fewer than two distinct points."""

    def __init__(self, points: Sequence[Point], corner: float) -> None:
        bad = next((point for point in points if not math.isfinite(point[0] + point[1])), None)
        if bad is not None:
            raise PathError(f"its point ({bad[0]}, {bad[1]}) is not finite")
        corners = _distinct(points)
        if len(corners) < 2:
            raise PathError(
                f"it has {counted(len(points), 'point')}, of which {counted(len(corners), 'is', 'are')} distinct: "
                "2 are needed for a path"
            )
        self._pieces: list[_Piece] = []
        self.length = 0.0
        """Of the whole curve [m]."""
        for piece, length in _pieces(corners, corner):
            self._pieces.append(_Piece(self.length, *piece))
            self.length += length
        if not math.isfinite(self.length):
            raise PathError("its length is not finite")
        self._begins = [piece.s for piece in self._pieces]

    def at(self, s: float) -> tuple[float, float, float]:
        """x, y [m] and the direction of the curve [rad] at arc length 0 <= `s` <= `length` [m]."""
        piece = self._pieces[bisect.bisect_right(self._begins, s) - 1]
        return arc_step(piece.x, piece.y, piece.theta, 1.0, piece.curvature, s - piece.s)


def _distinct(points: Sequence[Point]) -> list[Point]:
    """The points without those that repeat the one before."""
    found = list(points[:1])
    for point in points[1:]:
        if math.dist(found[-1], point) > _SAME_PLACE:
            found.append(point)
    return found


def _pieces(points: Sequence[Point], corner: float) -> Iterator[tuple[tuple[float, float, float, float], float]]:
    """Lines and arcs in order: x, y, heading and curvature at their beginning, and their length [m]."""
    lengths = [math.dist(a, b) for a, b in itertools.pairwise(points)]
    headings = [math.atan2(b[1] - a[1], b[0] - a[0]) for a, b in itertools.pairwise(points)]
    cut = 0.0
    for i, ((x, y), length, heading) in enumerate(zip(points, lengths, headings, strict=False)):
        cos, sin = math.cos(heading), math.sin(heading)
        is_last = i + 1 == len(lengths)
        next_cut = 0.0 if is_last else min(0.5 * length, 0.5 * lengths[i + 1], corner)
        straight = length - cut - next_cut
        if straight > 0.0:
            yield (x + cut * cos, y + cut * sin, heading, 0.0), straight
        cut = next_cut
        if not is_last:
            # The circle that touches both lines at the distance `cut` has the radius cut / tan(half). Where the path
            # turns back there is none: the reference turns in place.
            half = 0.5 * math.remainder(headings[i + 1] - heading, math.tau)
            arc = 2.0 * cut * (half / math.tan(half) if half else 1.0)
            if arc > _SAME_PLACE:
                before = length - cut
                yield (x + before * cos, y + before * sin, heading, 2.0 * half / arc), arc


class PathTrack:
    """A path driven from its beginning to its end, where the reference stands still: its points by step."""

    def __init__(self, curve: Curve, speed: float, ts: float) -> None:
        self.curve = curve
        self._advance = speed * ts
        self._ts = ts
        self.steps = max(1, math.ceil(curve.length / self._advance - _SAME_PLACE))
        """Number of steps until it stands."""

    def __getitem__(self, step: int) -> ReferencePoint:
        """The reference `step` >= 0 steps after its beginning."""
        if step >= self.steps:
            x, y, _ = self.curve.at(self.curve.length)
            return ReferencePoint(x, y, self._move(self.steps - 1)[0], 0.0, 0.0)
        x, y, _ = self.curve.at(step * self._advance)
        heading, distance = self._move(step)
        turn = math.remainder(self._move(min(step + 1, self.steps - 1))[0] - heading, math.tau)
        return ReferencePoint(x, y, heading, distance / self._ts, turn / self._ts)

    def _move(self, step: int) -> tuple[float, float]:
        """Direction [rad] and distance [m] from one step to the next."""
        x, y, theta = self.curve.at(step * self._advance)
        end = self.curve.length if step + 1 == self.steps else (step + 1) * self._advance
        to_x, to_y, _ = self.curve.at(end)
        distance = math.hypot(to_x - x, to_y - y)
        return (math.atan2(to_y - y, to_x - x) if distance else theta), distance
