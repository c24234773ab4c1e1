"""Value and derivatives of a function at N points."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from agv_analysis.stability.derivatives.branches import Floats, Rows
from agv_analysis.stability.derivatives.dual import NUMBER
from agv_analysis.stability.derivatives.evaluation import Sweep, assembled

_BLOCK = 65_536
"""Derivatives per block of rows: 512 KiB, small enough for the cache and large enough to hide the cost of a call."""


class Kink(NamedTuple):
    """A place in the code at which the function is not differentiable at some rows."""

    rows: Rows
    """Row numbers, increasing."""
    where: str
    """Function, file, line and text of the source line: "limit_speed (control_law.py:31): return min(...)"."""


class Jacobian(NamedTuple):
    """A function's value and first derivatives at N points."""

    value: Floats
    """Shape (N, outputs)."""
    derivative: Floats
    """Shape (N, outputs, inputs). At a kink that of the branch taken there, at a jump that of the side taken."""
    not_differentiable: tuple[Kink, ...]
    """Kinks, one for each place in the code, in the order in which they were found."""


def jacobian(function: Callable[..., Any], arguments: Sequence[Any], with_respect_to: Sequence[int]) -> Jacobian:
    """Value and exact derivatives of a scalar function at N points.

    `function` takes its arguments by position and returns a number or a (nested) tuple, list or array of numbers, which
    is flattened in order. It is called several times, so a call must not depend on those before it.

    An argument is an array of shape (N,), one number a row, or a constant of any type, the same for all rows (a plain
    function among them is copied by `differentiable`), or a (nested) tuple of these. N is 1 without an array.

    `with_respect_to` counts leaves: the arguments in order, a tuple as its elements. In (x, (a, b), gain) they are
    x: 0, a: 1, b: 2, gain: 3.

    What the function raises passes through. Where float arithmetic would raise (division by zero, the logarithm of a
    negative number), the row gets inf or NaN instead, and no numpy warning is given.

    Raises TypeError if the result or an input is not numeric, ValueError if shapes or `with_respect_to` do not fit.
    """
    leaves = list(_leaves(tuple(arguments)))
    _check_inputs(leaves, with_respect_to)
    count = _row_count(leaves)
    sweep = Sweep(function, tuple(arguments), _arrays(leaves, with_respect_to, count), tuple(with_respect_to))
    block = max(1, _BLOCK // max(4, len(with_respect_to)))
    pieces = [
        piece
        for begin in range(0, count, block)
        for piece in sweep.evaluate(np.arange(begin, min(begin + block, count)))
    ]
    piece = assembled(pieces, sweep.name)
    kinks = tuple(Kink(np.unique(np.concatenate(rows)), where) for where, rows in sweep.kinks.items())
    return Jacobian(piece.value, piece.derivative, kinks)


def _leaves(argument: Any) -> Iterator[Any]:
    if isinstance(argument, tuple):
        for element in argument:
            yield from _leaves(element)
    else:
        yield argument


def _check_inputs(leaves: Sequence[Any], with_respect_to: Sequence[int]) -> None:
    if len(set(with_respect_to)) != len(with_respect_to):
        raise ValueError(f"with_respect_to names an input twice: {tuple(with_respect_to)}")
    for leaf in with_respect_to:
        if not 0 <= leaf < len(leaves):
            raise ValueError(f"with_respect_to: {leaf} is not in 0 .. {len(leaves) - 1}, the leaves of the arguments")
        if not isinstance(leaves[leaf], (*NUMBER, np.ndarray)):
            raise TypeError(f"input {leaf} must be a number or an array of shape (N,), got {leaves[leaf]!r}")


def _row_count(leaves: Sequence[Any]) -> int:
    shapes = {position: leaf.shape for position, leaf in enumerate(leaves) if isinstance(leaf, np.ndarray)}
    if not shapes:
        return 1
    expected = next(iter(shapes.values()))
    for position, shape in shapes.items():
        if len(shape) != 1 or shape != expected or shape == (0,):
            raise ValueError(f"arrays must have one shape (N,), N > 0: argument leaf {position} has {shape}")
    return int(expected[0])


def _arrays(leaves: Sequence[Any], with_respect_to: Sequence[int], count: int) -> dict[int, Floats]:
    """The leaves that become dual numbers, by position; each of shape (count,)."""
    dual = [p for p, leaf in enumerate(leaves) if isinstance(leaf, np.ndarray) or p in with_respect_to]
    return {p: np.broadcast_to(np.asarray(leaves[p], dtype=np.float64), (count,)) for p in dual}
