"""Exact first derivatives of plain scalar functions, at many points at once: forward mode with dual numbers.

    jacobian(control_law, (x_e, y_e, theta_e, v_r, w_r, 25.0, 40.0, 10.0), with_respect_to=(0, 1, 2))

Theory of operation. A dual number holds a value and its derivatives, and arithmetic on it follows the chain rule. Here
value and derivatives are arrays over N points (rows), so that one call of a function written for floats differentiates
it at all of them. What else such a function needs:

* `math` and the builtins `float`, `int`, `min`, `max` accept floats only, or would branch at every call.
  `differentiable` copies a function, and the plain functions that it calls, with versions of these for dual numbers.
* A comparison on which all rows agree is an ordinary bool. Otherwise it raises `_Split`, and the function is called
  again for each of the two groups of rows. Rows are put back in order at the end.
* Where both sides of a comparison are equal although their derivatives differ (a tie), a neighbouring point may take
  the other branch. These rows are evaluated along both branches (`_Tie`): if value and derivatives agree, as for
  v |v| at 0, the point is differentiable; otherwise it is reported as a `Kink`.

A dual number stores the derivatives with respect to those inputs alone on which it depends. This saves time, and keeps
a zero exact where another factor is not finite: sqrt(x) + y at x = 0 still has the derivative 1 with respect to y.
"""

from __future__ import annotations

import builtins
import contextvars
import dataclasses
import functools
import linecache
import math
import sys
import threading
import types
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]
Inputs = tuple[int, ...]
Scalar: TypeAlias = "Dual | int | float | np.floating[Any] | np.integer[Any] | np.bool_"
Function = TypeVar("Function", bound=Callable[..., Any])

_BLOCK = 65_536
"""Derivatives per block of rows: 512 KiB, small enough for the cache and large enough to hide the cost of a call."""

_TIES_EXPLORED = 4
"""Ties on one path through a function that are evaluated along both branches; further ones are reported as kinks."""

_LEFT_ALONE = sys.stdlib_module_names | {"numba", "numpy", "scipy"}
"""Top-level modules whose functions are not copied."""

_NUMBER = (int, float, np.floating, np.integer, np.bool_)


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
    sweep = _Sweep(function, tuple(arguments), _arrays(leaves, with_respect_to, count), tuple(with_respect_to))
    block = max(1, _BLOCK // max(4, len(with_respect_to)))
    pieces = [
        piece
        for begin in range(0, count, block)
        for piece in sweep.evaluate(np.arange(begin, min(begin + block, count)))
    ]
    piece = _assembled(pieces, sweep.name)
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
        if not isinstance(leaves[leaf], (*_NUMBER, np.ndarray)):
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


# Dual numbers


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
        if isinstance(other, _NUMBER):
            return Dual(self.value + other, self.derivative, self.inputs)
        return NotImplemented

    __radd__ = __add__

    def __sub__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            if self.inputs == other.inputs:
                return Dual(self.value - other.value, self.derivative - other.derivative, self.inputs)
            derivative, inputs = _sum(self.derivative, self.inputs, -other.derivative, other.inputs)
            return Dual(self.value - other.value, derivative, inputs)
        if isinstance(other, _NUMBER):
            return Dual(self.value - other, self.derivative, self.inputs)
        return NotImplemented

    def __rsub__(self, other: Any) -> Dual:
        if isinstance(other, _NUMBER):
            return Dual(other - self.value, -self.derivative, self.inputs)
        return NotImplemented

    def __mul__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return _chain(self.value * other.value, (other.value, self), (self.value, other))
        if isinstance(other, _NUMBER):
            return Dual(self.value * other, self.derivative * other, self.inputs)
        return NotImplemented

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Dual:
        if isinstance(other, (Dual, *_NUMBER)):
            return _quotient(self, other)
        return NotImplemented

    def __rtruediv__(self, other: Any) -> Dual:
        if isinstance(other, _NUMBER):
            return _quotient(other, self)
        return NotImplemented

    def __floordiv__(self, other: Any) -> Dual:
        return self.__divmod__(other)[0] if isinstance(other, (Dual, *_NUMBER)) else NotImplemented

    def __rfloordiv__(self, other: Any) -> Dual:
        return self.__rdivmod__(other)[0] if isinstance(other, _NUMBER) else NotImplemented

    def __mod__(self, other: Any) -> Dual:
        return self.__divmod__(other)[1] if isinstance(other, (Dual, *_NUMBER)) else NotImplemented

    def __rmod__(self, other: Any) -> Dual:
        return self.__rdivmod__(other)[1] if isinstance(other, _NUMBER) else NotImplemented

    def __divmod__(self, other: Any) -> tuple[Dual, Dual]:
        return _floor_division(self, other) if isinstance(other, (Dual, *_NUMBER)) else NotImplemented

    def __rdivmod__(self, other: Any) -> tuple[Dual, Dual]:
        return _floor_division(other, self) if isinstance(other, _NUMBER) else NotImplemented

    def __pow__(self, other: Any) -> Dual:
        return _power(self, other) if isinstance(other, (Dual, *_NUMBER)) else NotImplemented

    def __rpow__(self, other: Any) -> Dual:
        return _power(other, self) if isinstance(other, _NUMBER) else NotImplemented

    def __neg__(self) -> Dual:
        return Dual(-self.value, -self.derivative, self.inputs)

    def __pos__(self) -> Dual:
        return self

    def __abs__(self) -> Dual:
        if _moving(self.value == 0.0, self).any():
            return self if self >= 0.0 else -self  # a tie, to be evaluated along both branches
        return Dual(np.abs(self.value), np.sign(self.value) * self.derivative, self.inputs)

    # Steps: derivative 0, and a jump where the argument lies on the edge of a step

    def __floor__(self) -> Dual:
        return _step(self, np.floor(self.value), self.value == np.floor(self.value))

    def __ceil__(self) -> Dual:
        return _step(self, np.ceil(self.value), self.value == np.ceil(self.value))

    def __trunc__(self) -> Dual:
        whole = np.trunc(self.value)
        return _step(self, whole, (self.value == whole) & (whole != 0.0))

    def __round__(self, digits: int | None = None) -> Dual:
        scaled = self.value * 10.0 ** (digits or 0)
        return _step(self, np.round(self.value, digits or 0), scaled - np.floor(scaled) == 0.5)

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
        _decide(self.value == first)
        return int(first)

    # numpy

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *operands: Any, **options: Any) -> Any:
        function = _UFUNCS.get(ufunc)
        if function is None or method != "__call__" or options:
            raise TypeError(f"numpy.{ufunc.__name__} ({method}) has no version for dual numbers")
        if any(isinstance(operand, np.ndarray) and operand.ndim for operand in operands):
            return _elementwise(function, operands)
        return function(*(operand.item() if isinstance(operand, np.ndarray) else operand for operand in operands))

    def __array_function__(
        self, function: Callable[..., Any], kinds: Any, arguments: Sequence[Any], options: Mapping[str, Any]
    ) -> Any:
        version = _ARRAY_FUNCTIONS.get(function)
        if version is None:
            raise TypeError(f"numpy.{function.__name__} has no version for dual numbers")
        return version(*arguments, **options)


def _conversion(to: str) -> str:
    return (
        f"a Dual was converted by {to}, which would lose its derivative: the code that did it has no version for dual "
        f"numbers (a method, a compiled extension, or a function of a module that differentiable() leaves alone); "
        f"make it a plain function of floats"
    )


def _constant(value: Floats) -> Dual:
    """A number that depends on the row alone."""
    return Dual(value, np.empty((0, len(value))), ())


def _value(operand: Scalar) -> Any:
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
    total = np.empty((len(inputs), a.shape[1]))
    for k, (in_a, in_b) in enumerate(positions):
        if in_b < 0:
            total[k] = a[in_a]
        elif in_a < 0:
            total[k] = b[in_b]
        else:
            np.add(a[in_a], b[in_b], out=total[k])
    return total, inputs


def _chain(value: Floats, *terms: tuple[Any, Scalar]) -> Dual:
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
    value = np.true_divide(_value(a), _value(b))
    inverse = np.true_divide(1.0, _value(b))
    return _chain(value, (inverse, a), (-value * inverse if isinstance(b, Dual) else 0.0, b))


def _floor_division(a: Scalar, b: Scalar) -> tuple[Dual, Dual]:
    """a // b and a % b, which jump where b divides a."""
    whole = np.floor_divide(_value(a), _value(b))
    rest = _chain(np.remainder(_value(a), _value(b)), (1.0, a), (-whole, b))
    _report(_moving(rest.value == 0.0, rest))
    return _constant(whole), rest


def _power(a: Scalar, b: Scalar) -> Dual:
    x, y = _value(a), _value(b)
    value = x**y
    by_base = by_exponent = cast(Floats, np.zeros(1))
    if isinstance(a, Dual) and a.inputs:
        by_base = np.where(y == 0.0, 0.0, y * x ** (y - 1.0))
        _report_singular(a, value, by_base)
    if isinstance(b, Dual) and b.inputs:
        by_exponent = np.where(value == 0.0, 0.0, value * np.log(x))
    return _chain(value, (by_base, a), (by_exponent, b))


def _step(x: Dual, value: Floats, edge: Mask) -> Dual:
    _report(_moving(edge, x))
    return _constant(value)


# Comparisons, ties and kinks


class _Split(BaseException):
    """The rows disagree: those of the mask are to be evaluated apart from the others."""

    def __init__(self, mask: Mask) -> None:
        self.mask = mask


class _Tie(BaseException):
    """In all rows both sides of a comparison are equal: to be evaluated along both branches."""

    def __init__(self, outcome: bool, where: str) -> None:
        self.outcome = outcome
        self.where = where


@dataclasses.dataclass
class _Trial:
    """One call of the function for some rows."""

    rows: Rows
    forced: tuple[bool, ...]
    """Outcomes of its first ties."""
    ties: int = 0
    """Ties met so far."""
    kinks: list[tuple[str, Rows]] = dataclasses.field(default_factory=list)

    def outcome_of_tie(self, outcome: bool) -> bool:
        self.ties += 1
        if self.ties <= len(self.forced):
            return self.forced[self.ties - 1]
        if self.ties <= _TIES_EXPLORED:
            raise _Tie(outcome, _where())
        self.kinks.append((_where(), self.rows))
        return outcome


_TRIAL: contextvars.ContextVar[_Trial | None] = contextvars.ContextVar("_TRIAL", default=None)


def _compared(ufunc: np.ufunc, a: Dual, b: Any) -> Any:
    """Outcome (bool) of a comparison for all rows; raises _Split or _Tie where there is none."""
    if not isinstance(b, (Dual, *_NUMBER)):
        return NotImplemented
    other = _value(b)
    outcome: Mask = ufunc(a.value, other)
    equal: Mask = a.value == other
    if equal.any():
        tied = _moving(equal, a, b)
        if tied.all():
            trial = _TRIAL.get()
            return bool(outcome[0]) if trial is None else trial.outcome_of_tie(bool(outcome[0]))
        if tied.any():
            _decide(tied)
    return _decide(outcome)


def _decide(outcome: Mask) -> bool:
    """The outcome of all rows; raises _Split if they disagree."""
    if outcome.all():
        return True
    if not outcome.any():
        return False
    if _TRIAL.get() is None:
        raise TypeError("a comparison of Duals whose rows disagree has no outcome: call the function by jacobian()")
    raise _Split(outcome)


def _moving(mask: Mask, a: Dual, b: Scalar = 0.0) -> Mask:
    """The rows of the mask in which the derivative of a - b is not zero."""
    if not mask.any():
        return mask
    derivative = (a - b).derivative if isinstance(b, Dual) else a.derivative
    return np.asarray(mask & np.any(derivative != 0.0, axis=0))


def _report(mask: Mask) -> None:
    """Record rows at which the function is not differentiable."""
    trial = _TRIAL.get()
    if trial is not None and mask.any():
        trial.kinks.append((_where(), trial.rows[mask]))


def _report_singular(x: Dual, value: Floats, slope: Floats) -> None:
    """Record rows with a value, but no finite slope: sqrt(0)."""
    finite = np.isfinite(slope)
    if not finite.all():
        _report(np.isfinite(value) & ~finite & np.isfinite(x.value))


def _where() -> str:
    """Function and source line that called into this module or, from there, into numpy."""
    frame = sys._getframe(1)
    while frame.f_back is not None and str(frame.f_globals.get("__name__")).startswith((__name__, "numpy.")):
        frame = frame.f_back
    code, line = frame.f_code, frame.f_lineno
    text = linecache.getline(code.co_filename, line).strip()
    return f"{code.co_name} ({Path(code.co_filename).name}:{line}): {text}"


# Evaluation: rows in groups that take the same path through the function


class _Piece(NamedTuple):
    """Results at some rows: value of shape (n, outputs), derivative of shape (n, outputs, inputs)."""

    rows: Rows
    value: Floats
    derivative: Floats


class _Sweep:
    """Evaluation of a function at groups of rows."""

    def __init__(
        self, function: Callable[..., Any], arguments: tuple[Any, ...], arrays: dict[int, Floats], inputs: Inputs
    ) -> None:
        self.name = getattr(function, "__qualname__", repr(function))
        self.kinks: dict[str, list[Rows]] = {}
        self._function = _substitute(function)
        self._arguments = arguments
        self._arrays = arrays
        self._inputs = inputs

    def evaluate(self, rows: Rows, forced: tuple[bool, ...] = ()) -> list[_Piece]:
        """Results at these rows, in pieces; `forced` are the outcomes of the first ties."""
        pending, pieces = [rows], []
        while pending:
            group = pending.pop()
            try:
                pieces.append(self._call(group, forced))
            except _Split as split:
                pending += [group[~split.mask], group[split.mask]]
            except _Tie as tie:
                pieces.append(self._along_both(group, forced, tie))
        return pieces

    def _call(self, rows: Rows, forced: tuple[bool, ...]) -> _Piece:
        trial = _Trial(rows, forced)
        token = _TRIAL.set(trial)
        try:
            with np.errstate(all="ignore"):
                result = self._function(*self._arguments_at(rows))
        finally:
            _TRIAL.reset(token)
        for where, at in trial.kinks:
            self._record(where, at)
        return self._piece(rows, list(self._outputs(result, result)))

    def _along_both(self, rows: Rows, forced: tuple[bool, ...], tie: _Tie) -> _Piece:
        """Results at tied rows for the outcome that the comparison has; where the other differs, there is a kink."""
        chosen = _assembled(self.evaluate(rows, (*forced, tie.outcome)), self.name)
        try:
            other = _assembled(self.evaluate(rows, (*forced, not tie.outcome)), self.name)
        except Exception:  # the other branch may be meant never to be taken here
            self._record(tie.where, rows)
            return chosen
        self._record(tie.where, chosen.rows[~_agree(chosen, other)])
        return chosen

    def _record(self, where: str, rows: Rows) -> None:
        if len(rows):
            self.kinks.setdefault(where, []).append(rows)

    def _arguments_at(self, rows: Rows) -> tuple[Any, ...]:
        position = -1

        def rebuilt(argument: Any) -> Any:
            nonlocal position
            if isinstance(argument, tuple):
                elements = [rebuilt(element) for element in argument]
                return argument._make(elements) if hasattr(argument, "_make") else tuple(elements)
            position += 1
            return self._dual(position, rows) if position in self._arrays else _substitute(argument)

        return tuple(rebuilt(argument) for argument in self._arguments)

    def _dual(self, position: int, rows: Rows) -> Dual:
        value = self._arrays[position][rows]
        if position not in self._inputs:
            return _constant(value)
        return Dual(value, np.ones((1, len(rows))), (self._inputs.index(position),))

    def _outputs(self, result: Any, whole: Any) -> Iterator[Scalar]:
        if isinstance(result, (Dual, *_NUMBER)):
            yield result
        elif isinstance(result, (tuple, list, np.ndarray)):
            for element in result.tolist() if isinstance(result, np.ndarray) else result:
                yield from self._outputs(element, whole)
        else:
            raise TypeError(f"{self.name} must return a number or a tuple of numbers, got {whole!r}")

    def _piece(self, rows: Rows, outputs: list[Scalar]) -> _Piece:
        value = np.empty((len(rows), len(outputs)))
        derivative = np.zeros((len(rows), len(outputs), len(self._inputs)))
        for i, output in enumerate(outputs):
            value[:, i] = _value(output)
            if isinstance(output, Dual):
                for row, j in zip(output.derivative, output.inputs, strict=True):
                    derivative[:, i, j] = row
        return _Piece(rows, value, derivative)


def _assembled(pieces: list[_Piece], name: str) -> _Piece:
    """Pieces as one, in the order of their rows."""
    if len(pieces) == 1:
        return pieces[0]
    counts = sorted({piece.value.shape[1] for piece in pieces})
    if len(counts) > 1:
        raise TypeError(f"{name} must return as many numbers at all rows, got {' and '.join(map(str, counts))}")
    rows = np.concatenate([piece.rows for piece in pieces])
    order = np.argsort(rows, kind="stable")
    rank = np.empty_like(rows)
    rank[order] = np.arange(len(rows))
    value = np.empty((len(rows), *pieces[0].value.shape[1:]))
    derivative = np.empty((len(rows), *pieces[0].derivative.shape[1:]))
    ends = np.cumsum([len(piece.rows) for piece in pieces])
    for piece, at in zip(pieces, np.split(rank, ends[:-1]), strict=True):
        value[at], derivative[at] = piece.value, piece.derivative
    return _Piece(rows[order], value, derivative)


def _agree(one: _Piece, other: _Piece) -> Mask:
    """Where are value and derivatives the same but for round-off? Shape (n,)."""
    if one.value.shape != other.value.shape:
        return np.zeros(len(one.rows), dtype=np.bool_)
    value = np.isclose(one.value, other.value, 1e-9, 1e-12, equal_nan=True).all(axis=1)
    derivative = np.isclose(one.derivative, other.derivative, 1e-9, 1e-12, equal_nan=True).all(axis=(1, 2))
    return np.asarray(value & derivative)


# Versions of mathematical functions for dual numbers; without one they are the functions themselves


def _smooth(
    usual: Callable[[float], float], evaluate: Callable[[Floats], Any], slope: Callable[[Floats, Floats], Any]
) -> Callable[[Any], Any]:
    """A function of one argument by its value f(x) and the slope df/dx(x, f(x)), both of shape (N,)."""

    def apply(x: Any) -> Any:
        if not isinstance(x, Dual):
            return usual(x)
        value = evaluate(x.value)
        if not x.inputs:
            return _constant(value)
        factor = slope(x.value, value)
        _report_singular(x, value, factor)
        return Dual(value, factor * x.derivative, x.inputs)

    return apply


def _each(usual: Callable[[float], float]) -> Callable[[Floats], Floats]:
    return lambda x: np.array([usual(number) for number in x.tolist()])


_SMOOTH: dict[str, tuple[Callable[[Floats], Any], Callable[[Floats, Floats], Any]]] = {
    "sin": (np.sin, lambda x, f: np.cos(x)),
    "cos": (np.cos, lambda x, f: -np.sin(x)),
    "tan": (np.tan, lambda x, f: 1.0 + f * f),
    "asin": (np.arcsin, lambda x, f: 1.0 / np.sqrt((1.0 - x) * (1.0 + x))),
    "acos": (np.arccos, lambda x, f: -1.0 / np.sqrt((1.0 - x) * (1.0 + x))),
    "atan": (np.arctan, lambda x, f: 1.0 / (1.0 + x * x)),
    "sinh": (np.sinh, lambda x, f: np.cosh(x)),
    "cosh": (np.cosh, lambda x, f: np.sinh(x)),
    "tanh": (np.tanh, lambda x, f: np.cosh(x) ** -2.0),
    "asinh": (np.arcsinh, lambda x, f: 1.0 / np.hypot(1.0, x)),
    "acosh": (np.arccosh, lambda x, f: 1.0 / (np.sqrt(x - 1.0) * np.sqrt(x + 1.0))),
    "atanh": (np.arctanh, lambda x, f: 1.0 / ((1.0 - x) * (1.0 + x))),
    "exp": (np.exp, lambda x, f: f),
    "exp2": (np.exp2, lambda x, f: math.log(2.0) * f),
    "expm1": (np.expm1, lambda x, f: np.exp(x)),
    "log2": (np.log2, lambda x, f: 1.0 / (math.log(2.0) * x)),
    "log10": (np.log10, lambda x, f: 1.0 / (math.log(10.0) * x)),
    "log1p": (np.log1p, lambda x, f: 1.0 / (1.0 + x)),
    "sqrt": (np.sqrt, lambda x, f: 0.5 / f),
    "cbrt": (np.cbrt, lambda x, f: 1.0 / (3.0 * f * f)),
    "degrees": (np.degrees, lambda x, f: np.full_like(x, 180.0 / math.pi)),
    "radians": (np.radians, lambda x, f: np.full_like(x, math.pi / 180.0)),
    "erf": (_each(math.erf), lambda x, f: 2.0 / math.sqrt(math.pi) * np.exp(-x * x)),
    "erfc": (_each(math.erfc), lambda x, f: -2.0 / math.sqrt(math.pi) * np.exp(-x * x)),
}
"""Value f(x) and slope df/dx(x, f) of functions of the math module."""

_natural_log = _smooth(math.log, np.log, lambda x, f: 1.0 / x)


def _has_dual(arguments: Sequence[Any]) -> bool:
    return any(isinstance(argument, Dual) for argument in arguments)


def _log(x: Any, *base: Any) -> Any:
    if not base or not _has_dual((x, *base)):
        return math.log(x, *base) if not isinstance(x, Dual) else _natural_log(x)
    return _natural_log(x) / _natural_log(base[0])


def _atan2(y: Any, x: Any) -> Any:
    if not _has_dual((y, x)):
        return math.atan2(y, x)
    a, b = _value(y), _value(x)
    square = np.add(np.multiply(a, a), np.multiply(b, b))
    angle = _chain(np.arctan2(a, b), (b / square, y), (-a / square, x))
    cut = np.equal(a, 0.0) & np.less_equal(b, 0.0)
    if cut.any():
        _report(_moving(cut & np.ones(len(angle.value), dtype=np.bool_), angle))
    return angle


def _hypot(*coordinates: Any) -> Any:
    if not _has_dual(coordinates):
        return math.hypot(*coordinates)
    value = functools.reduce(np.hypot, map(_value, coordinates), np.zeros(1))
    length = _chain(value, *((_value(x) / value, x) for x in coordinates))
    _report(_moving(value == 0.0, length))
    return length


def _dist(p: Sequence[Any], q: Sequence[Any]) -> Any:
    return _hypot(*(a - b for a, b in zip(p, q, strict=True)))


def _pow(x: Any, y: Any) -> Any:
    return _power(x, y) if _has_dual((x, y)) else math.pow(x, y)


def _fabs(x: Any) -> Any:
    return abs(x) if isinstance(x, Dual) else math.fabs(x)


def _copysign(x: Any, y: Any) -> Any:
    if not _has_dual((x, y)):
        return math.copysign(x, y)
    a, b = _value(x), _value(y)
    result = _chain(np.copysign(a, b), (np.copysign(1.0, a) * np.copysign(1.0, b), x))
    for operand, edge in ((x, result.value == 0.0), (y, np.equal(b, 0.0) & (result.value != 0.0))):
        if isinstance(operand, Dual):
            _report(_moving(edge, operand))
    return result


def _fmod(x: Any, y: Any) -> Any:
    if not _has_dual((x, y)):
        return math.fmod(x, y)
    value = np.fmod(_value(x), _value(y))
    whole = np.rint((_value(x) - value) / _value(y))
    rest = _chain(value, (1.0, x), (-whole, y))
    _report(_moving((value == 0.0) & (whole != 0.0), rest))
    return rest


def _remainder(x: Any, y: Any) -> Any:
    """The rest x - n y for the integer n nearest to x / y, the even one of two; exact, as fmod is."""
    if not _has_dual((x, y)):
        return math.remainder(x, y)
    rest, size = np.fmod(_value(x), _value(y)), np.abs(_value(y))
    odd = np.fmod(np.rint((_value(x) - rest) / _value(y)), 2.0) != 0.0
    beyond = (2.0 * np.abs(rest) > size) | ((2.0 * np.abs(rest) == size) & odd)
    value = np.where(beyond, rest - np.copysign(size, rest), rest)
    result = _chain(value, (1.0, x), (-np.rint((_value(x) - value) / _value(y)), y))
    _report(_moving(2.0 * np.abs(value) == size, result))
    return result


def _fsum(terms: Any) -> Any:
    terms = list(terms)
    return sum(terms, 0.0) if _has_dual(terms) else math.fsum(terms)


def _prod(factors: Any, *, start: Any = 1) -> Any:
    factors = list(factors)
    if not _has_dual((*factors, start)):
        return math.prod(factors, start=start)
    return functools.reduce(lambda product, factor: product * factor, factors, start)


def _isclose(a: Any, b: Any, *, rel_tol: float = 1e-09, abs_tol: float = 0.0) -> bool:
    if not _has_dual((a, b)):
        return math.isclose(a, b, rel_tol=rel_tol, abs_tol=abs_tol)
    x, y = np.broadcast_arrays(_value(a), _value(b))
    close = np.abs(x - y) <= np.maximum(rel_tol * np.maximum(np.abs(x), np.abs(y)), abs_tol)
    return _decide((x == y) | (close & np.isfinite(x) & np.isfinite(y)))


def _test(usual: Callable[[float], bool], ufunc: np.ufunc) -> Callable[[Any], bool]:
    return lambda x: _decide(ufunc(x.value)) if isinstance(x, Dual) else usual(x)


def _sign(x: Dual) -> Dual:
    return _step(x, np.sign(x.value), x.value == 0.0)


def _selected(a: Any, b: Any, prefers_b: Callable[[Any, Any], Any]) -> Any:
    """b in the rows where it is preferred, else a; as `b if prefers_b(b, a) else a`, but without splitting rows."""
    if not _has_dual((a, b)):
        return b if prefers_b(b, a) else a
    x, y = _value(a), _value(b)
    equal = np.equal(x, y)
    difference = a - b if isinstance(a, Dual) else b - a
    if _moving(equal, difference).any():
        return b if prefers_b(b, a) else a  # a tie, to be evaluated along both branches
    mask = prefers_b(y, x)
    if mask.all():
        return b
    if not mask.any():
        return a
    # Not a product with the mask: 0 times a derivative that is not finite would not be 0.
    of_a = Dual(x, np.where(mask, 0.0, a.derivative), a.inputs) if isinstance(a, Dual) else 0.0
    of_b = Dual(y, np.where(mask, b.derivative, 0.0), b.inputs) if isinstance(b, Dual) else 0.0
    return Dual(np.where(mask, y, x), *_derivative_of_sum(of_a, of_b))


def _derivative_of_sum(a: Scalar, b: Scalar) -> tuple[Floats, Inputs]:
    total = cast(Dual, a + b)
    return total.derivative, total.inputs


def _less(a: Any, b: Any) -> Any:
    return a < b


def _greater(a: Any, b: Any) -> Any:
    return a > b


def _extremum(usual: Callable[..., Any], prefers: Callable[[Any, Any], Any]) -> Callable[..., Any]:
    """The builtin min or max."""

    def apply(*arguments: Any, **options: Any) -> Any:
        if options:
            return usual(*arguments, **options)
        items = arguments if len(arguments) > 1 else tuple(arguments[0])
        if not _has_dual(items) or not all(isinstance(item, (Dual, *_NUMBER)) for item in items):
            return usual(items)
        return functools.reduce(lambda a, b: _selected(a, b, prefers), items)

    return apply


_min, _max = _extremum(min, _less), _extremum(max, _greater)


def _nan_or(extremum: Callable[..., Any]) -> Callable[[Any, Any], Any]:
    """numpy's minimum or maximum, which is NaN where an argument is."""

    def apply(a: Any, b: Any) -> Any:
        invalid = np.isnan(_value(a)) | np.isnan(_value(b))
        return a + b if invalid.any() and _decide(np.atleast_1d(invalid)) else extremum(a, b)

    return apply


class _FloatType(type):
    def __instancecheck__(cls, instance: object) -> bool:
        return isinstance(instance, (float, Dual))


class _Float(float, metaclass=_FloatType):
    """The builtin float, to which a Dual is a float already."""

    def __new__(cls, x: Any = 0.0) -> Any:
        return x if isinstance(x, Dual) else float(x)


class _IntType(type):
    def __instancecheck__(cls, instance: object) -> bool:
        return isinstance(instance, int)


class _Int(int, metaclass=_IntType):
    """The builtin int, for a Dual its integer part."""

    def __new__(cls, x: Any = 0, *base: Any) -> Any:
        return x.__trunc__() if isinstance(x, Dual) else int(x, *base)


_MATH: dict[str, Callable[..., Any]] = {
    **{name: _smooth(getattr(math, name), *pair) for name, pair in _SMOOTH.items() if hasattr(math, name)},
    "log": _log,
    "atan2": _atan2,
    "hypot": _hypot,
    "dist": _dist,
    "pow": _pow,
    "fabs": _fabs,
    "copysign": _copysign,
    "fmod": _fmod,
    "remainder": _remainder,
    "fsum": _fsum,
    "prod": _prod,
    "isclose": _isclose,
    "isfinite": _test(math.isfinite, np.isfinite),
    "isinf": _test(math.isinf, np.isinf),
    "isnan": _test(math.isnan, np.isnan),
}
"""Functions of the math module by name; its floor, ceil and trunc ask the argument and need no version."""

_DUAL_MATH = types.SimpleNamespace(**{**vars(math), **_MATH})

_NUMPY_SMOOTH = {
    "asin": "arcsin", "acos": "arccos", "atan": "arctan", "asinh": "arcsinh", "acosh": "arccosh", "atanh": "arctanh",
}  # fmt: skip
"""Functions whose ufunc has another name than that of the math module."""

_UFUNCS: dict[Any, Callable[..., Any]] = {
    **{
        getattr(np, _NUMPY_SMOOTH.get(name, name)): _smooth(lambda x: x, *pair)
        for name, pair in _SMOOTH.items()
        if name not in ("erf", "erfc")
    },
    np.deg2rad: _MATH["radians"],
    np.rad2deg: _MATH["degrees"],
    np.log: _natural_log,
    np.arctan2: _atan2,
    np.hypot: _hypot,
    np.copysign: _copysign,
    np.fmod: _fmod,
    np.isfinite: _MATH["isfinite"],
    np.isinf: _MATH["isinf"],
    np.isnan: _MATH["isnan"],
    np.minimum: _nan_or(_min),
    np.maximum: _nan_or(_max),
    np.sign: _sign,
    np.floor: math.floor,
    np.ceil: math.ceil,
    np.trunc: math.trunc,
    np.rint: round,
    np.absolute: abs,
    np.fabs: abs,
    np.positive: lambda x: x,
    np.negative: lambda x: -x,
    np.square: lambda x: x * x,
    np.reciprocal: lambda x: 1.0 / x,
    np.add: lambda a, b: _plain(a) + _plain(b),
    np.subtract: lambda a, b: _plain(a) - _plain(b),
    np.multiply: lambda a, b: _plain(a) * _plain(b),
    np.true_divide: lambda a, b: _plain(a) / _plain(b),
    np.floor_divide: lambda a, b: _plain(a) // _plain(b),
    np.remainder: lambda a, b: _plain(a) % _plain(b),
    np.divmod: lambda a, b: divmod(_plain(a), _plain(b)),
    np.power: lambda a, b: _plain(a) ** _plain(b),
    np.float_power: lambda a, b: _plain(a) ** _plain(b),
    np.less: lambda a, b: _plain(a) < _plain(b),
    np.less_equal: lambda a, b: _plain(a) <= _plain(b),
    np.greater: lambda a, b: _plain(a) > _plain(b),
    np.greater_equal: lambda a, b: _plain(a) >= _plain(b),
    np.equal: lambda a, b: _plain(a) == _plain(b),
    np.not_equal: lambda a, b: _plain(a) != _plain(b),
}


def _plain(operand: Any) -> Any:
    """A numpy scalar as a Python number, whose operators would call the ufunc again."""
    return operand.item() if isinstance(operand, np.generic) else operand


def _where_array(condition: Any, x: Any, y: Any) -> Any:
    return x if condition else y


def _clip(a: Any, a_min: Any = None, a_max: Any = None) -> Any:
    """Lower limit first, as numpy: the upper one wins where they cross."""
    raised = a if a_min is None else _UFUNCS[np.maximum](a, a_min)
    return raised if a_max is None else _UFUNCS[np.minimum](raised, a_max)


_ARRAY_FUNCTIONS: dict[Any, Callable[..., Any]] = {np.where: _where_array, np.clip: _clip}


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


# Copies of functions, in which everything that accepts floats only is replaced


def differentiable(function: Function) -> Function:
    """A copy of a plain function (or functools.partial of one) that also accepts dual numbers; anything else as it is.

    In the copy's globals, closure and defaults, each plain function is replaced by such a copy as well, also behind the
    name of its module and in dicts, lists and tuples of functions, `functools.cache` and numba's decorators are
    removed, and `math`, the builtins `float`, `int`, `min`, `max` and `numpy.float64` are replaced by versions for dual
    numbers. Other classes, methods, compiled functions, and the functions of numpy, scipy and the standard library stay
    as they are.

    The copy is kept as long as the function exists, with the globals that it had when it was copied.
    """
    return cast(Function, _substitute(function))


_COPIES: weakref.WeakKeyDictionary[types.FunctionType, types.FunctionType] = weakref.WeakKeyDictionary()
_COPYING = threading.RLock()


def _substitute(value: Any) -> Any:
    """What a copied function uses in place of a value."""
    if value is math:
        return _DUAL_MATH
    if value is np:
        return _DUAL_NUMPY
    if isinstance(value, types.ModuleType):
        return value if _is_left_alone(value.__name__) else _ModuleView(value)
    if isinstance(value, (types.BuiltinFunctionType, type)):
        return _BUILTINS.get(value, value)
    if isinstance(value, functools.partial):
        keywords = {name: _substitute(argument) for name, argument in value.keywords.items()}
        return functools.partial(_substitute(value.func), *map(_substitute, value.args), **keywords)
    if type(value) in (dict, list, tuple):
        return _substitute_elements(value)
    function = _unwrapped(value)
    if not isinstance(function, types.FunctionType):
        return value
    return value if _is_left_alone(function.__module__) else _copy(function)


def _is_left_alone(module: str | None) -> bool:
    return module == __name__ or str(module).partition(".")[0] in _LEFT_ALONE


def _substitute_elements(values: Any) -> Any:
    """A container of functions with their copies; itself if there is none in it."""
    items = list(values.values() if isinstance(values, dict) else values)
    replaced = [_substitute(item) if callable(item) else item for item in items]
    if all(new is old for new, old in zip(replaced, items, strict=True)):
        return values
    return dict(zip(values, replaced, strict=True)) if isinstance(values, dict) else type(values)(replaced)


def _unwrapped(value: Any) -> Any:
    """The function inside functools.cache and numba's dispatchers, which accept no dual numbers."""
    if isinstance(value, functools._lru_cache_wrapper):
        return value.__wrapped__
    return getattr(value, "py_func", value) if type(value).__module__.startswith("numba.") else value


def _copy(function: types.FunctionType) -> types.FunctionType:
    with _COPYING:
        if function in _COPIES:
            return _COPIES[function]
        known: dict[str, Any] = {"__builtins__": _DUAL_BUILTINS, "__name__": function.__globals__.get("__name__")}
        cells = tuple(types.CellType() for _ in function.__closure__ or ())
        copy = types.FunctionType(function.__code__, known, function.__name__, None, cells or None)
        _COPIES[function] = copy  # before its parts are copied, which may call it
        for name in _names(function.__code__):
            if name in function.__globals__:
                known[name] = _substitute(function.__globals__[name])
        for cell, original in zip(cells, function.__closure__ or (), strict=True):
            if _is_filled(original):
                cell.cell_contents = _substitute(original.cell_contents)
        copy.__defaults__ = _substitute(function.__defaults__)
        copy.__kwdefaults__ = _substitute(function.__kwdefaults__)
        copy.__qualname__ = function.__qualname__
        return copy


def _names(code: types.CodeType) -> set[str]:
    """Globals and attributes that a function names, and those of the functions and comprehensions inside it."""
    inner = [_names(constant) for constant in code.co_consts if isinstance(constant, types.CodeType)]
    return set(code.co_names).union(*inner)


def _is_filled(cell: types.CellType) -> bool:
    try:
        return cell.cell_contents is not cell
    except ValueError:  # a name of the enclosing function that has no value yet
        return False


class _ModuleView:
    """A module, with copies in place of its functions."""

    def __init__(self, module: types.ModuleType) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return _substitute(getattr(self._module, name))


class _NumpyView:
    """numpy, whose functions know dual numbers and whose types do not."""

    def __getattr__(self, name: str) -> Any:
        value = getattr(np, name)
        return _BUILTINS.get(value, value) if isinstance(value, type) else value


_DUAL_NUMPY = _NumpyView()


def _import(*arguments: Any, **options: Any) -> Any:
    """The import statement inside a function."""
    return _substitute(builtins.__import__(*arguments, **options))


_BUILTINS: dict[Any, Any] = {
    **{getattr(math, name): version for name, version in _MATH.items()},
    float: _Float,
    np.float64: _Float,
    int: _Int,
    min: _min,
    max: _max,
}
"""Builtin functions and types, and their versions for dual numbers."""

_DUAL_BUILTINS = {
    **vars(builtins), "float": _Float, "int": _Int, "min": _min, "max": _max, "__import__": _import,
}  # fmt: skip
