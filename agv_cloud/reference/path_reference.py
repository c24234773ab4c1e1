"""The reference along paths that come while the loop runs: which path holds at which step."""

from __future__ import annotations

from collections import deque

from agv_cloud.reference.path_track import Curve, PathTrack, Point
from agv_cloud.reference.point import ReferencePoint

_KEPT = 16
"""How many paths back the reference is known: of the last 16 s, if the planner plans once a second."""


class PathReference:
    """X_r by step where paths come in a running loop: each replaces the one before it from its own beginning on."""

    def __init__(self, corner: float, speed: float, ts: float) -> None:
        self._corner, self._speed, self._ts = corner, speed, ts
        self._tracks: deque[tuple[int, PathTrack]] = deque(maxlen=_KEPT)
        self._next: PathTrack | None = None
        self._points: list[Point] = []
        self.paths = 0
        """Number of paths that have replaced the one before them."""

    def take(self, points: list[Point]) -> PathTrack | None:
        """Drive the path through these points [m]; None if it is the one that is driven already. Raises PathError."""
        if points == self._points:
            return None
        track = PathTrack(Curve(points, self._corner), self._speed, self._ts)
        self.replace(track)
        self._points = points
        self.paths += 1
        return track

    def replace(self, track: PathTrack) -> None:
        """Drive this path from the next step on that is answered."""
        self._next = track

    def begin(self, k: int) -> None:
        """Step k is answered now: a path that has come before it begins with it."""
        if self._next is not None:
            self._tracks.append((k, self._next))
            self._next = None

    def restart(self) -> None:
        """A run begins again, and the newest path with it."""
        if self._next is None and self._tracks:
            self._next = self._tracks[-1][1]
        self._tracks.clear()

    def __getitem__(self, k: int) -> ReferencePoint | None:
        """The reference at step k; None before the first path."""
        found = next(((begin, track) for begin, track in reversed(self._tracks) if begin <= k), None)
        return None if found is None else found[1][k - found[0]]
