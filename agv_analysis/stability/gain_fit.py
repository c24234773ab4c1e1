"""The gains of a control law from the errors that it got and the commands that it gave.

Least squares on the law's own derivatives: with J = df/dg at the gains g,

    u(k) - f(eps(k), g) = J(k) (g' - g),

exact for a law that is linear in its gains, repeated (Gauss-Newton) for another one. Only commands within the limit of
the speed go in. What is found must give all commands again; else nothing is found.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.edge_answers import answers_to_errors, differs, sizes_of
from agv_analysis.simulation.single import settings_of
from agv_analysis.stability.error_dynamics import derivatives_of_part
from agv_cloud.control.registry import CONTROL_LAWS
from agv_ros.parts import PartError

_ITERATIONS = 8
_CONVERGED = 1e-12
"""Change of a gain, relative to it, that ends the iteration."""

_ROUNDING = 1e-15
"""Error of a recorded command, relative to the largest: that of its own arithmetic."""

_TOLD = 1e-7
"""The errors determine a gain if rounding changes it by less than this, relative to it."""

_BELOW_LIMIT = 1.0 - 1e-9
"""Commands below this share of the largest |v| are taken for unlimited."""

_MOST_ROWS = 1000
"""Commands that are fitted: so many evenly spread, and as many of those that the law with its own gains misses most.

All are held against what is found.
"""

_ALLOWED = 10.0
"""How many times the tolerance of a comparison a command may be off under gains that were found, which are rounded."""


class Samples(NamedTuple):
    """Steps of a recording at which both error and command are known."""

    error: Floats
    """x_e, y_e, theta_e [m, m, rad], shape (M, 3)."""
    speeds: Floats
    """v_r, w_r [m/s, rad/s] that came with them, shape (M, 2)."""
    command: Floats
    """v, w [m/s, rad/s] as sent, shape (M, 2)."""

    def rows(self, begin: int, end: int | None = None) -> Samples:
        """Those of the steps from one to before another."""
        return Samples(*(values[begin:end] for values in self))

    def chosen(self, rows: NDArray[np.int64]) -> Samples:
        """Some of the steps."""
        return Samples(*(values[rows] for values in self))


class Driven(NamedTuple):
    """A control law that gives recorded commands: (s_v v, s_w w) of the law with these gains, |v| then limited."""

    gains: tuple[float, ...]
    v_max: float
    """[m/s]; inf: no limit is seen in the commands."""
    factors: tuple[float, float] = (1.0, 1.0)
    """s_v, s_w."""
    untold: tuple[int, ...] = ()
    """Numbers of the gains that the errors do not tell: those in `gains` are as good as others."""


def agreement(driven: Driven, samples: Samples, scenario: Scenario) -> NDArray[np.bool_]:
    """Which commands a law gives again, shape (M,); only for a law without memory."""
    unlimited = _unlimited(driven.gains, samples, scenario) * driven.factors
    unlimited[:, 0] = np.clip(unlimited[:, 0], -driven.v_max, driven.v_max)
    with np.errstate(invalid="ignore"):
        return ~differs(sizes_of(unlimited - samples.command) / _ALLOWED, samples.command)


def explain(samples: Samples, scenario: Scenario) -> Driven | None:
    """The law of a scenario with the gains that give all of these commands, the nearest to its own; None: none do.

    Only for a law without memory. Raises PartError if it cannot be differentiated.
    """
    for candidate in _candidates(samples, scenario):
        if agreement(candidate, samples, scenario).all():
            return candidate
    return None


def _candidates(samples: Samples, scenario: Scenario) -> Iterator[Driven]:
    """Laws that may be it, those before that change less."""
    own, gains = scenario.controller.v_max, scenario.controller.gains
    peak = float(np.abs(samples.command[:, 0]).max())
    limits = [own, *(limit for limit in (math.inf, peak) if limit != own)]
    yield from (Driven(gains, limit) for limit in limits)
    turned = ((1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))
    yield from (Driven(gains, limit, factors) for factors in turned for limit in limits)
    chosen = samples.chosen(_fitted_rows(samples, scenario))
    below = _below_limit(chosen, min(own, peak))
    for found, untold in _fitted(chosen, below, scenario):
        yield from (Driven(found, limit, untold=untold) for limit in limits)
    s_v, s_w = _factors(chosen, below, scenario)
    scaled = ((1.0, s_w), (s_v, 1.0), (s_v, s_w))
    yield from (Driven(gains, limit, factors) for factors in scaled for limit in limits)


def _unlimited(gains: Sequence[float], samples: Samples, scenario: Scenario) -> Floats:
    settings = settings_of(scenario)._replace(gains=tuple(gains), v_max=math.inf)
    return answers_to_errors(samples.error, samples.speeds, (), settings, scenario)[0]


def _fitted_rows(samples: Samples, scenario: Scenario) -> NDArray[np.int64]:
    """Numbers of the steps that go into a fit, increasing."""
    count = len(samples.command)
    if count <= 2 * _MOST_ROWS:
        return np.arange(count)
    missed = sizes_of(_unlimited(scenario.controller.gains, samples, scenario) - samples.command)
    missed[np.abs(samples.command[:, 0]) >= np.abs(samples.command[:, 0]).max() * _BELOW_LIMIT] = 0.0
    spread = np.linspace(0, count - 1, _MOST_ROWS).astype(np.int64)
    return np.union1d(spread, np.argpartition(missed, -_MOST_ROWS)[-_MOST_ROWS:])


def _below_limit(samples: Samples, limit: float) -> NDArray[np.bool_]:
    """Which of the numbers v, w of each command no limit can have changed, shape (M, 2)."""
    below = np.ones(samples.command.shape, dtype=np.bool_)
    below[:, 0] = np.abs(samples.command[:, 0]) < limit * _BELOW_LIMIT
    return below


def _factors(samples: Samples, below: NDArray[np.bool_], scenario: Scenario) -> tuple[float, float]:
    """How many times the law's v and w the recorded ones are, by least squares; 1 where there are none."""
    law = _unlimited(scenario.controller.gains, samples, scenario)
    usable = below & np.isfinite(law)
    with np.errstate(over="ignore", invalid="ignore"):
        across = np.where(usable, law * samples.command, 0.0).sum(axis=0)
        squares = np.where(usable, law * law, 0.0).sum(axis=0)
    s_v, s_w = (float(a / s) if 0.0 < s < math.inf else 1.0 for a, s in zip(across, squares, strict=True))
    return s_v, s_w


# -- least squares -----------------------------------------------------------------------------------------------------


def _fitted(
    samples: Samples, below: NDArray[np.bool_], scenario: Scenario
) -> Iterator[tuple[tuple[float, ...], tuple[int, ...]]]:
    """Gains, with the numbers of those that the errors do not tell: these as the scenario has them, then all fitted."""
    count = len(scenario.controller.gains)
    gains, untold = _gauss_newton(samples, below, scenario, tuple(range(count)))
    if untold and len(untold) < count:
        told = tuple(i for i in range(count) if i not in untold)
        yield _gauss_newton(samples, below, scenario, told)[0], untold
    yield gains, untold


def _gauss_newton(
    samples: Samples, below: NDArray[np.bool_], scenario: Scenario, free: tuple[int, ...]
) -> tuple[tuple[float, ...], tuple[int, ...]]:
    """The scenario's gains, those that are `free` fitted, and which of these the errors do not tell."""
    law, controller = CONTROL_LAWS.find(scenario.controller.law), scenario.controller
    gains = np.array(controller.gains, dtype=np.float64)
    columns, untold = list(free), free
    for _ in range(_ITERATIONS):
        x_e, y_e, theta_e, v_r, w_r = np.column_stack([samples.error, samples.speeds]).T.copy()
        arguments = (x_e, y_e, theta_e, v_r, w_r, (), tuple(gains.tolist()), controller.ts, controller.look_ahead)
        found = derivatives_of_part(law.where, law.adapter, arguments, [5 + i for i in free])
        left = samples.command - found.value[:, :2]
        usable = below & np.isfinite(left) & np.isfinite(found.derivative[:, :2]).all(axis=2)
        if not usable.any():
            break
        step, spread = _least_squares(found.derivative[:, :2][usable], left[usable])
        gains[columns] += step
        scale = np.maximum(1.0, np.abs(gains[columns]))
        rounding = _ROUNDING * max(1.0, float(np.abs(samples.command).max()))
        untold = tuple(i for i, wrong in zip(free, rounding * spread / scale, strict=True) if not wrong < _TOLD)
        if not np.isfinite(gains).all():
            raise PartError(f"{law.where}: its gains cannot be estimated")
        if (np.abs(step) <= _CONVERGED * scale).all():
            break
    return tuple(gains.tolist()), untold


def _least_squares(matrix: Floats, right: Floats) -> tuple[Floats, Floats]:
    """The shortest x with least |A x - b|, and by how much a unit of noise in b spreads it; shapes (m,).

    Columns are brought to length one first. A column without any number in it has an unlimited spread.
    """
    lengths = np.linalg.norm(matrix, axis=0)
    scale = np.where(lengths > 0.0, lengths, 1.0)
    left, singular, turned = np.linalg.svd(matrix / scale, full_matrices=False)
    smallest = np.finfo(np.float64).eps * max(matrix.shape)
    kept = singular > smallest * max(1.0, float(singular.max()))
    inverse = np.divide(1.0, singular, out=np.zeros_like(singular), where=kept)
    with np.errstate(over="ignore"):
        spread = np.sqrt(((turned.T / np.maximum(singular, np.finfo(np.float64).tiny)) ** 2).sum(axis=1))
    spread[lengths == 0.0] = math.inf
    return (turned.T @ (inverse * (left.T @ right))) / scale, spread / scale
