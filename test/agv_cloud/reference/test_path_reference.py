"""The reference along paths that come while the loop runs: from which step on each of them holds."""

from __future__ import annotations

import pytest

from agv_cloud.reference.path_reference import PathReference
from agv_cloud.reference.path_track import PathError
from test.agv_cloud.reference.test_path_track import TS, track_of


def test_a_path_begins_with_the_step_that_is_answered_after_it_came() -> None:
    reference, first = PathReference(0.2, 1.0, TS), track_of([(0.0, 0.0), (1.0, 0.0)])
    second = track_of([(5.0, 5.0), (5.0, 9.0)])
    reference.begin(3)
    assert reference[3] is None
    reference.replace(first)
    for k in (4, 5):
        reference.begin(k)
    assert [reference[k] for k in (3, 4, 5, 9)] == [None, first[0], first[1], first[5]]
    reference.replace(second)
    assert reference[9] == first[5]
    reference.begin(9)
    assert [reference[k] for k in (8, 9, 10)] == [first[4], second[0], second[1]]


def test_paths_of_long_ago_are_forgotten_and_a_run_that_begins_anew_has_the_newest() -> None:
    reference, tracks = PathReference(0.2, 1.0, TS), [track_of([(float(i), 0.0), (i + 1.0, 0.0)]) for i in range(40)]
    for k, track in enumerate(tracks):
        reference.replace(track)
        reference.begin(10 * k)
    assert reference[0] is None
    assert [reference[10 * k] for k in range(30, 40)] == [track[0] for track in tracks[30:]]
    reference.restart()
    assert reference[395] is None
    reference.begin(0)
    assert reference[2] == tracks[-1][2]


def test_a_path_that_comes_again_is_not_begun_again() -> None:
    reference, path = PathReference(0.2, 1.0, TS), [(0.0, 0.0), (1.0, 0.0)]
    track = reference.take(path)
    assert track is not None
    reference.begin(0)
    assert reference.take(list(path)) is None
    reference.begin(7)
    assert (reference[7], reference.paths) == (track[7], 1)


def test_a_path_that_cannot_be_driven_leaves_the_one_before() -> None:
    reference = PathReference(0.2, 1.0, TS)
    track = reference.take([(0.0, 0.0), (1.0, 0.0)])
    assert track is not None
    reference.begin(0)
    with pytest.raises(PathError, match="2 are needed for a path"):
        reference.take([(0.0, 0.0)])
    reference.begin(1)
    assert (reference[1], reference.paths) == (track[1], 1)
