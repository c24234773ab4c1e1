"""Dead time, lag and gain of one speed of a robot, from its commands and the increments of its poses.

Of y = gain * lag(u(t - dead time)), integrated from pose to pose, the gain is linear. Dead time and lag are searched
for on a grid, and by least squares from its best places on. Intervals are those of the profile likelihood at 95 %,
widened where the whitened residuals are still correlated (Newey and West, Econometrica 55, 1987). Dead time and a short
lag are known less well than their sum, and the valley of the likelihood is bent: it is followed from lag to lag.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from agv_analysis.identify.first_order import HeldCommand
from agv_analysis.identify.increment_noise import IncrementNoise, fitted_noise
from agv_analysis.run import Floats

LONGEST_DEAD_TIME = 1.0
"""[s]; longer ones are not searched for."""

LONGEST_LAG = 3.0
"""[s], likewise."""

CHI_SQUARE = 3.841458820694124
"""95 % quantile of the chi-square distribution with one degree of freedom."""

_ROWS, _COLUMNS = 21, 17
"""Lags, and dead times of each, at which the likelihood is computed about the best."""

_ITERATIONS = 30

_STARTS = 4

_STEP = 0.025
"""Distance of dead times [s] in the first search."""

_CENTRINGS = 40
"""How often, at most, a grid of dead times is moved to where the best ones are; recordings with noise need a few."""

_REACH, _LEAST_REACH, _ROUNDS = 3.0, 2e-3, 10
"""Lags about the best that come first, in standard deviations and at least so many [s]; how often more are tried."""

_SMALL = 2e-3
"""Step [s] of derivatives with respect to dead time and lag."""

_RESOLUTION = 1e-6
"""What no increment is known better than [m or rad]: a simulator's poses without any noise have intervals, too."""

_NOTHING = 1e-20


class Increments(NamedTuple):
    """How far a robot moved, forwards [m] or in heading [rad], between poses at rising instants.

    Shapes: t [s] (N + 1,), moved (N,).
    """

    t: Floats
    moved: Floats


@dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float

    @property
    def width(self) -> float:
        """high - low."""
        return self.high - self.low


@dataclass(frozen=True)
class FirstOrderFit:
    """What was found of one speed."""

    dead_time: Interval
    lag: Interval
    gain: Interval
    is_inside: bool
    """Do the intervals of dead time and lag end within what was searched?"""
    noise: float
    """Standard deviation of one increment's noise, in the unit of the increments."""
    white_noise: float
    """Standard deviation of the white noise of one pose, in the same unit."""
    inflation: float
    """Factor by which correlated residuals make variances larger, at least 1."""
    explained: float
    """Share of the increments' mean square that the fit explains."""


class _Grid(NamedTuple):
    """Fits at each lag [s], shape (L,), and at dead times [s] of each, shape (L, D) as all that follows."""

    lags: Floats
    dead_times: Floats
    squares: Floats
    gains: Floats
    curvatures: Floats
    increments: int
    """How many increments were fitted."""

    @property
    def best(self) -> tuple[int, int]:
        """Row and column of the best fit."""
        i, j = np.unravel_index(int(np.argmin(self.squares)), self.squares.shape)
        return int(i), int(j)

    @property
    def point(self) -> _Point:
        """The best fit."""
        i, j = self.best
        return _Point(*(float(x) for x in (self.dead_times[i, j], self.lags[i], self.gains[i, j], self.squares[i, j])))

    @property
    def rise(self) -> Floats:
        """Twice the logarithm of the likelihood that is lost against the best point, shape (L, D)."""
        return np.asarray(self.increments * np.log(self.squares / self.squares.min()))


class _Point(NamedTuple):
    """A fit, and the sum of its squared whitened residuals."""

    dead_time: float
    lag: float
    gain: float
    squares: float


def fit_first_order(
    command: HeldCommand, seen: Increments, shortest_dead_time: float, has_offset: bool
) -> FirstOrderFit | None:
    """Dead time, lag and gain; None if the command never changes where there are poses.

    `has_offset`: a constant drift is fitted, too, as of a gyroscope.
    """
    dt = np.diff(seen.t)
    noise = IncrementNoise(dt, 0.5)
    lags = np.concatenate(([0.0], np.geomspace(0.02, LONGEST_LAG, 12)))
    dead_times = np.arange(shortest_dead_time, LONGEST_DEAD_TIME + _STEP, _STEP)
    problem = _Problem(command, seen, has_offset)
    for _ in range(2):
        grid = problem.fits(noise, lags, np.broadcast_to(dead_times, (len(lags), len(dead_times))))
        if not np.isfinite(grid.squares).any():
            return None
        best = problem.best_of(noise, grid, shortest_dead_time)
        noise = fitted_noise(problem.residuals(best), dt)
    best = problem.best_of(noise, grid, shortest_dead_time)
    spread = problem.spread(noise, best)
    grid = problem.around(noise, best, spread)
    return _summary(problem, grid, noise, spread.inflation, shortest_dead_time)


class _Problem(NamedTuple):
    """What is fitted to what."""

    command: HeldCommand
    seen: Increments
    has_offset: bool

    def nuisance(self, lag: float) -> list[Floats]:
        """Increments of what is not asked for: of the speed at the beginning, and of a constant drift."""
        t = self.seen.t
        columns = [np.diff(np.exp(-(t - t[0]) / lag))] if lag > 0.0 else []
        return [*columns, np.diff(t)] if self.has_offset else columns

    def projected(self, noise: IncrementNoise, lag: float, dead_times: Floats) -> tuple[Floats, Floats]:
        """Whitened increments of the model (D, N), and those seen (N,), both without their part along the nuisance."""
        x = noise.whitened(np.diff(self.command.positions(self.seen.t, lag, dead_times)))
        y = noise.whitened(self.seen.moved)
        nuisance = self.nuisance(lag)
        if not nuisance:
            return x, y
        q = np.linalg.qr(noise.whitened(np.array(nuisance)).T)[0]
        return x - (x @ q) @ q.T, y - q @ (q.T @ y)

    def fits(self, noise: IncrementNoise, lags: Floats, dead_times: Floats) -> _Grid:
        """The best gain at each lag and its dead times."""
        shape = dead_times.shape
        squares, gains, curvatures = np.full(shape, np.inf), np.zeros(shape), np.zeros(shape)
        for i, lag in enumerate(lags.tolist()):
            x, y = self.projected(noise, lag, dead_times[i])
            power = np.einsum("dn,dn->d", x, x)
            there = power > _NOTHING
            gain = np.where(there, x @ y / np.where(there, power, 1.0), 0.0)
            squares[i] = np.where(there, np.maximum(y @ y - gain * gain * power, 0.0) + len(y) * _RESOLUTION**2, np.inf)
            gains[i], curvatures[i] = gain, power
        return _Grid(lags, dead_times, squares, gains, curvatures, len(self.seen.moved))

    def around(self, noise: IncrementNoise, best: _Point, spread: _Spread) -> _Grid:
        """Fits at lags that reach as far as the likelihood allows, each at dead times about its best one."""
        threshold = CHI_SQUARE * max(spread.inflation)
        reach = max(_REACH * spread.lag * math.sqrt(max(spread.inflation)), _LEAST_REACH)
        low, high = max(0.0, best.lag - reach), best.lag + reach
        for _ in range(_ROUNDS):
            grid = self.valley(noise, best, low, high, 2.0 * math.sqrt(threshold) * spread.dead_time)
            rows = np.flatnonzero(_lowest(grid.rise) <= threshold)
            best, width, between = grid.point, high - low, (high - low) / (_ROWS - 1)
            if rows[0] == 0 and low > 0.0:
                low = max(0.0, low - width)
            elif rows[-1] == _ROWS - 1:
                high += width
            elif len(rows) < _ROWS // 3:
                low, high = max(0.0, low + (rows[0] - 2) * between), low + (rows[-1] + 2) * between
            else:
                break
        return grid

    def valley(self, noise: IncrementNoise, best: _Point, low: float, high: float, room: float) -> _Grid:
        """Fits at lags from `low` to `high`, at dead times up to `room` away from the best for each lag [s].

        Dead time and lag together are known better than each of them.
        """
        lags = np.linspace(low, high, _ROWS)
        centres, across = best.dead_time + best.lag - lags, max(0.5 * (high - low), room)
        for _ in range(_CENTRINGS):  # without noise the best places jump about by rounding, without end
            grid = self.fits(noise, lags, centres[:, np.newaxis] + np.linspace(-across, across, _COLUMNS))
            columns = np.argmin(grid.squares, axis=1)
            if across <= room and (np.abs(columns - _COLUMNS // 2) <= _COLUMNS // 4).all():
                return grid
            at_edge = bool(((columns == 0) | (columns == _COLUMNS - 1)).any())
            centres = grid.dead_times[np.arange(_ROWS), columns]
            if across > LONGEST_DEAD_TIME:
                break
            across = 1.5 * across if at_edge else max(room, across / 5.0)
        return grid

    def best_of(self, noise: IncrementNoise, grid: _Grid, shortest: float) -> _Point:
        """The best fit that is reached from the best dead time of any of the lags that fit well."""
        columns = np.argmin(grid.squares, axis=1)
        promising = np.argsort(grid.squares[np.arange(len(columns)), columns])[:_STARTS].tolist()
        starts = [_Point(float(grid.dead_times[i, columns[i]]), float(grid.lags[i]), 0.0, 0.0) for i in promising]
        return min((self.refined(noise, start, shortest) for start in starts), key=lambda point: point.squares)

    def refined(self, noise: IncrementNoise, start: _Point, shortest: float) -> _Point:
        """The best fit near another one, by Levenberg and Marquardt's method within what is searched."""
        best, damping = self.point(noise, start.dead_time, start.lag), 1e-3
        for _ in range(_ITERATIONS):
            slopes, left = self.slopes(noise, best)
            normal = slopes @ slopes.T
            if best.lag == 0.0 and float(np.linalg.pinv(normal)[1] @ (slopes @ left)) < 0.0:
                normal[1], normal[:, 1], slopes[1] = 0.0, 0.0, 0.0  # the lag stays at its bound
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + _NOTHING), slopes @ left)
            tried = self.point(
                noise,
                min(max(best.dead_time + float(step[0]), shortest), LONGEST_DEAD_TIME),
                min(max(best.lag + float(step[1]), 0.0), LONGEST_LAG),
            )
            if tried.squares < best.squares:
                gained, best, damping = best.squares - tried.squares, tried, 0.2 * damping
                if gained < 1e-7 * best.squares:
                    break
            else:
                damping *= 8.0
                if damping > 1e6:
                    break
        return best

    def point(self, noise: IncrementNoise, dead_time: float, lag: float) -> _Point:
        """The best gain at one dead time and lag."""
        return self.fits(noise, np.array([lag]), np.array([[dead_time]])).point

    def slopes(self, noise: IncrementNoise, best: _Point) -> tuple[Floats, Floats]:
        """How whitened increments change with dead time, lag and gain, shape (3, N), and what the fit leaves, (N,)."""
        dead_times = best.dead_time + np.array([0.0, -_SMALL, _SMALL])
        x, y = self.projected(noise, best.lag, dead_times)
        longer = self.projected(noise, best.lag + _SMALL, dead_times[:1])[0][0]
        earlier, later = best.gain * (x[2] - x[1]) / (2.0 * _SMALL), best.gain * (longer - x[0]) / _SMALL
        return np.array([earlier, later, x[0]]), y - best.gain * x[0]

    def residuals(self, best: _Point) -> Floats:
        """Increments [m or rad] less those of the fit, shape (N,)."""
        modelled = np.diff(self.command.positions(self.seen.t, best.lag, np.array([best.dead_time])))[0]
        left, nuisance = self.seen.moved - best.gain * modelled, np.array(self.nuisance(best.lag)).T
        return np.asarray(left - nuisance @ np.linalg.lstsq(nuisance, left, rcond=None)[0]) if nuisance.size else left

    def spread(self, noise: IncrementNoise, best: _Point) -> _Spread:
        """How far the estimates may be off, by the slopes at the best fit."""
        slopes, left = self.slopes(noise, best)
        inverse, variance = np.linalg.pinv(slopes @ slopes.T), float(left @ left) / len(left) + _RESOLUTION**2
        real = np.diag(inverse @ _long_run(slopes * left) @ inverse)
        ratios = real / np.maximum(variance * np.diag(inverse), 1e-300)
        earlier, scale = slopes[0], slopes[2]
        alone = float(earlier @ earlier) - float(earlier @ scale) ** 2 / float(scale @ scale)
        return _Spread(
            math.sqrt(variance / max(alone, _NOTHING)),
            math.sqrt(variance * float(inverse[1, 1])),
            (max(1.0, float(ratios[0])), max(1.0, float(ratios[1])), max(1.0, float(ratios[2]))),
        )


class _Spread(NamedTuple):
    """Standard deviations [s] of a dead time at a known lag, and of the lag, and what correlated residuals do."""

    dead_time: float
    lag: float
    inflation: tuple[float, float, float]
    """Factors on the variances of dead time, lag and gain, each at least 1."""


def _long_run(scores: Floats) -> Floats:
    """Covariance of the sum of scores, shape (3, N), with Bartlett's weights; shape (3, 3)."""
    width = math.ceil(4.0 * (scores.shape[1] / 100.0) ** (1.0 / 3.0))
    total = scores @ scores.T
    for k in range(1, width + 1):
        apart = scores[:, k:] @ scores[:, :-k].T
        total = total + (1.0 - k / (width + 1.0)) * (apart + apart.T)
    return np.asarray(total)


def _is_closed(grid: _Grid, threshold: float) -> bool:
    """Does the likelihood fall by more than the threshold at all edges of the grid, but that of no lag at all?"""
    rise = grid.rise
    edges = [rise[:, 0], rise[:, -1], rise[-1], *([] if grid.lags[0] == 0.0 else [rise[0]])]
    return all(bool((edge > threshold).all()) for edge in edges)


def _summary(
    problem: _Problem, grid: _Grid, noise: IncrementNoise, inflation: tuple[float, float, float], shortest: float
) -> FirstOrderFit:
    best, rise = grid.point, grid.rise
    dead_time = Interval(best.dead_time, *_reach(grid.dead_times, rise, CHI_SQUARE * inflation[0]))
    lag = Interval(best.lag, *_crossings(grid.lags, _lowest(rise), CHI_SQUARE * inflation[1]))
    variance, most = best.squares / grid.increments, CHI_SQUARE * inflation[2]
    room = np.sqrt(np.maximum(most - rise, 0.0) * variance / np.maximum(grid.curvatures, _NOTHING))
    inside = rise <= most
    gain = Interval(best.gain, float((grid.gains - room)[inside].min()), float((grid.gains + room)[inside].max()))
    left, moved = problem.residuals(best), problem.seen.moved
    return FirstOrderFit(
        dead_time=dead_time,
        lag=lag,
        gain=gain,
        is_inside=_is_closed(grid, CHI_SQUARE * max(inflation))
        and dead_time.low > shortest
        and dead_time.high < LONGEST_DEAD_TIME
        and lag.high < LONGEST_LAG,
        noise=math.sqrt(float(left @ left) / len(left)),
        white_noise=math.sqrt(noise.white * variance),
        inflation=max(inflation),
        explained=1.0 - float(left @ left) / max(float(moved @ moved), _NOTHING),
    )


def _reach(dead_times: Floats, rise: Floats, threshold: float) -> tuple[float, float]:
    """Least and largest dead time at which the likelihood falls by no more than the threshold at any lag."""
    rows = [i for i in range(len(rise)) if float(rise[i].min()) <= threshold]
    ends = [_crossings(dead_times[i], rise[i], threshold) for i in rows]
    return min(low for low, _ in ends), max(high for _, high in ends)


def _lowest(rise: Floats) -> Floats:
    """The least rise of each row, of the parabola through the three places about its lowest."""
    columns, rows = np.argmin(rise, axis=1), np.arange(len(rise))
    lowest = rise[rows, columns]
    before, after = rise[rows, np.maximum(columns - 1, 0)], rise[rows, np.minimum(columns + 1, rise.shape[1] - 1)]
    bend = before - 2.0 * lowest + after
    usable = (columns > 0) & (columns < rise.shape[1] - 1) & (bend > 0.0)
    drop = np.where(usable, (before - after) ** 2 / (8.0 * np.where(usable, bend, 1.0)), 0.0)
    return np.asarray(np.maximum(lowest - drop, 0.0))


def _crossings(places: Floats, rise: Floats, threshold: float) -> tuple[float, float]:
    """Where a profile crosses the threshold on both sides of its lowest, linear between places."""
    rows = np.flatnonzero(rise <= threshold)
    low, high = int(rows[0]), int(rows[-1])
    return _crossing(places, rise, threshold, low, low - 1), _crossing(places, rise, threshold, high, high + 1)


def _crossing(places: Floats, rise: Floats, threshold: float, inside: int, outside: int) -> float:
    if not 0 <= outside < len(places):
        return float(places[inside])
    share = (threshold - rise[inside]) / (rise[outside] - rise[inside])
    return float(places[inside] + share * (places[outside] - places[inside]))
