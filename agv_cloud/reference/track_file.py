"""A reference track from a CSV file with the columns t [s], v [m/s], w [rad/s]."""

from __future__ import annotations

import bisect
import csv
import math
from collections.abc import Iterable

from agv_cloud.reference.tracks import Speeds
from agv_ros.errors import UserError, open_text


class TrackFileError(UserError):
    """A track file that cannot be used; the text names file, line and reason."""


_SAME_INSTANT = 1e-9
"""Instants are whole nanoseconds; k T_s [s] may miss the file's decimal number by a rounding."""


class SpeedProfile:
    """Speeds over time, linear between the rows of the file, zero after the last."""

    def __init__(self, rows: list[tuple[float, float, float]]) -> None:
        self._times = [row[0] for row in rows]
        self._rows = rows

    @property
    def duration(self) -> float:
        """Time of the last row [s]."""
        return self._times[-1]

    def __call__(self, t: float) -> Speeds:
        """Speeds (v [m/s], w [rad/s]) at time `t` >= 0 [s]."""
        after = bisect.bisect_right(self._times, t)
        if after == len(self._rows):
            last = self._rows[-1]
            return (last[1], last[2]) if t - last[0] < _SAME_INSTANT else (0.0, 0.0)
        (t0, v0, w0), (t1, v1, w1) = self._rows[after - 1], self._rows[after]
        share = (t - t0) / (t1 - t0)
        return v0 + share * (v1 - v0), w0 + share * (w1 - w0)


MOST_ROWS = 1_000_000
"""Rows of a track: three hours at 10 ms."""


def parse_track(lines: Iterable[str], name: str) -> SpeedProfile:
    """Speed profile from the lines of a CSV file called `name` in messages.

    Times must begin at 0 and increase. Raises TrackFileError naming the line.
    """
    reader = csv.reader(lines)
    try:
        header = [cell.strip() for cell in next(reader, [])]
        missing = [column for column in ("t", "v", "w") if column not in header]
        if missing:
            raise TrackFileError(
                f"{name}:1: no column {', '.join(missing)}; the first line must name the columns t, v, w"
            )
        columns = [header.index(column) for column in ("t", "v", "w")]
        rows: list[tuple[float, float, float]] = []
        for row in reader:
            if len(rows) > MOST_ROWS:
                raise TrackFileError(f"{name}: has more than {MOST_ROWS} rows: leave out some, speeds are interpolated")
            if row:
                rows.append(_row(row, columns, f"{name}:{reader.line_num}", rows))
    except csv.Error as error:
        raise TrackFileError(f"{name}:{reader.line_num}: {error}") from None
    if not rows:
        raise TrackFileError(f"{name}: no rows below the header")
    return SpeedProfile(rows)


def _row(
    row: list[str], columns: list[int], where: str, before: list[tuple[float, float, float]]
) -> tuple[float, float, float]:
    try:
        t, v, w = (float(row[column]) for column in columns)
    except (ValueError, IndexError):
        raise TrackFileError(f"{where}: expected numbers t, v, w, found {','.join(row)!r}") from None
    if not (math.isfinite(t) and math.isfinite(v) and math.isfinite(w)):
        raise TrackFileError(f"{where}: t, v and w must be finite, found {','.join(row)!r}")
    if not before and t != 0.0:
        raise TrackFileError(f"{where}: the first time must be 0, found {t!r}")
    if before and t <= before[-1][0]:
        raise TrackFileError(f"{where}: times must increase, found {t!r} after {before[-1][0]!r}")
    return t, v, w


def load_track(path: str) -> SpeedProfile:
    """Speed profile from a CSV file. Raises TrackFileError."""
    with open_text(path, TrackFileError, encoding="utf-8-sig", newline="") as file:
        return parse_track(file, path)
