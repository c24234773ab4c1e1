"""The reference: the plant's own recursion, step by step and to the last bit, in whatever order it is asked for."""

from __future__ import annotations

import math
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_analysis.simulation.reference import reference_of
from agv_cloud.parameters import ErrorDetectorParameters
from agv_cloud.reference.reference import Reference, lap_steps, speeds_of
from agv_cloud.reference.track_file import TrackFileError
from agv_cloud.reference.tracks import TRACKS

Point = tuple[float, float, float, float, float]


def recursion(parameters: ErrorDetectorParameters, steps: int) -> list[Point]:
    """Equation 15 of the paper with u = (v_r, w_r), written out."""
    n, ts = round(parameters.lap_time / parameters.ts), parameters.ts
    x, y, theta = parameters.track_start
    points = []
    for k in range(steps):
        v, w = TRACKS[parameters.track](k, n, ts, parameters.speed)
        points.append((x, y, theta, v, w))
        x, y, theta = x + ts * (v * math.cos(theta)), y + ts * (v * math.sin(theta)), theta + ts * w
    return points


@pytest.mark.parametrize("track", TRACKS)
def test_it_is_the_euler_recursion_to_the_last_bit(track: str) -> None:
    parameters = ErrorDetectorParameters(track=track, lap_time=5.0, speed=1.5, track_start=(1.0, -2.0, 0.3))
    expected = recursion(parameters, 2500)
    reference = Reference(parameters)
    assert [tuple(reference[k]) for k in range(2500)] == expected
    assert Reference(parameters).first(2500).tolist() == [list(point) for point in expected]
    assert reference_of(parameters, 2500).tolist() == [list(point) for point in expected]


@settings(deadline=None, derandomize=True, max_examples=50)
@given(st.lists(st.integers(0, 30_000), min_size=1, max_size=30))
def test_the_order_of_questions_does_not_matter(questions: list[int]) -> None:
    reference = Reference(ErrorDetectorParameters())
    assert all(tuple(reference[k]) == THE_PAPER_S[k] for k in questions)


THE_PAPER_S = recursion(ErrorDetectorParameters(), 30_001)


def test_the_paper_s_lap_closes() -> None:
    parameters = ErrorDetectorParameters()
    assert lap_steps(parameters) == 20_000
    begin, end = Reference(parameters)[0], Reference(parameters)[20_000]
    assert math.dist(begin[:2], end[:2]) < 1e-9
    assert end.theta - begin.theta == pytest.approx(2.0 * math.pi, abs=1e-9)
    assert begin[:3] == (0.0, 0.0, math.pi / 2)


def test_steps_in_an_array() -> None:
    reference = Reference(ErrorDetectorParameters())
    assert reference.first(0).shape == (0, 5)
    assert reference.first(1).tolist() == [[0.0, 0.0, math.pi / 2, 0.5, 0.0]]
    assert reference.first(300).dtype == np.float64


def test_a_long_run_takes_little_memory() -> None:
    reference = Reference(ErrorDetectorParameters(track="circle"))
    tracemalloc.start()
    try:
        for k in range(0, 150_000, 50):
            reference[k]
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 8_000_000


def test_a_track_from_a_file_is_driven_by_the_same_recursion(tmp_path: Path) -> None:
    path = tmp_path / "track.csv"
    path.write_text("t,v,w\n0,1,0\n1,1,0\n1.5,2,0.5\n2.0,0,0\n", encoding="utf-8")
    reference = Reference(ErrorDetectorParameters(track="csv", track_file=str(path), ts=0.25, lap_time=4.0))
    v = [1.0, 1.0, 1.0, 1.0, 1.0, 1.5, 2.0, 1.0, 0.0, 0.0, 0.0]
    w = [0.0, 0.0, 0.0, 0.0, 0.0, 0.25, 0.5, 0.25, 0.0, 0.0, 0.0]
    assert reference.first(11)[:, 3:].tolist() == [list(pair) for pair in zip(v, w, strict=True)]
    headings = math.pi / 2 + 0.25 * np.concatenate([[0.0], np.cumsum(w)[:-1]])
    assert reference.first(11)[:, 2] == pytest.approx(headings)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(TrackFileError, match=r"none\.csv: cannot be read: No such file"):
        speeds_of(ErrorDetectorParameters(track="csv", track_file=str(tmp_path / "none.csv")))
