"""What a sweep consists of: axes, points, seeds, and the parts that it is done in."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from agv_analysis.scenario import SCHEMAS, Scenario
from agv_analysis.simulation.single import steps_of
from agv_ros.errors import UserError
from agv_ros.parameters import SHARED, KnownParameters, as_dict, build, parameters_of
from agv_ros.params_file import parse_setting

MAX_POINTS = 1_000_000
MAX_VALUES = 10_000

_RUNS_PER_PART = 512
"""A part is kept when it is done, and it is what a cluster's worker takes: about half a second of a core for a lap."""

_POINTS_PER_PART = 4096


class SweepError(UserError):
    """A sweep that cannot be done as asked for."""


@dataclass(frozen=True)
class Axis:
    """A parameter and the values that it takes."""

    node: str
    parameter: str
    values: tuple[Any, ...]

    @property
    def name(self) -> str:
        """The parameter as `--vary` and the columns of the results name it: controller.kx."""
        return f"{self.node}.{self.parameter}"


def known_parameters() -> Mapping[str, KnownParameters]:
    """What each node of a loop has of parameters, by their names."""
    return {node: parameters_of(schema) for node, schema in SCHEMAS.items()}


def axis_of(name: str, values: Iterable[Any]) -> Axis:
    """Axis of the parameter `node.parameter` over values of its type; a whole number is taken for a double.

    Raises SweepError for no parameter or no values, ParameterError for a value that is not allowed.
    """
    node, _, parameter = name.partition(".")
    known = known_parameters()[node].get(parameter) if node in SCHEMAS else None
    if known is None:
        raise SweepError(
            f"{name} is not a parameter; expected node.parameter, as in controller.kx, with a node of "
            f"{', '.join(SCHEMAS)}"
        )
    plain = [value.item() if isinstance(value, np.generic) else value for value in values]
    if known.kind == "double":
        plain = [float(value) if type(value) is int else value for value in plain]
    found = tuple(known.check(node, value) for value in plain)
    if not found or len(set(found)) < len(found):
        raise SweepError(f"{name}: must have values, each once, got {list(found)}")
    return Axis(node, parameter, found)


def parse_axis(text: str) -> Axis:
    """Axis from `node.parameter=first:last:count`, evenly spaced, or `node.parameter=a,b,c`.

    Raises SweepError for another form, ParameterError for an unknown parameter or a value of a wrong type.
    """
    name, _, literals = text.partition("=")
    try:
        values = _spaced(literals) if ":" in literals else [literal.strip() for literal in literals.split(",")]
    except ValueError as error:
        raise SweepError(
            f"--vary {text}: {error}; expected node.parameter=first:last:count, as in controller.kx=5:400:40, "
            "or a list, as in relay.uplink.n=0,5,10"
        ) from None
    known = known_parameters()
    parsed = [parse_setting(f"{name}={value}", known, "--vary") for value in values]
    node, parameter, _ = parsed[0]
    found = tuple(known[node][parameter].check(node, value) for _, _, value in parsed)
    if len(set(found)) < len(found):
        raise SweepError(f"--vary {text}: a value is named twice, and its runs would be the same")
    return Axis(node, parameter, found)


def _spaced(literals: str) -> list[str]:
    """Literals of the values first:last:count; whole numbers without a point, as an integer parameter wants them."""
    parts = literals.split(":")
    if len(parts) != 3:
        raise ValueError(f"{literals!r} has {len(parts)} parts")
    first, last, count = float(parts[0]), float(parts[1]), int(parts[2])
    if not (math.isfinite(first) and math.isfinite(last)):
        raise ValueError(f"{literals!r} has an end that is not finite")
    if not 2 <= count <= MAX_VALUES:
        raise ValueError(f"{literals!r} has {count} values, must be 2 to {MAX_VALUES}")
    return [
        f"{value:.0f}" if value == round(value) else repr(value) for value in np.linspace(first, last, count).tolist()
    ]


@dataclass(frozen=True)
class Part:
    """Points and seeds that are run together, as half-open ranges of their numbers."""

    number: int
    points: tuple[int, int]
    seeds: tuple[int, int]

    @property
    def runs(self) -> int:
        """Number of runs."""
        return (self.points[1] - self.points[0]) * (self.seeds[1] - self.seeds[0])

    @property
    def block(self) -> tuple[slice, slice]:
        """The part's place in a table of all runs, shape (points, seeds)."""
        return slice(*self.points), slice(*self.seeds)


@dataclass(frozen=True)
class Sweep:
    """Every combination of the axes' values on top of a base scenario, each under every seed.

    Raises SweepError for axes that do not go together.
    """

    base: Scenario
    axes: tuple[Axis, ...]
    seed_count: int

    def __post_init__(self) -> None:
        """Check what no single axis can say."""
        names = [axis.name for axis in self.axes]
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            raise SweepError(f"--vary {twice[0]}: the parameter is varied twice")
        for name in ("relay.seed", "plant.seed"):
            if name in names:
                raise SweepError(f"--vary {name}: seeds are what --seeds counts, from relay.seed on")
        if self.size > MAX_POINTS:
            raise SweepError(f"{self.size} points, at most {MAX_POINTS} are possible: take fewer values an axis")
        if self.seed_count < 1:
            raise SweepError(f"--seeds must be at least 1, got {self.seed_count}")

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values of each axis."""
        return tuple(len(axis.values) for axis in self.axes)

    @property
    def size(self) -> int:
        """Number of points."""
        return math.prod(self.shape)

    @property
    def seeds(self) -> range:
        """The seeds, from that of the base scenario on."""
        first = self.base.relay.seed
        return range(first, first + self.seed_count)

    def values(self, point: int) -> tuple[Any, ...]:
        """What each axis' parameter is at a point; the last axis varies fastest."""
        indices = np.unravel_index(point, self.shape) if self.axes else ()
        return tuple(axis.values[index] for axis, index in zip(self.axes, indices, strict=True))

    def scenario(self, point: int) -> Scenario:
        """The scenario of a point. Raises ParameterError for values that do not go together."""
        return varied(self.base, self.axes, self.values(point))

    def check(self) -> None:
        """Raise UserError if a corner of the grid cannot be run, before hours are spent on the rest of it."""
        for indices in itertools.product(*((0, -1) for _ in self.axes)):
            values = [axis.values[index] for axis, index in zip(self.axes, indices, strict=True)]
            steps_of(varied(self.base, self.axes, values))

    def parts(self) -> list[Part]:
        """All runs in parts that depend on nothing but the sweep: all points under a few seeds, then the next seeds.

        So the whole grid is there early, only coarser, and points share the random numbers of their seeds.
        """
        points = [(first, min(first + _POINTS_PER_PART, self.size)) for first in range(0, self.size, _POINTS_PER_PART)]
        step = max(1, _RUNS_PER_PART // min(self.size, _POINTS_PER_PART))
        seeds = [(first, min(first + step, self.seed_count)) for first in range(0, self.seed_count, step)]
        return [Part(number, block[1], block[0]) for number, block in enumerate(itertools.product(seeds, points))]


def varied(base: Scenario, axes: Sequence[Axis], values: Sequence[Any]) -> Scenario:
    """`base` with each axis' parameter set to a value; one that all nodes share is set for all.

    Raises ParameterError for values that do not go together.
    """
    changes: dict[str, dict[str, Any]] = {}
    for axis, value in zip(axes, values, strict=True):
        for node in SCHEMAS if axis.parameter in SHARED else (axis.node,):
            changes.setdefault(node, {})[axis.parameter] = value
    nodes: dict[str, Any] = {
        node: build(SCHEMAS[node], {**as_dict(getattr(base, node)), **change}, node) for node, change in changes.items()
    }
    return dataclasses.replace(base, **nodes)
