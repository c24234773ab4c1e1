"""What a report draws: lines on axes, described once for the page and for the figures of a paper."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.metrics.bands import TOLERANCE
from agv_analysis.metrics.deviation import DIVERGED, Peak
from agv_analysis.metrics.error_metrics import body_errors, wrapped
from agv_analysis.report.eigenvalues import lifted_multipliers, paper_eigenvalues
from agv_analysis.run import Floats, Run
from agv_analysis.stability.analysis import Analysis, Observations
from agv_ros.counted import counted

TIME = "time [s]"

LINE, STEP, MARKERS, HALOS, RINGS, BARS = "line", "step", "markers", "halos", "rings", "bars"
"""How a line is drawn; halos are wide and faint, and lie under everything else."""

REFERENCE, DRIVEN, LOST, OTHER, LIMIT, PEAK = "reference", "driven", "lost", "other", "limit", "peak"
"""What a line stands for, which gives it its colour."""

PINNED = "pinned"
"""Another run that is held against the first: dotted, so that the two differ without colours as well."""

DEVIATIONS = tuple(f"deviation {i}" for i in range(5))
"""The AGV's path by how far it is from the reference, from near to far."""

_BOUNDS = (1e-3, 1e-2, 1e-1, 1.0)
"""Distances [m] between the colours of DEVIATIONS."""

_NAMES = ("AGV within 1 mm", "within 1 cm", "within 10 cm", "within 1 m", "farther away")

_MOST_STRETCHES = 10_000
"""Stretches of a run that have a colour each."""

_WILD = 1e3
"""Errors [m] and speeds [m/s] beyond this are those of a loop that diverges."""

AGV = "AGV"
"""Name of the line that the AGV drove."""

SMALLEST = 1e-6
"""Errors [m] below this are drawn at it: a logarithm has no zero."""


class Slots(NamedTuple):
    """Steps, and for what each of them lost its message; shapes (M,)."""

    k: NDArray[np.int64]
    cause: NDArray[np.str_]
    """Empty where it is not recorded."""


@dataclass(frozen=True)
class Line:
    """One line of a panel; x and y of equal length, NaN where nothing is drawn."""

    name: str
    x: Floats
    y: Floats
    role: str
    style: str = LINE
    slots: Slots | None = None
    """The slot behind each point, where there is one."""


@dataclass(frozen=True)
class Panel:
    """A pair of axes with its lines."""

    key: str
    title: str
    x_label: str
    y_label: str
    lines: tuple[Line, ...]
    log: bool = False
    equal: bool = False
    """Have both axes the same scale?"""
    y_range: tuple[float, float] | None = None
    """What is shown at first; None: everything."""


def time_panels(run: Run, worst: tuple[Peak, ...] = (), since: float | None = None) -> tuple[Panel, ...]:
    """Errors, speed and age of the pose over time; the largest deviations are marked.

    What is shown at first is what happens `since` [s], from the first step of the run; None: most of it.
    """
    return distance(run, worst), frame_errors(run, since), speed(run, since), age(run)


def panels(analysis: Observations) -> Iterator[Panel]:
    """All panels of a run; those that need the controller's gains only where these are known."""
    worst, since = analysis.deviation.worst, analysis.deviation.since_seconds
    yield coloured_by_deviation(track(analysis.run, worst), analysis.run)
    yield from time_panels(analysis.run, worst, since)
    if analysis.outages.uplink.count:
        yield outage_lengths(analysis)
    if isinstance(analysis, Analysis) and not analysis.infeasible:
        yield unit_circle(analysis)


def track(run: Run, worst: tuple[Peak, ...] = ()) -> Panel:
    """The track from above, with the places where poses were lost, and those of the largest deviations."""
    reference = run.reference[:, :2]
    x, y = within_reach(run)
    cause = np.full(len(run), "") if run.uplink is None else run.uplink.cause
    why = Slots(run.k[run.lost], cause[run.lost])
    lines = [Line("reference", reference[:, 0], reference[:, 1], REFERENCE), Line(AGV, x, y, DRIVEN)]
    if worst:
        rows = np.searchsorted(run.time, [run.time[0] + peak.seconds for peak in worst])
        lines.append(Line("largest deviations", x[rows], y[rows], PEAK, RINGS))
    if run.lost.any():
        lines.append(Line("pose lost", x[run.lost], y[run.lost], LOST, HALOS, why))
    return Panel("track", "Track", "x [m]", "y [m]", tuple(lines), equal=True)


def coloured_by_deviation(panel: Panel, run: Run) -> Panel:
    """The track of a run on which the AGV's line is taken apart by how far it was from the reference.

    The farthest lie on top, so that no short excursion is covered.
    """
    offset = run.pose[:, :2] - run.reference[:, :2]
    distances = np.hypot(offset[:, 0], offset[:, 1])
    lines: list[Line] = []
    for line in panel.lines:
        lines += _by_deviation(line, distances) if line.name == AGV else (line,)
    return replace(panel, lines=tuple(lines))


def _by_deviation(line: Line, distances: Floats) -> Iterator[Line]:
    """Lines by colour, with gaps where another one is drawn; each stretch has the colour of its largest distance."""
    begins = np.arange(0, len(distances), -(-len(distances) // _MOST_STRETCHES))
    x, y, colour = line.x[begins], line.y[begins], np.digitize(np.maximum.reduceat(distances, begins), _BOUNDS)
    for i, (name, role) in enumerate(zip(_NAMES, DEVIATIONS, strict=True)):
        rows = np.flatnonzero(colour == i)
        if len(rows):
            is_last = np.append(np.diff(rows) != 1, True)
            ends = np.minimum(rows[is_last] + 1, len(x) - 1)  # where the next stretch begins, and then a gap
            after = np.repeat(np.flatnonzero(is_last) + 1, 2)
            gaps = np.full(len(ends), np.nan)
            drawn_x, drawn_y = (
                np.insert(values[rows], after, np.column_stack((values[ends], gaps)).ravel()) for values in (x, y)
            )
            yield Line(name, drawn_x, drawn_y, role)


def within_reach(run: Run) -> tuple[Floats, Floats]:
    """x and y of the AGV [m], shape (N,) each, NaN where it is so far away that the track would shrink to a point."""
    return _within(run.pose[:, 0], run.reference[:, 0]), _within(run.pose[:, 1], run.reference[:, 1])


def _within(values: Floats, reference: Floats) -> Floats:
    """Values that lie within some laps of the reference."""
    reach = 2.0 * (np.ptp(reference) + 10.0)
    near = np.abs(values - np.mean(reference)) <= reach
    return np.where(near, values, np.nan)


def distance(run: Run, worst: tuple[Peak, ...] = ()) -> Panel:
    """Distance between AGV and reference, on a logarithmic axis, its largest peaks after settling marked.

    The axis ends where a run has diverged.
    """
    e = run.reference[:, :2] - run.pose[:, :2]
    apart = np.maximum(np.hypot(e[:, 0], e[:, 1]), SMALLEST)
    marked: tuple[Line, ...] = ()
    if worst:
        at = np.array([run.time[0] + peak.seconds for peak in worst])
        marked = (Line("largest deviations", at, np.array([peak.distance for peak in worst]), PEAK, RINGS),)
    return Panel(
        "distance",
        "Error",
        TIME,
        "error [m]",
        (
            Line("distance", run.time, apart, DRIVEN),
            Line("|y_r - y_c|", run.time, np.maximum(np.abs(e[:, 1]), SMALLEST), OTHER),
            _limit("1 cm", run, TOLERANCE),
            *marked,
        ),
        log=True,
        y_range=(SMALLEST, DIVERGED) if (apart > DIVERGED).any() else None,
    )


def frame_errors(run: Run, since: float | None = None) -> Panel:
    """The true errors in the AGV's frame."""
    e = body_errors(run.reference, run.pose)
    lines = (
        Line("x_e along [m]", run.time, e[:, 0], DRIVEN),
        Line("y_e across [m]", run.time, e[:, 1], OTHER),
        Line("theta_e [rad]", run.time, wrapped(e[:, 2]), REFERENCE),
    )
    return Panel("errors", "Errors in the AGV's frame", TIME, "error [m, rad]", lines, y_range=_shown(e, run, since))


def speed(run: Run, since: float | None = None) -> Panel:
    """Commanded speed, the reference's, and the limits."""
    lines = [
        Line("v", run.time, run.command[:, 0], DRIVEN),
        Line("v_r", run.time, run.reference[:, 3], REFERENCE),
    ]
    v_max = run.scenario.controller.v_max
    if run.gains_known and np.isfinite(v_max):
        lines += [_limit(name, run, limit) for name, limit in (("v_max", v_max), ("-v_max", -v_max))]
    shown = _shown(np.column_stack((run.command[:, 0], run.reference[:, 3])), run, since)
    return Panel("speed", "Speed", TIME, "speed [m/s]", tuple(lines), y_range=shown)


def age(run: Run) -> Panel:
    """Age of the freshest pose that the edge holds."""
    lines = [Line("n_ul", run.time, run.n_ul.astype(np.float64), LOST, STEP)]
    if run.is_late:
        acted = run.command_age.astype(np.float64)
        lines.append(Line("by receive time, of the command that acted", run.time, acted, DRIVEN, STEP))
    label = "n_ul [steps]"
    title = "Age of information: steps since the freshest pose that the edge holds"
    is_fresh = not any(line.y.any() for line in lines)
    return Panel("age", title, TIME, label, tuple(lines), y_range=(-0.05, 1.0) if is_fresh else None)


def _limit(name: str, run: Run, value: float) -> Line:
    ends = run.time[[0, -1]]
    return Line(name, ends, np.full(2, value), LIMIT)


def _shown(values: Floats, run: Run, since: float | None) -> tuple[float, float] | None:
    """The range of a panel at first, of values of shape (N, M): that since the initial error has settled.

    A start far from the track would flatten all the rest. Of a run that does not settle, or diverges, most of it.
    """
    if since is None:
        return _most(values)
    settled = values[run.time - run.time[0] >= since]
    finite = settled[np.isfinite(settled)]
    if not finite.size or np.abs(finite).max() > _WILD:
        return _most(values)
    low, high = float(finite.min()), float(finite.max())
    margin = max(0.05 * (high - low), 0.01 * max(abs(low), abs(high)), 1e-6)
    return low - margin, high + margin


def _most(values: Floats) -> tuple[float, float] | None:
    """A range that holds 98 % of the values and a margin: a start far from the track would flatten all the rest.

    Of a run that diverges, the values until it has.
    """
    finite = values[np.abs(values) <= DIVERGED]
    if not finite.size:
        return None
    low, high = np.percentile(finite, [1.0, 99.0])
    margin = max(0.25 * (high - low), 0.01 * max(abs(low), abs(high)), 1e-6)
    return float(low - margin), float(high + margin)


def outage_lengths(analysis: Observations) -> Panel:
    """How many outages of each length there were, and how many are expected under the fit."""
    up, fit = analysis.outages.uplink, analysis.fit
    lengths = np.arange(1, max(1, up.longest) + 1, dtype=np.float64)
    lines = [Line("seen", lengths, np.array([up.histogram.get(int(n), 0) for n in lengths], dtype=float), LOST, BARS)]
    if 0.0 < fit.chain.loss_rate < 1.0 and fit.mean_burst >= 1.0:
        ends = 1.0 / fit.mean_burst  # both models end an outage with the same probability in each slot
        lines.append(Line(f"{fit.model} as fitted", lengths, up.count * ends * (1.0 - ends) ** (lengths - 1.0), DRIVEN))
    return Panel("outages", "Outages of the uplink", "length [slots]", "how many", tuple(lines))


def unit_circle(analysis: Analysis) -> Panel:
    """The paper's eigenvalues along the run and the multipliers of the lifted system, on the unit circle."""
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    eigenvalues, multipliers = paper_eigenvalues(analysis.run), lifted_multipliers(analysis)
    lines = (
        Line("|z| = 1", np.cos(angle), np.sin(angle), LIMIT),
        *_eigenvalues("lifted system", multipliers, LOST),
        *_eigenvalues("paper's A(k)", eigenvalues, DRIVEN),
    )
    title = (
        "Eigenvalues: the paper's along the run, the lifted system's for a pose always "
        f"{counted(analysis.n, 'step')} old"
    )
    return Panel("eigenvalues", title, "Re", "Im", lines, equal=True)


def _eigenvalues(name: str, z: NDArray[np.complex128], role: str) -> Iterator[Line]:
    """Eigenvalues of one kind, and a ring about the largest of them, which decides; its modulus is in the legend."""
    yield Line(name, z.real, z.imag, role, MARKERS)
    if len(z):
        largest = z[[np.abs(z).argmax()]]
        yield Line(f"{name}, largest: |z| = {abs(largest[0]):.5g}", largest.real, largest.imag, role, RINGS)


def thinned(line: Line, most: int) -> Line:
    """A line of about `most` points at most, which keeps the lowest and the highest of each stretch, and its gaps.

    So no peak is lost, however far one zooms out; with `most` pixels the picture is the same.
    """
    if len(line.x) <= most:
        return line
    width = -(-len(line.x) // max(1, most // 2))
    begins = np.arange(0, len(line.x), width)
    missing = np.full(len(begins) * width - len(line.x), np.nan)
    stretches = np.concatenate((line.y, missing)).reshape(-1, width)
    is_empty = np.isnan(stretches)
    lowest = begins + np.where(is_empty, np.inf, stretches).argmin(axis=1)
    highest = begins + np.where(is_empty, -np.inf, stretches).argmax(axis=1)
    gaps = (begins + is_empty.argmax(axis=1))[is_empty.any(axis=1)]
    kept = np.unique(np.concatenate((lowest, highest, gaps[gaps < len(line.x)], [0, len(line.x) - 1])))
    slots = None if line.slots is None else Slots(*(part[kept] for part in line.slots))
    return replace(line, x=line.x[kept], y=line.y[kept], slots=slots)


def to_json(panel: Panel, most: int) -> dict[str, Any]:
    """A panel's lines by name, for numeric export; null where nothing is drawn."""
    lines = [thinned(line, most) for line in panel.lines]
    return {
        "title": panel.title,
        "x": panel.x_label,
        "y": panel.y_label,
        "lines": {line.name: {"x": plain(line.x), "y": plain(line.y)} for line in lines},
    }


def plain(values: Floats) -> list[float | None]:
    """Numbers for JSON, in seven digits: null where nothing is drawn."""
    return [float(f"{value:.7g}") if np.isfinite(value) else None for value in values.tolist()]
