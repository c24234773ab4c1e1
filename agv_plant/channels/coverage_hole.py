"""Losses where the radio does not reach."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from agv_ros.parameters import ParameterError

Table = Sequence[Sequence[float]] | NDArray[np.float64]
"""Rows of floats, as lists or, for compiled code, as an array."""

CIRCLE = -1.0
"""In a row of `is_in_hole` at the place of a polygon's number."""

NO_HOLES = (0.0,)
"""What a list of circles or polygons is without any: ROS has no empty lists of doubles."""


def coverage_hole(u: float, is_inside: bool, p: float, hole_loss: float) -> bool:
    """Lost with probability `hole_loss` in a hole and `p` outside, given `u` uniform in [0, 1).

    Loss rate: that of each place, weighted with the time spent there; an outage lasts as long as the AGV takes to cross
    the hole.
    """
    return u < (hole_loss if is_inside else p)


def is_in_hole(x: float, y: float, holes: Table) -> bool:
    """Is a place [m] in frame `map` in any of the `holes`, rows of five numbers as `rows_of` gives them? NaN is not.

    Polygons by the even-odd rule: a ray in the direction of +x leaves through an odd number of edges.
    """
    inside, last = False, CIRCLE
    for a, b, c, d, number in holes:
        if number != last:
            if inside:
                return True
            last = number
        if number == CIRCLE:
            if math.hypot(x - a, y - b) <= c:
                return True
        elif (b > y) != (d > y) and x < a + (y - b) / (d - b) * (c - a):
            inside = not inside
    return inside


def rows_of(circles: Sequence[float], polygons: Sequence[float]) -> list[list[float]]:
    """Holes as rows (x, y, radius, 0, CIRCLE) and, edge by edge, (x_1, y_1, x_2, y_2, number of the polygon).

    `circles` are x, y, radius of one circle after the other, `polygons` x, y of the corners of one after the other,
    each of which ends with its first corner again, as rings do in GeoJSON. Raises ParameterError.
    """
    return [*_circles(circles), *_polygons(polygons)]


def _circles(numbers: Sequence[float]) -> list[list[float]]:
    if tuple(numbers) == NO_HOLES:
        return []
    if len(numbers) % 3:
        raise ParameterError(f"hole_circles must be x, y, radius of each circle, got {len(numbers)} numbers")
    found = [[*numbers[i : i + 3], 0.0, CIRCLE] for i in range(0, len(numbers), 3)]
    for x, y, radius, *_ in found:
        if not radius > 0.0:
            raise ParameterError(f"hole_circles: a radius must be > 0, got {radius!r} around ({x:g}, {y:g})")
    return found


def _polygons(numbers: Sequence[float]) -> list[list[float]]:
    if tuple(numbers) == NO_HOLES:
        return []
    if len(numbers) % 2:
        raise ParameterError(f"hole_polygons must be x, y of each corner, got {len(numbers)} numbers")
    edges: list[list[float]] = []
    ring: list[tuple[float, float]] = []
    number = 0.0
    for corner in zip(numbers[::2], numbers[1::2], strict=True):
        ring.append(corner)
        if len(ring) > 1 and corner == ring[0]:
            if len(ring) < 4:
                raise ParameterError(f"hole_polygons: one has {len(ring) - 1} corners, must be 3 at least: {ring!r}")
            edges += [[*one, *other, number] for one, other in pairwise(ring)]
            ring, number = [], number + 1.0
    if ring:
        raise ParameterError(
            f"hole_polygons: the last one does not end with its first corner ({ring[0][0]:g}, {ring[0][1]:g}): repeat "
            "it to close the polygon"
        )
    return edges
