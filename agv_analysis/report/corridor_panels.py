"""The corridor of a run: how far outages lead by the place where they begin, and its edges along the track."""

from __future__ import annotations

import math

import numpy as np

from agv_analysis.corridor.corridor import Corridor
from agv_analysis.corridor.outer_tube import Tube
from agv_analysis.corridor.widths import Widths
from agv_analysis.report.panels import DRIVEN, LIMIT, OTHER, Line, Panel
from agv_analysis.run import Floats
from agv_ros.counted import counted

_MOST_PLACES = 2000
"""Places of a lap at which an edge is drawn: closer than a pixel on any screen."""


def corridor_panel(found: Corridor) -> Panel:
    """Largest distance from the reference over a lap: after one outage that begins there, and in the tube for any."""
    seconds: Floats = np.arange(len(found.lap), dtype=np.float64) * found.ts
    lines = []
    if found.single is not None and found.single.n is not None and found.single.n >= 0:
        name = f"after one outage of {counted(found.single.n, 'slot')} that begins here"
        lines.append(Line(name, seconds, found.single.shares * found.widths.half_width, DRIVEN))
    if found.tube is not None:
        name = f"at most, under any outages of up to {counted(found.tube.n, 'slot')}"
        lines.append(Line(name, seconds, _of_lap(found.tube.distance, len(seconds)), OTHER))
    ends = seconds[[0, -1]]
    lines.append(Line("corridor", ends, np.full(2, found.widths.half_width), LIMIT))
    return Panel("corridor", "Within the corridor", "time of the lap [s]", "deviation [m]", tuple(lines))


def edges(found: Corridor) -> tuple[Line, ...]:
    """The corridor's edges along a lap, and those of the tube, as lines on the track."""
    return edges_along(found.lap, found.widths, found.tube)


def edges_along(lap: Floats, widths: Widths, tube: Tube | None, remark: str = "") -> tuple[Line, ...]:
    """The same of a lap, shape (N, 5), with a remark on the tube, or on why there is none; at some of its places."""
    some = np.unique(np.linspace(0, len(lap) - 1, min(len(lap), _MOST_PLACES)).astype(np.int64))
    remark = f" ({remark})" if remark else ""
    name = "corridor" if tube is not None else f"corridor{remark}"
    lines = [_edge(name, lap[some], np.full(len(some), widths.half_width), LIMIT)]
    if tube is not None:
        name = f"tube for any outages up to {counted(tube.n, 'slot')}{remark}"
        lines.append(_edge(name, lap[some], _of_lap(tube.distance, len(lap))[some], OTHER))
    return tuple(lines)


def _of_lap(values: Floats, steps: int) -> Floats:
    return np.asarray(np.broadcast_to(values, steps))


def _edge(name: str, lap: Floats, distance: Floats, role: str) -> Line:
    """Both edges of a band about the track as one line, with a gap between them."""
    across = np.column_stack((-np.sin(lap[:, 2]), np.cos(lap[:, 2]))) * distance[:, None]
    gap = np.full((1, 2), math.nan)
    points = np.concatenate((lap[:, :2] + across, gap, lap[:, :2] - across))
    return Line(name, points[:, 0], points[:, 1], role)
