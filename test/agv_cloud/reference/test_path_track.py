"""Paths that are driven: against the tracks of the same geometry, the plant's own recursion, and plain geometry."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agv_cloud.parameters import ErrorDetectorParameters
from agv_cloud.reference.path_track import Curve, PathError, PathTrack
from agv_cloud.reference.reference import Reference
from agv_cloud.reference.thinned_path import MOST_POINTS, thinned
from agv_plant.vehicle.unicycle import euler_step
from agv_ros.errors import UserError

TS = 0.005

coordinates = st.floats(-100.0, 100.0).map(lambda value: round(value, 3))
points = st.lists(st.tuples(coordinates, coordinates), min_size=2, max_size=12).filter(
    lambda found: len(set(found)) > 1
)


def track_of(path: list[tuple[float, float]], speed: float = 1.0, corner: float = 0.2) -> PathTrack:
    return PathTrack(Curve(path, corner), speed, TS)


def rows(track: PathTrack, steps: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    return np.array([track[k] for k in range(steps)])


def test_a_straight_path_is_the_track_line_until_it_ends() -> None:
    path = [(1.0, 2.0), (1.0, 2.1), (1.0, 2.1), (1.0, 7.0)]
    track = track_of(path, speed=0.5)
    line = ErrorDetectorParameters(track="line", speed=0.5, track_start=(1.0, 2.0, 0.5 * math.pi))
    assert track.steps == 2000
    np.testing.assert_allclose(rows(track, 2000), Reference(line).first(2000), rtol=0.0, atol=1e-10)
    for step in (2000, 2001, 10**12):
        assert track[step] == pytest.approx((1.0, 7.0, 0.5 * math.pi, 0.0, 0.0), abs=1e-12)


@pytest.mark.parametrize("turn", [1, -1])
def test_points_on_a_circle_are_driven_as_the_circle_that_their_lines_touch(turn: int) -> None:
    """A polygon's lines touch a circle of the radius r cos(pi / m). Between the two half lines, it is all of it."""
    r, m, speed = 2.0, 100, 0.8
    angles = 2.0 * math.pi * np.arange(m + 1) / m
    path = [(r * math.sin(a), turn * r * (1.0 - math.cos(a))) for a in angles]
    inner, half = r * math.cos(math.pi / m), r * math.sin(math.pi / m)
    track = track_of(path, speed)
    first = math.ceil(half / (speed * TS))
    curved = rows(track, track.steps)[first : track.steps - first - 1]
    np.testing.assert_allclose(np.hypot(curved[:, 0], curved[:, 1] - turn * r), inner, rtol=0.0, atol=1e-9)
    chord = 2.0 * inner * math.sin(0.5 * speed * TS / inner)
    np.testing.assert_allclose(curved[:, 3], chord / TS, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(curved[:-1, 4], turn * speed / inner, rtol=0.0, atol=1e-9)
    assert track.steps == math.ceil(2.0 * math.pi * inner * (1.0 - 1.0 / m) / (speed * TS) + 2.0 * half / (speed * TS))


def test_a_lone_corner_is_a_quarter_of_a_circle() -> None:
    track = track_of([(0.0, 0.0), (3.0, 0.0), (3.0, 4.0)], corner=0.5)
    found = rows(track, track.steps + 1)
    bend = (found[:, 0] > 2.5) & (found[:, 1] < 0.5)
    np.testing.assert_allclose(np.hypot(found[bend, 0] - 2.5, found[bend, 1] - 0.5), 0.5, atol=1e-12)
    assert np.abs(found[:, 4]).max() == pytest.approx(1.0 / 0.5)
    assert len(found) * TS == pytest.approx(2.5 + 0.5 * math.pi / 2.0 + 3.5, abs=2.0 * TS)
    np.testing.assert_array_equal(found[~bend & (found[:, 0] < 2.5), 1], 0.0)


@pytest.mark.no_cover
@given(points, st.floats(0.05, 5.0), st.floats(0.01, 3.0))
def test_it_obeys_the_plant_s_recursion_and_stays_by_the_lines(
    path: list[tuple[float, float]], speed: float, corner: float
) -> None:
    track = track_of(path, speed, corner)
    steps = min(track.steps, 3000)
    ways = [track[k] for k in range(steps + 1)]
    for here, there in pairwise(ways):
        x, y, theta = euler_step(*here, TS)
        assert math.dist((x, y), there[:2]) < 1e-9
        assert abs(math.remainder(theta - there.theta, math.tau)) < 1e-9 or there.v == 0.0
        assert 0.0 <= here.v <= speed * (1.0 + 1e-3)
    assert ways[0][:2] == pytest.approx(path[0], abs=1e-9)
    assert track[track.steps][:2] == pytest.approx(path[-1], abs=1e-6)
    for way in ways[:: max(1, steps // 50)]:
        assert min(distance(way[:2], a, b) for a, b in pairwise(path)) <= corner + 1e-6


def distance(p: tuple[float, float], a: tuple[float, float], b: tuple[float, float]) -> float:
    """From a point to a line between two others, by complex numbers."""
    line, way = complex(b[0] - a[0], b[1] - a[1]), complex(p[0] - a[0], p[1] - a[1])
    if not line:
        return abs(way)
    along = (way * line.conjugate()).real / abs(line) ** 2
    return abs(way - min(1.0, max(0.0, along)) * line)


def test_the_way_back_is_begun_by_a_turn_on_the_spot() -> None:
    track = track_of([(0.0, 0.0), (2.0, 0.0), (1.0, 0.0)], corner=0.1)
    found = rows(track, track.steps + 1)
    turns = np.flatnonzero(np.abs(found[:, 4]) > 1e-6)
    assert len(turns) == 1
    assert abs(found[turns[0], 4]) * TS == pytest.approx(math.pi)
    assert found[-1, :2] == pytest.approx((1.0, 0.0))


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ([], "0 points, of which 0 are distinct"),
        ([(1.0, 2.0)], "1 point, of which 1 is distinct"),
        ([(1.0, 2.0)] * 5, "5 points, of which 1 is distinct"),
        ([(0.0, 0.0), (math.nan, 0.0), (1.0, 0.0)], r"point \(nan, 0.0\) is not finite"),
        ([(0.0, 0.0), (1.0, -math.inf)], r"point \(1.0, -inf\) is not finite"),
        ([(-1e308, 0.0), (1e308, 0.0)], "length is not finite"),
    ],
)
def test_what_cannot_be_driven_is_refused(path: list[tuple[float, float]], reason: str) -> None:
    with pytest.raises(PathError, match=reason):
        Curve(path, 0.2)


def test_it_is_shown_whole_with_few_points() -> None:
    track = track_of([(0.0, 0.0), (100.0, 0.0), (100.0, 100.0)], speed=0.1)
    shown = thinned(track, track.steps)
    assert len(shown) <= MOST_POINTS
    assert (shown[0], shown[-1]) == (track[0], track[track.steps])
    assert thinned(track_of([(0.0, 0.0), (1e-3, 0.0)]), 1) == [track_of([(0.0, 0.0), (1e-3, 0.0)])[k] for k in (0, 1)]


def test_beforehand_nobody_knows_it() -> None:
    with pytest.raises(UserError, match=r"track is path: .* name another track \(paper, line, .*csv\)"):
        Reference(ErrorDetectorParameters(track="path"))
