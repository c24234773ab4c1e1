"""Margins over a grid of any two of K_x, K_y, K_theta, T_s, v, curvature and speed scale, at constant speed.

On a straight track they are closed forms. On a curve the largest constant delay comes from the spectral radius of the
lifted system, by bisection of all points of the grid at once.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.stability.joint_spectral_radius import largest_n_across, largest_n_along
from agv_analysis.stability.kanayama_delay import critical_delay_across, critical_delay_along, radii_of
from agv_cloud.parameters import ControllerParameters
from agv_cloud.reference.reference import Reference, lap_steps
from agv_ros.errors import UserError

Ints = NDArray[np.int64]

LIMIT = 100_000
"""Largest n that is looked for; a loop that is stable with it is listed with this number."""


class Point(NamedTuple):
    """A loop at constant speed, its fields the axes that a map can have."""

    kx: float
    """K_x [1/s]."""
    ky: float
    """K_y [1/m^2]."""
    ktheta: float
    """K_theta [1/m]."""
    ts: float
    """T_s [s]."""
    v: float
    """v_r [m/s]."""
    curvature: float
    """w_r / v_r [1/m]."""
    speed_scale: float = 1.0
    """True speed over commanded speed."""

    @property
    def a(self) -> float:
        """T_s K_x of the true speed."""
        return self.ts * self.kx * self.speed_scale

    @property
    def gains(self) -> ControllerParameters:
        """The gains as parameters of the controller."""
        return ControllerParameters(kx=self.kx, ky=self.ky, ktheta=self.ktheta)


@dataclass(frozen=True)
class MarginMap:
    """Margins over a grid; row i belongs to `first[i]`, column j to `second[j]`; -1: unstable without outages."""

    axes: tuple[str, str]
    first: Floats
    second: Floats
    n_lifted: Ints
    """Largest constant n, shape (rows, columns)."""
    n_bursts: Ints
    """Largest n whose repetition contracts on a straight track; no order of bursts allows more, some may allow less."""


def margin_map(base: Point, axes: tuple[str, str], first: Floats, second: Floats) -> MarginMap:
    """Margins where the axes take the values `first`, shape (rows,), and `second`, (columns,), and the rest is `base`.

    Raises UserError for axes that do not exist or are the same.
    """
    if _known(axes[0]) == _known(axes[1]):
        raise UserError(f"a map needs two different axes, got {axes[0]} twice")
    points = [base._replace(**{axes[0]: x, axes[1]: y}) for x in first.tolist() for y in second.tolist()]
    shape = (len(first), len(second))
    repeated = np.array([largest_repeated_burst(point) for point in points], dtype=np.int64)
    return MarginMap(axes, first, second, largest_delays(points).reshape(shape), repeated.reshape(shape))


def around(scenario: Scenario, axes: Sequence[str], points: int) -> tuple[Point, list[Floats]]:
    """A scenario as a point, at its track's highest speed on a straight, and a range of each axis about it.

    From a tenth to ten times the value; from 0 to 1 where it is 0. Raises UserError for an axis that does not exist.
    """
    gains = scenario.controller
    v = float(np.abs(Reference(scenario.error_detector).first(lap_steps(scenario.error_detector))[:, 3]).max())
    base = Point(gains.kx, gains.ky, gains.ktheta, scenario.plant.ts, v, 0.0, scenario.plant.speed_scale)
    return base, [_range(base, axis, points) for axis in axes]


def _range(base: Point, axis: str, points: int) -> Floats:
    value = getattr(base, _known(axis))
    return np.linspace(0.0, 1.0, points) if value == 0.0 else value * np.logspace(-1.0, 1.0, points)


def _known(axis: str) -> str:
    if axis not in Point._fields:
        raise UserError(f"a map has no axis {axis!r}: choose two of {', '.join(Point._fields)}")
    return axis


def largest_repeated_burst(point: Point) -> int:
    """Largest n such that bursts of n losses, again and again, contract on a straight track."""
    along = largest_n_along(point.a)
    if along is None:  # K_x = 0: what is off along the track stays off
        return -1
    across = LIMIT if point.v == 0.0 else largest_n_across(point.v, point.gains, point.ts)
    return min(along, LIMIT if across is None else across)


def largest_delays(points: Sequence[Point]) -> Ints:
    """Largest constant n that is stable at each point, shape (points,)."""
    n = np.array([_on_a_straight_track(point) for point in points], dtype=np.int64)
    kx, ky, ktheta, ts, v, curvature, speed_scale = np.array(points).T
    a, step = ts * kx * speed_scale, ts * v
    curved = np.flatnonzero(step * curvature)
    if len(curved):
        numbers = (a, step * ktheta, step * step * ky, step * curvature, v == 0.0)
        n[curved] = _on_curves(n[curved], *(values[curved] for values in numbers))
    return n


def _on_a_straight_track(point: Point) -> int:
    along = critical_delay_along(point.a)
    across = critical_delay_across(abs(point.v), point.gains, point.ts) if point.v >= 0.0 else 0.0
    # A delay that is a whole number is marginal itself; 1e-9 is more than rounding makes of it.
    return max(-1, math.ceil(min(along, across, LIMIT) - 1e-9) - 1)


def _on_curves(guess: Ints, *numbers: NDArray[Any]) -> Ints:
    """By doubling from what a straight track allows, which is nearly right, then bisection, of all points at once."""

    def are_stable(n: Ints, at: Ints) -> NDArray[np.bool_]:
        return np.asarray(radii_of(n[at].astype(np.float64), *(values[at] for values in numbers)) < 1.0 - 1e-12)

    low, high = np.full_like(guess, -1), guess + 1
    going = np.arange(len(guess))
    while len(going):
        going = going[are_stable(high, going) & (high[going] < LIMIT)]
        low[going], high[going] = high[going], np.minimum(2 * high[going] + 1, LIMIT)
    going = np.flatnonzero((guess >= 0) & (low < guess))
    stable = are_stable(guess, going)
    low[going[stable]], high[going[~stable]] = guess[going[stable]], guess[going[~stable]]
    while len(going := np.flatnonzero(high - low > 1)):
        middle = (low + high) // 2
        stable = are_stable(middle, going)
        low[going[stable]], high[going[~stable]] = middle[going[stable]], middle[going[~stable]]
    return low


def write_csv(path: Path, found: MarginMap) -> None:
    """One row a point: the two axes and both margins. Raises UserError if the file cannot be written."""
    try:
        with path.open("w", encoding="utf-8", newline="") as file:
            rows = csv.writer(file, lineterminator="\n")
            rows.writerow([*found.axes, "n_lifted", "n_bursts"])
            for i, x in enumerate(found.first.tolist()):
                for j, y in enumerate(found.second.tolist()):
                    rows.writerow([x, y, int(found.n_lifted[i, j]), int(found.n_bursts[i, j])])
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None


def draw(path: Path, found: MarginMap) -> None:
    """Contours of both margins. Raises UserError if the file cannot be written or its kind is unknown."""
    from matplotlib.colors import SymLogNorm
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    for axes, n, title in zip(
        figure.subplots(1, 2), (found.n_lifted, found.n_bursts),
        ("largest constant n", "largest repeated burst n (straight track)"), strict=True,
    ):  # fmt: skip
        mesh = axes.pcolormesh(
            found.second, found.first, n, norm=SymLogNorm(1.0, vmin=-1.0, vmax=max(10.0, float(n.max())))
        )
        axes.set(xlabel=LABELS[found.axes[1]], ylabel=LABELS[found.axes[0]], title=title)
        for values, scale in ((found.second, axes.set_xscale), (found.first, axes.set_yscale)):
            scale("log" if values.min() > 0.0 and values.max() >= 10.0 * values.min() else "linear")
        figure.colorbar(mesh, ax=axes)
    try:
        figure.savefig(path, dpi=150)
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be drawn: {error}") from None


LABELS = {
    "kx": "K_x [1/s]", "ky": "K_y [1/m^2]", "ktheta": "K_theta [1/m]", "ts": "T_s [s]", "v": "v_r [m/s]",
    "curvature": "curvature [1/m]", "speed_scale": "true over commanded speed",
}  # fmt: skip
