"""Interval arithmetic: bounds instead of numbers, so that one call of a function holds for all inputs within bounds.

Bounds of a result hold whatever numbers within their bounds the inputs are (Moore, Interval Analysis, 1966). A `Dual`
whose value and derivatives are Intervals bounds both over a whole box of inputs. Its derivatives then contain every
mean slope between two points of the box. Rounding is not followed: it is some 1e-16 of a number in each operation.

A comparison that not all numbers within the bounds answer alike has no outcome: it raises NoBoundsError.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeAlias, cast

import numpy as np

from agv_analysis.stability.derivatives.branches import Floats, Mask
from agv_analysis.stability.derivatives.dual import Dual

Operand: TypeAlias = "Interval | Floats | float"


class NoBoundsError(ArithmeticError):
    """Numbers within the bounds take different branches of a function, or it has no version for intervals."""


class Interval:
    """Bounds of an array of numbers, `low` <= number <= `high`, of one shape; never changed in place."""

    __slots__ = ("high", "low")

    def __init__(self, low: Floats, high: Floats) -> None:
        self.low = low
        self.high = high

    def __repr__(self) -> str:
        return f"Interval(low={self.low!r}, high={self.high!r})"

    @property
    def shape(self) -> tuple[int, ...]:
        """As of an array."""
        return np.shape(self.low)

    @property
    def largest(self) -> Floats:
        """The largest size that a number within has."""
        return cast(Floats, np.maximum(np.abs(self.low), np.abs(self.high)))

    def __len__(self) -> int:
        return len(self.low)

    def __iter__(self) -> Iterator[Interval]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: Any) -> Interval:
        return Interval(self.low[index], self.high[index])

    def __add__(self, other: Operand) -> Interval:
        return _added(self, other)

    __radd__ = __add__

    def __sub__(self, other: Operand) -> Interval:
        return _subtracted(self, other)

    def __rsub__(self, other: Operand) -> Interval:
        return _subtracted(other, self)

    def __mul__(self, other: Operand) -> Interval:
        return _multiplied(self, other)

    __rmul__ = __mul__

    def __truediv__(self, other: Operand) -> Interval:
        return _divided(self, other)

    def __rtruediv__(self, other: Operand) -> Interval:
        return _divided(other, self)

    def __neg__(self) -> Interval:
        return Interval(-self.high, -self.low)

    def __lt__(self, other: Operand) -> Mask:
        return _less(self, other)

    def __le__(self, other: Operand) -> Mask:
        return ~_less(other, self)

    def __gt__(self, other: Operand) -> Mask:
        return _less(other, self)

    def __ge__(self, other: Operand) -> Mask:
        return ~_less(self, other)

    def __eq__(self, other: object) -> Mask:  # type: ignore[override]
        """Where both are surely the same number; numpy.equal, a branch of a function, raises where that is open."""
        return _surely_equal(self, cast(Operand, other))

    def __ne__(self, other: object) -> Mask:  # type: ignore[override]
        return ~_surely_equal(self, cast(Operand, other))

    __hash__ = None  # type: ignore[assignment]

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *operands: Any, **options: Any) -> Any:
        version = _UFUNCS.get(ufunc)
        if version is None or method != "__call__" or options:
            raise NoBoundsError(f"numpy.{ufunc.__name__} ({method}) has no version for intervals")
        return version(*operands)

    def __array_function__(
        self, function: Callable[..., Any], kinds: Any, arguments: Sequence[Any], options: Mapping[str, Any]
    ) -> Any:
        if function is not np.stack or options:
            raise NoBoundsError(f"numpy.{function.__name__} has no version for intervals")
        return stacked(arguments[0])


def variable(value: Interval, position: int) -> Dual:
    """The input of this position, anywhere within bounds of shape (N,)."""
    one = np.ones((1, len(value)))
    return Dual(cast(Any, value), cast(Any, Interval(one, one)), (position,))


def within(value: Interval) -> Dual:
    """What depends on the row alone, and is known to lie within bounds of shape (N,)."""
    return Dual(cast(Any, value), np.empty((0, len(value))), ())


def bounds_of(number: Any) -> Interval:
    """Bounds of a Dual of Intervals, or of a number."""
    return Interval(*_bounds(number.value if isinstance(number, Dual) else np.full(1, number)))


def slopes(number: Any, inputs: Iterable[int]) -> list[Interval]:
    """Bounds of the derivatives of a Dual of Intervals, or of a number, with respect to `inputs`."""
    if not isinstance(number, Dual):
        return [_ZERO for _ in inputs]
    derivative = cast(Any, number.derivative)
    return [derivative[number.inputs.index(i)] if i in number.inputs else _ZERO for i in inputs]


def stacked(rows: Iterable[Interval]) -> Interval:
    """As numpy.stack, of rows whose shapes are broadcast."""
    bounds = [_bounds(row) for row in rows]
    return Interval(*(np.stack(np.broadcast_arrays(*side)) for side in zip(*bounds, strict=True)))


def product(a: Interval, b: Interval) -> Interval:
    """The product of matrices, shapes (n, m, N) and (m, p, N); shape (n, p, N)."""
    terms = a[:, :, None] * b[None]
    return Interval(terms.low.sum(axis=1), terms.high.sum(axis=1))


def _bounds(operand: Operand) -> tuple[Any, Any]:
    return (operand.low, operand.high) if isinstance(operand, Interval) else (operand, operand)


def _added(a: Operand, b: Operand) -> Interval:
    (a_low, a_high), (b_low, b_high) = _bounds(a), _bounds(b)
    return Interval(a_low + b_low, a_high + b_high)


def _subtracted(a: Operand, b: Operand) -> Interval:
    (a_low, a_high), (b_low, b_high) = _bounds(a), _bounds(b)
    return Interval(a_low - b_high, a_high - b_low)


def _multiplied(a: Operand, b: Operand) -> Interval:
    if not isinstance(b, Interval):
        a, b = b, a
    (low, high), (least, most) = _bounds(b), _bounds(a)
    if a is b:
        one, other = low * low, high * high
        holds_zero = (low <= 0.0) & (high >= 0.0)
        return Interval(np.where(holds_zero, 0.0, np.minimum(one, other)), np.maximum(one, other))
    one, other = least * low, least * high
    bottom, top = np.minimum(one, other), np.maximum(one, other)
    if isinstance(a, Interval):  # else it is one number, not two
        one, other = most * low, most * high
        bottom, top = np.minimum(bottom, np.minimum(one, other)), np.maximum(top, np.maximum(one, other))
    return Interval(bottom, top)


def _divided(a: Operand, b: Operand) -> Interval:
    low, high = _bounds(b)
    if np.any((low <= 0.0) & (high >= 0.0)):
        raise NoBoundsError("a division by what may be zero")
    return _multiplied(a, Interval(1.0 / high, 1.0 / low))


def _absolute(a: Interval) -> Interval:
    inside = (a.low <= 0.0) & (a.high >= 0.0)
    return Interval(np.where(inside, 0.0, np.minimum(np.abs(a.low), np.abs(a.high))), a.largest)


def _sign(a: Interval) -> Interval:
    """Of what may be zero anything from -1 to 1: so are the mean slopes of |x| about 0."""
    return Interval(np.where(a.low > 0.0, 1.0, -1.0), np.where(a.high < 0.0, -1.0, 1.0))


def _cosine(a: Interval) -> Interval:
    at_low, at_high = np.cos(a.low), np.cos(a.high)
    low, high, turn = np.minimum(at_low, at_high), np.maximum(at_low, at_high), 2.0 * math.pi
    has_top = np.floor(a.high / turn) >= np.ceil(a.low / turn)
    has_bottom = np.floor((a.high - math.pi) / turn) >= np.ceil((a.low - math.pi) / turn)
    return Interval(np.where(has_bottom, -1.0, low), np.where(has_top, 1.0, high))


def _sine(a: Interval) -> Interval:
    return _cosine(a - 0.5 * math.pi)


def _rising(ufunc: np.ufunc) -> Callable[[Interval], Interval]:
    return lambda a: Interval(ufunc(a.low), ufunc(a.high))


def _decided(yes: Any, no: Any) -> Mask:
    if not np.all(yes | no):
        raise NoBoundsError("a comparison that not all numbers within their bounds answer alike")
    return np.asarray(yes, dtype=np.bool_)


def _less(a: Operand, b: Operand) -> Mask:
    (a_low, a_high), (b_low, b_high) = _bounds(a), _bounds(b)
    return _decided(a_high < b_low, a_low >= b_high)


def _surely_equal(a: Operand, b: Operand) -> Mask:
    (a_low, a_high), (b_low, b_high) = _bounds(a), _bounds(b)
    return np.asarray((a_low == a_high) & (b_low == b_high) & (a_low == b_low))


def _equal(a: Operand, b: Operand) -> Mask:
    (a_low, a_high), (b_low, b_high) = _bounds(a), _bounds(b)
    return _decided(_surely_equal(a, b), (a_high < b_low) | (b_high < a_low))


def _is_finite(a: Interval) -> Mask:
    return np.isfinite(a.low) & np.isfinite(a.high)


_UFUNCS: dict[np.ufunc, Callable[..., Any]] = {
    np.add: _added,
    np.subtract: _subtracted,
    np.multiply: _multiplied,
    np.true_divide: _divided,
    np.negative: lambda a: -a,
    np.absolute: _absolute,
    np.sign: _sign,
    np.cos: _cosine,
    np.sin: _sine,
    **{ufunc: _rising(ufunc) for ufunc in (np.sqrt, np.exp, np.arctan)},
    np.less: _less,
    np.less_equal: lambda a, b: ~_less(b, a),
    np.greater: lambda a, b: _less(b, a),
    np.greater_equal: lambda a, b: ~_less(a, b),
    np.equal: _equal,
    np.not_equal: lambda a, b: ~_equal(a, b),
    np.isfinite: _is_finite,
    np.isnan: lambda a: np.isnan(a.low) | np.isnan(a.high),
}
"""Versions of numpy's ufuncs; what has none is refused."""

_ZERO = Interval(np.zeros(1), np.zeros(1))
