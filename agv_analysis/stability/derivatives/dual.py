"""Dual numbers: a value and its derivatives at many points, with the arithmetic of a float."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from agv_analysis.stability.derivatives.branches import Floats, Mask, decide, outcome_of, report, report_singular

Inputs = tuple[int, ...]
Scalar: TypeAlias = "Dual | int | float | np.floating[Any] | np.integer[Any] | np.bool_"

NUMBER = (int, float, np.floating, np.integer, np.bool_)
"""What counts as a number beside a Dual."""

UFUNCS: dict[Any, Callable[..., Any]] = {}
"""Versions of numpy's ufuncs for dual numbers; `numpy_functions` puts them here."""

ARRAY_FUNCTIONS: dict[Any, Callable[..., Any]] = {}
"""The same of numpy's other functions."""


class Dual:
    """Values and derivatives at N rows, for arithmetic as with a float.

    `value` has shape (N,) and `derivative` shape (K, N), for the K inputs on which the number depends: `inputs`, their
    positions in `with_respect_to`, increasing. It is never changed in place.
    """

    __slots__ = ("derivative", "inputs", "value")

    def __init__(self, value: Floats, derivative: Floats, inputs: Inputs) -> None:
        self.value = value
        self.derivative = derivative
        self.inputs = inputs

    def __repr__(self) -> str:
        return f"Dual(value={self.value!r}, derivative={self.derivative!r}, inputs={self.inputs})"

    def __format__(self, specification: str) -> str:
        """The first row's value, so that the messages of exceptions read as with floats."""
        return format(float(self.value[0]), specification)

    # Arithmetic

    def __add__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            derivative, inputs = _sum(self.derivative, self.inputs, other.derivative, other.inputs)
            return Dual(self.value + other.value, derivative, inputs)
        if isinstance(other, NUMBER):
            return Dual(self.value + other, self.derivative, self.inputs)
        return NotImplemented

    __radd__ = __add__

    def __sub__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            if self.inputs == other.inputs:
                return Dual(self.value - other.value, self.derivative - other.derivative, self.inputs)
            derivative, inputs = _sum(self.derivative, self.inputs, -other.derivative, other.inputs)
            return Dual(self.value - other.value, derivative, inputs)
        if isinstance(other, NUMBER):
            return Dual(self.value - other, self.derivative, self.inputs)
        return NotImplemented

    def __rsub__(self, other: Any) -> Dual:
        if isinstance(other, NUMBER):
            return Dual(other - self.value, -self.derivative, self.inputs)
        return NotImplemented

    def __mul__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return chain(self.value * other.value, (other.value, self), (self.value, other))
        if isinstance(other, NUMBER):
            return Dual(self.value * other, self.derivative * other, self.inputs)
        return NotImplemented

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Dual:
        if isinstance(other, (Dual, *NUMBER)):
            return _quotient(self, other)
        return NotImplemented

    def __rtruediv__(self, other: Any) -> Dual:
        if isinstance(other, NUMBER):
            return _quotient(other, self)
        return NotImplemented

    def __floordiv__(self, other: Any) -> Dual:
        return self.__divmod__(other)[0] if isinstance(other, (Dual, *NUMBER)) else NotImplemented

    def __rfloordiv__(self, other: Any) -> Dual:
        return self.__rdivmod__(other)[0] if isinstance(other, NUMBER) else NotImplemented

    def __mod__(self, other: Any) -> Dual:
        return self.__divmod__(other)[1] if isinstance(other, (Dual, *NUMBER)) else NotImplemented

    def __rmod__(self, other: Any) -> Dual:
        return self.__rdivmod__(other)[1] if isinstance(other, NUMBER) else NotImplemented

    def __divmod__(self, other: Any) -> tuple[Dual, Dual]:
        return _floor_division(self, other) if isinstance(other, (Dual, *NUMBER)) else NotImplemented

    def __rdivmod__(self, other: Any) -> tuple[Dual, Dual]:
        return _floor_division(other, self) if isinstance(other, NUMBER) else NotImplemented

    def __pow__(self, other: Any) -> Dual:
        return power(self, other) if isinstance(other, (Dual, *NUMBER)) else NotImplemented

    def __rpow__(self, other: Any) -> Dual:
        return power(other, self) if isinstance(other, NUMBER) else NotImplemented

    def __neg__(self) -> Dual:
        return Dual(-self.value, -self.derivative, self.inputs)

    def __pos__(self) -> Dual:
        return self

    def __abs__(self) -> Dual:
        if moving(self.value == 0.0, self).any():
            return self if self >= 0.0 else -self  # a tie, to be evaluated along both branches
        return Dual(np.abs(self.value), np.sign(self.value) * self.derivative, self.inputs)

    # Steps: derivative 0, and a jump where the argument lies on the edge of a step

    def __floor__(self) -> Dual:
        return step(self, np.floor(self.value), self.value == np.floor(self.value))

    def __ceil__(self) -> Dual:
        return step(self, np.ceil(self.value), self.value == np.ceil(self.value))

    def __trunc__(self) -> Dual:
        whole = np.trunc(self.value)
        return step(self, whole, (self.value == whole) & (whole != 0.0))

    def __round__(self, digits: int | None = None) -> Dual:
        scaled = self.value * 10.0 ** (digits or 0)
        return step(self, np.round(self.value, digits or 0), scaled - np.floor(scaled) == 0.5)

    # Comparisons

    def __lt__(self, other: Any) -> bool:
        return cast(bool, _compared(np.less, self, other))

    def __le__(self, other: Any) -> bool:
        return cast(bool, _compared(np.less_equal, self, other))

    def __gt__(self, other: Any) -> bool:
        return cast(bool, _compared(np.greater, self, other))

    def __ge__(self, other: Any) -> bool:
        return cast(bool, _compared(np.greater_equal, self, other))

    def __eq__(self, other: object) -> bool:
        return cast(bool, _compared(np.equal, self, other))

    def __ne__(self, other: object) -> bool:
        return cast(bool, _compared(np.not_equal, self, other))

    __hash__ = None  # type: ignore[assignment]  # equal in which rows?

    def __bool__(self) -> bool:
        return self != 0.0

    # Conversions

    def __float__(self) -> float:
        raise TypeError(_conversion("float()"))

    def __int__(self) -> int:
        raise TypeError(_conversion("int()"))

    def __index__(self) -> int:
        """The integer that all rows hold, as an index or for range(); rows that hold another one are split off."""
        if self.inputs:
            raise TypeError(_conversion("an index or range()"))
        first = self.value[0]
        if first != np.floor(first):
            raise TypeError(f"an index must be an integer, got {first}")
        decide(self.value == first)
        return int(first)

    # numpy

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *operands: Any, **options: Any) -> Any:
        function = UFUNCS.get(ufunc)
        if function is None or method != "__call__" or options:
            raise TypeError(f"numpy.{ufunc.__name__} ({method}) has no version for dual numbers")
        if any(isinstance(operand, np.ndarray) and operand.ndim for operand in operands):
            return _elementwise(function, operands)
        return function(*(operand.item() if isinstance(operand, np.ndarray) else operand for operand in operands))

    def __array_function__(
        self, function: Callable[..., Any], kinds: Any, arguments: Sequence[Any], options: Mapping[str, Any]
    ) -> Any:
        version = ARRAY_FUNCTIONS.get(function)
        if version is None:
            raise TypeError(f"numpy.{function.__name__} has no version for dual numbers")
        return version(*arguments, **options)


def _conversion(to: str) -> str:
    return (
        f"a Dual was converted by {to}, which would lose its derivative: the code that did it has no version for dual "
        f"numbers (a method, a compiled extension, or a function of a module that differentiable() leaves alone); "
        f"make it a plain function of floats"
    )


def constant(value: Floats) -> Dual:
    """A number that depends on the row alone."""
    return Dual(value, np.empty((0, len(value))), ())


def value_of(operand: Scalar) -> Any:
    """Value of a dual number, or the number itself."""
    return operand.value if isinstance(operand, Dual) else operand


@functools.lru_cache(maxsize=4096)
def _union(first: Inputs, second: Inputs) -> tuple[Inputs, list[tuple[int, int]]]:
    """Union of two sets of inputs, and for each of its elements the positions in both sets, -1 where it is not in."""
    union = tuple(sorted({*first, *second}))
    return union, [
        (first.index(i) if i in first else -1, second.index(i) if i in second else -1) for i in union
    ]  # fmt: skip


def _sum(a: Floats, a_inputs: Inputs, b: Floats, b_inputs: Inputs) -> tuple[Floats, Inputs]:
    """Sum of two derivatives, and the inputs that it is for."""
    if a_inputs == b_inputs:
        return a + b, a_inputs
    if not b_inputs:
        return a, a_inputs
    if not a_inputs:
        return b, b_inputs
    inputs, positions = _union(a_inputs, b_inputs)
    rows = [
        a[in_a] if in_b < 0 else b[in_b] if in_a < 0 else a[in_a] + b[in_b] for in_a, in_b in positions
    ]  # fmt: skip
    return np.stack(rows), inputs


def chain(value: Floats, *terms: tuple[Any, Scalar]) -> Dual:
    """The dual number of this value whose derivative is the sum of factor * derivative of operand over the terms."""
    derivative, inputs = np.empty((0, len(value))), ()  # type: tuple[Floats, Inputs]
    for factor, operand in terms:
        if isinstance(operand, Dual) and operand.inputs:
            product = factor * operand.derivative
            if inputs == operand.inputs:
                derivative += product  # in place: a product of an earlier term
            else:
                derivative, inputs = _sum(derivative, inputs, product, operand.inputs)
    return Dual(value, derivative, inputs)


def _quotient(a: Scalar, b: Scalar) -> Dual:
    value = np.true_divide(value_of(a), value_of(b))
    inverse = np.true_divide(1.0, value_of(b))
    return chain(value, (inverse, a), (-value * inverse if isinstance(b, Dual) else 0.0, b))


def _floor_division(a: Scalar, b: Scalar) -> tuple[Dual, Dual]:
    """a // b and a % b, which jump where b divides a."""
    whole = np.floor_divide(value_of(a), value_of(b))
    rest = chain(np.remainder(value_of(a), value_of(b)), (1.0, a), (-whole, b))
    report(moving(rest.value == 0.0, rest))
    return constant(whole), rest


def power(a: Scalar, b: Scalar) -> Dual:
    """a ** b, where one of them at least is a dual number."""
    x, y = value_of(a), value_of(b)
    value = x**y
    by_base = by_exponent = cast(Floats, np.zeros(1))
    if isinstance(a, Dual) and a.inputs:
        by_base = np.where(y == 0.0, 0.0, y * x ** (y - 1.0))
        report_singular(a.value, value, by_base)
    if isinstance(b, Dual) and b.inputs:
        by_exponent = np.where(value == 0.0, 0.0, value * np.log(x))
    return chain(value, (by_base, a), (by_exponent, b))


def step(x: Dual, value: Floats, edge: Mask) -> Dual:
    """A value with derivative 0 that jumps where x lies on an edge."""
    report(moving(edge, x))
    return constant(value)


def _compared(ufunc: np.ufunc, a: Dual, b: Any) -> Any:
    """Outcome (bool) of a comparison for all rows; raises Split or Tie where there is none."""
    if not isinstance(b, (Dual, *NUMBER)):
        return NotImplemented
    other = value_of(b)
    outcome: Mask = ufunc(a.value, other)
    equal: Mask = a.value == other
    return outcome_of(outcome, moving(equal, a, b)) if equal.any() else decide(outcome)


def moving(mask: Mask, a: Dual, b: Scalar = 0.0) -> Mask:
    """The rows of the mask in which the derivative of a - b is not zero."""
    if not mask.any():
        return mask
    derivative = (a - b).derivative if isinstance(b, Dual) else a.derivative
    return np.asarray(mask & np.any(derivative != 0.0, axis=0))


def _elementwise(function: Callable[..., Any], operands: Sequence[Any]) -> NDArray[np.object_]:
    """A function of dual numbers over arrays of numbers, which become arrays of objects."""
    boxes = []
    for operand in operands:
        box = np.empty(operand.shape if isinstance(operand, np.ndarray) else (), dtype=np.object_)
        box[()] = operand
        boxes.append(box)
    boxes = list(np.broadcast_arrays(*boxes))
    result = np.empty(boxes[0].shape, dtype=np.object_)
    for index in np.ndindex(result.shape):
        result[index] = function(*(box[index] for box in boxes))
    return result
