"""Track files: linear between the rows, and a line for whatever is wrong in a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_cloud.reference.track_file import TrackFileError, load_track, parse_track
from agv_ros.errors import UserError

speed = st.floats(-10.0, 10.0)
row = st.tuples(st.floats(1e-3, 10.0), speed, speed)


@settings(deadline=None, derandomize=True)
@given(st.tuples(speed, speed), st.lists(row, max_size=20), st.lists(st.floats(0.0, 250.0), max_size=20))
def test_between_rows_it_is_numpy_s_interpolation(
    first: tuple[float, float], later: list[tuple[float, float, float]], times: list[float]
) -> None:
    t = np.concatenate([[0.0], np.cumsum([gap for gap, _, _ in later])])
    v, w = np.array([first, *(pair[1:] for pair in later)]).T
    profile = parse_track(
        ["t,v,w", *(f"{a!r},{b!r},{c!r}" for a, b, c in zip(t.tolist(), v.tolist(), w.tolist(), strict=True))], "f"
    )
    for at in [*times, *t.tolist()]:
        expected = (np.interp(at, t, v), np.interp(at, t, w)) if at <= t[-1] + 1e-9 else (0.0, 0.0)
        assert profile(at) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("ts", [0.005, 0.1, 0.02, 1e-3])
def test_the_last_row_counts_at_its_own_instant_however_k_ts_is_rounded(ts: float) -> None:
    for steps in range(1, 1000):
        profile = parse_track(["t,v,w", "0,1,2", f"{round(steps * ts, 6)},1,2"], "f")
        assert profile(steps * ts) == (1.0, 2.0)
        assert profile((steps + 1) * ts) == (0.0, 0.0)


def test_columns_may_stand_in_any_order_among_others() -> None:
    profile = parse_track(["note, w ,t, v", "a,0.5,0,2", "", "b,0.5,1,4"], "f")
    assert profile(0.5) == (3.0, 0.5)


def test_a_single_row() -> None:
    profile = parse_track(["t,v,w", "0,3,0.5"], "f")
    assert [profile(t) for t in (0.0, 0.005)] == [(3.0, 0.5), (0.0, 0.0)]


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"], ids=["plain", "byte order mark"])
@pytest.mark.parametrize("end", [b"\n", b"\r\n"], ids=["unix", "windows"])
def test_files_as_spreadsheets_write_them(tmp_path: Path, mark: bytes, end: bytes) -> None:
    path = tmp_path / "track.csv"
    path.write_bytes(mark + end.join([b"t,v,w", b'"0",1.0,0.0', b"2.0,3.0,0.0", b""]))
    assert load_track(str(path))(1.0) == (2.0, 0.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "f:1: no column t, v, w; the first line must name the columns t, v, w"),
        ("0,1,0", "f:1: no column t, v, w"),
        ("t,v\n0,1", "f:1: no column w"),
        ("t;v;w\n0;1;0", "f:1: no column t, v, w"),
        ("t,v,w", "f: no rows below the header"),
        ("t,v,w\n\n\n", "f: no rows below the header"),
        ("t,v,w\n0,1", "f:2: expected numbers t, v, w, found '0,1'"),
        ("t,v,w\n0,1,0\n1,fast,0", "f:3: expected numbers t, v, w, found '1,fast,0'"),
        ("t,v,w\n0,1,\n", "f:2: expected numbers t, v, w, found '0,1,'"),
        ("t,v,w\n0,nan,0", "f:2: t, v and w must be finite, found '0,nan,0'"),
        ("t,v,w\n0,1,inf", "f:2: t, v and w must be finite"),
        ("t,v,w\n0.1,1,0", "f:2: the first time must be 0, found 0.1"),
        ("t,v,w\n-1,1,0", "f:2: the first time must be 0, found -1.0"),
        ("t,v,w\n0,1,0\n2,1,0\n1,1,0", "f:4: times must increase, found 1.0 after 2.0"),
        ("t,v,w\n0,1,0\n0,2,0", "f:3: times must increase, found 0.0 after 0.0"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(text: str, words: str) -> None:
    with pytest.raises(TrackFileError) as caught:
        parse_track(text.splitlines(keepends=True), "f")
    assert str(caught.value).startswith(words)
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"t,v,w\n\xff\xfe")
    for path, words in (
        (tmp_path / "none", "No such file"),
        (tmp_path, "Is a directory"),
        (binary, "is not UTF-8 text"),
    ):
        with pytest.raises(TrackFileError, match=words) as caught:
            load_track(str(path))
        assert str(caught.value).startswith(f"{path}: ")
    assert issubclass(TrackFileError, UserError)


@settings(deadline=None, derandomize=True)
@given(
    st.one_of(
        st.text(max_size=80), st.text(alphabet='tvw,01.e-"\n\r \0', max_size=80).map(lambda text: "t,v,w\n" + text)
    )
)
def test_no_text_makes_another_error(text: str) -> None:
    try:
        profile = parse_track(text.splitlines(keepends=True), "f")
    except TrackFileError:
        return
    assert np.isfinite(profile(0.0)).all()
