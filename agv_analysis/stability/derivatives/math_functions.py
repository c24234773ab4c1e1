"""Versions of `math` and of builtins for dual numbers; without a dual number they are the functions themselves."""

from __future__ import annotations

import functools
import math
import types
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np

from agv_analysis.stability.derivatives.branches import Floats, decide, report, report_singular
from agv_analysis.stability.derivatives.dual import (
    NUMBER,
    Dual,
    Inputs,
    Scalar,
    chain,
    constant,
    moving,
    power,
    value_of,
)


def smooth(
    usual: Callable[[float], float], evaluate: Callable[[Floats], Any], slope: Callable[[Floats, Floats], Any]
) -> Callable[[Any], Any]:
    """A function of one argument by its value f(x) and the slope df/dx(x, f(x)), both of shape (N,)."""

    def apply(x: Any) -> Any:
        if not isinstance(x, Dual):
            return usual(x)
        value = evaluate(x.value)
        if not x.inputs:
            return constant(value)
        factor = slope(x.value, value)
        report_singular(x.value, value, factor)
        return Dual(value, factor * x.derivative, x.inputs)

    return apply


def _each(usual: Callable[[float], float]) -> Callable[[Floats], Floats]:
    return lambda x: np.array([usual(number) for number in x.tolist()])


SMOOTH: dict[str, tuple[Callable[[Floats], Any], Callable[[Floats, Floats], Any]]] = {
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

_natural_log = smooth(math.log, np.log, lambda x, f: 1.0 / x)


def _has_dual(arguments: Sequence[Any]) -> bool:
    return any(isinstance(argument, Dual) for argument in arguments)


def _log(x: Any, *base: Any) -> Any:
    if not base or not _has_dual((x, *base)):
        return math.log(x, *base) if not isinstance(x, Dual) else _natural_log(x)
    return _natural_log(x) / _natural_log(base[0])


def _atan2(y: Any, x: Any) -> Any:
    if not _has_dual((y, x)):
        return math.atan2(y, x)
    a, b = value_of(y), value_of(x)
    square = np.add(np.multiply(a, a), np.multiply(b, b))
    angle = chain(np.arctan2(a, b), (b / square, y), (-a / square, x))
    cut = np.equal(a, 0.0) & np.less_equal(b, 0.0)
    if cut.any():
        report(moving(cut & np.ones(len(angle.value), dtype=np.bool_), angle))
    return angle


def _hypot(*coordinates: Any) -> Any:
    if not _has_dual(coordinates):
        return math.hypot(*coordinates)
    value = functools.reduce(np.hypot, map(value_of, coordinates), np.zeros(1))
    length = chain(value, *((value_of(x) / value, x) for x in coordinates))
    report(moving(value == 0.0, length))
    return length


def _dist(p: Sequence[Any], q: Sequence[Any]) -> Any:
    return _hypot(*(a - b for a, b in zip(p, q, strict=True)))


def _pow(x: Any, y: Any) -> Any:
    return power(x, y) if _has_dual((x, y)) else math.pow(x, y)


def _fabs(x: Any) -> Any:
    return abs(x) if isinstance(x, Dual) else math.fabs(x)


def _copysign(x: Any, y: Any) -> Any:
    if not _has_dual((x, y)):
        return math.copysign(x, y)
    a, b = value_of(x), value_of(y)
    result = chain(np.copysign(a, b), (np.copysign(1.0, a) * np.copysign(1.0, b), x))
    for operand, edge in ((x, result.value == 0.0), (y, np.equal(b, 0.0) & (result.value != 0.0))):
        if isinstance(operand, Dual):
            report(moving(edge, operand))
    return result


def _fmod(x: Any, y: Any) -> Any:
    if not _has_dual((x, y)):
        return math.fmod(x, y)
    value = np.fmod(value_of(x), value_of(y))
    whole = np.rint((value_of(x) - value) / value_of(y))
    rest = chain(value, (1.0, x), (-whole, y))
    report(moving((value == 0.0) & (whole != 0.0), rest))
    return rest


def _remainder(x: Any, y: Any) -> Any:
    """The rest x - n y for the integer n nearest to x / y, the even one of two; exact, as _fmod is."""
    if not _has_dual((x, y)):
        return math.remainder(x, y)
    rest, size = np.fmod(value_of(x), value_of(y)), np.abs(value_of(y))
    odd = np.fmod(np.rint((value_of(x) - rest) / value_of(y)), 2.0) != 0.0
    beyond = (2.0 * np.abs(rest) > size) | ((2.0 * np.abs(rest) == size) & odd)
    value = np.where(beyond, rest - np.copysign(size, rest), rest)
    result = chain(value, (1.0, x), (-np.rint((value_of(x) - value) / value_of(y)), y))
    report(moving(2.0 * np.abs(value) == size, result))
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
    x, y = np.broadcast_arrays(value_of(a), value_of(b))
    close = np.abs(x - y) <= np.maximum(rel_tol * np.maximum(np.abs(x), np.abs(y)), abs_tol)
    return decide((x == y) | (close & np.isfinite(x) & np.isfinite(y)))


def _test(usual: Callable[[float], bool], ufunc: np.ufunc) -> Callable[[Any], bool]:
    return lambda x: decide(ufunc(x.value)) if isinstance(x, Dual) else usual(x)


def _selected(a: Any, b: Any, prefers_b: Callable[[Any, Any], Any]) -> Any:
    """b in the rows where it is preferred, else a; as `b if prefers_b(b, a) else a`, but without splitting rows."""
    if not _has_dual((a, b)):
        return b if prefers_b(b, a) else a
    x, y = value_of(a), value_of(b)
    equal = np.equal(x, y)
    difference = a - b if isinstance(a, Dual) else b - a
    if moving(equal, difference).any():
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
        if not _has_dual(items) or not all(isinstance(item, (Dual, *NUMBER)) for item in items):
            return usual(items)
        return functools.reduce(lambda a, b: _selected(a, b, prefers), items)

    return apply


_min, _max = _extremum(min, _less), _extremum(max, _greater)


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


MATH: dict[str, Callable[..., Any]] = {
    **{name: smooth(getattr(math, name), *pair) for name, pair in SMOOTH.items() if hasattr(math, name)},
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

DUAL_MATH = types.SimpleNamespace(**{**vars(math), **MATH})
"""The math module for dual numbers."""

BUILTINS: dict[Any, Any] = {
    **{getattr(math, name): version for name, version in MATH.items()},
    float: _Float,
    np.float64: _Float,
    int: _Int,
    min: _min,
    max: _max,
}
"""Builtin functions and types, and their versions for dual numbers."""
