"""Derivatives of elementary functions and of arithmetic against those of the textbook."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from agv_analysis.stability.derivatives import jacobian
from test.agv_analysis.stability.derivatives.closed_forms import ANY, SQUARE, Floats, X, Y, check

INSIDE = np.array([0.07, 0.4, 0.9])
OUTSIDE = np.array([1.1, 2.0, 4.5])

UNARY: dict[str, tuple[Floats, Callable[[Floats], Any]]] = {
    "sin": (ANY, np.cos),
    "cos": (ANY, lambda x: -np.sin(x)),
    "tan": (ANY, lambda x: 1 / np.cos(x) ** 2),
    "asin": (INSIDE, lambda x: 1 / np.sqrt(1 - x**2)),
    "acos": (INSIDE, lambda x: -1 / np.sqrt(1 - x**2)),
    "atan": (ANY, lambda x: 1 / (1 + x**2)),
    "sinh": (ANY, np.cosh),
    "cosh": (ANY, np.sinh),
    "tanh": (ANY, lambda x: 1 / np.cosh(x) ** 2),
    "asinh": (ANY, lambda x: 1 / np.sqrt(x**2 + 1)),
    "acosh": (OUTSIDE, lambda x: 1 / np.sqrt(x**2 - 1)),
    "atanh": (INSIDE, lambda x: 1 / (1 - x**2)),
    "exp": (ANY, np.exp),
    "expm1": (ANY, np.exp),
    "log": (OUTSIDE, lambda x: 1 / x),
    "log2": (OUTSIDE, lambda x: 1 / (x * np.log(2))),
    "log10": (OUTSIDE, lambda x: 1 / (x * np.log(10))),
    "log1p": (ANY[1:], lambda x: 1 / (1 + x)),
    "sqrt": (OUTSIDE, lambda x: 0.5 / np.sqrt(x)),
    "degrees": (ANY, lambda x: 180 / np.pi),
    "radians": (ANY, lambda x: np.pi / 180),
    "erf": (ANY, lambda x: 2 / np.sqrt(np.pi) * np.exp(-(x**2))),
    "erfc": (ANY, lambda x: -2 / np.sqrt(np.pi) * np.exp(-(x**2))),
    "fabs": (ANY, np.sign),
    "floor": (ANY, np.zeros_like),
    "ceil": (ANY, np.zeros_like),
    "trunc": (ANY, np.zeros_like),
}
if hasattr(math, "cbrt"):
    UNARY["cbrt"] = (ANY, lambda x: 1 / (3 * np.cbrt(x) ** 2))
    UNARY["exp2"] = (ANY, lambda x: np.log(2) * 2**x)


@pytest.mark.parametrize("name", UNARY)
def test_functions_of_one_argument_have_the_derivative_of_the_textbook(name: str) -> None:
    function = getattr(math, name)
    x, slope = UNARY[name]

    check(lambda x: function(x), (x,), [slope(x)])
    check(lambda x: 3.0 * function(x * 1.0), (x,), [3.0 * slope(x)])
    check(lambda x, y: function(x) * y, (x, 2.0), [2.0 * slope(x), [function(v) for v in x]])


@pytest.mark.parametrize("name", sorted(set(UNARY) - {"erf", "erfc"}))
def test_numpy_functions_that_a_law_calls_have_the_same_derivatives(name: str) -> None:
    x, slope = UNARY[name]
    ufunc = getattr(np, re.sub("^a(?=sin|cos|tan)", "arc", name))

    check(lambda x: ufunc(x), (x,), [slope(x)])


BINARY: dict[str, tuple[Callable[..., Any], Any, Any]] = {
    "add": (lambda x, y: x + y, 1.0, 1.0),
    "subtract": (lambda x, y: x - y, 1.0, -1.0),
    "multiply": (lambda x, y: x * y, Y, X),
    "divide": (lambda x, y: x / y, 1 / Y, -X / Y**2),
    "reflected": (lambda x, y: 2 + (1.0 - x) + 3 * (2.0 / y), -1.0, -6 / Y**2),
    "signs": (lambda x, y: -x + +y, -1.0, 1.0),
    "square": (lambda x, y: x**2 + y**3, 2 * X, 3 * Y**2),
    "negative power": (lambda x, y: x**-2 + y**0, -2 * X**-3, 0.0),
    "exponential": (lambda x, y: 2**x + 2.5**y, np.log(2) * 2**X, np.log(2.5) * 2.5**Y),
    "power": (lambda x, y: (x * x) ** y, 2 * X * Y * (X * X) ** (Y - 1), np.log(X * X) * (X * X) ** Y),
    "math.pow": (lambda x, y: math.pow(x, 2.0) + y, 2 * X, 1.0),
    "mod": (lambda x, y: x % 0.7 + x % y, 2.0, -np.floor(X / Y)),
    "mod of a number": (lambda x, y: x + 5.0 % y, 1.0, -np.floor(5.0 / Y)),
    "floor division": (lambda x, y: x // 0.7 + 5.0 // y, 0.0, 0.0),
    "divmod": (lambda x, y: sum(divmod(x, y)), 1.0, -np.floor(X / Y)),
    "fmod": (math.fmod, 1.0, -np.trunc(X / Y)),
    "remainder": (math.remainder, 1.0, -np.rint(X / Y)),
    "atan2": (math.atan2, Y / SQUARE, -X / SQUARE),
    "hypot": (math.hypot, X / np.sqrt(SQUARE), Y / np.sqrt(SQUARE)),
    "dist": (lambda x, y: math.dist((x, 0.0), (0.0, y)), X / np.sqrt(SQUARE), Y / np.sqrt(SQUARE)),
    "copysign": (math.copysign, np.sign(X * Y), 0.0),
    "log to a base": (lambda x, y: math.log(2.0 + x * x, 3.0 + y * y), 2 * X / (2 + X**2) / np.log(3 + Y**2),
                      -np.log(2 + X**2) * 2 * Y / (3 + Y**2) / np.log(3 + Y**2) ** 2),
    "fsum": (lambda x, y: math.fsum([x, y, x]), 2.0, 1.0),
    "prod": (lambda x, y: math.prod((x, y, 2.0)), 2 * Y, 2 * X),
    "min": (lambda x, y: min(x, y), X < Y, X > Y),
    "max": (lambda x, y: max([x, 0.25, y]), (X > Y) & (X > 0.25), (Y > X) & (Y > 0.25)),
    "round": (lambda x, y: round(x, 1) + round(y) + x, 1.0, 0.0),
    "float": (lambda x, y: float(x) + int(y) + float(3), 1.0, 0.0),
}  # fmt: skip


@pytest.mark.parametrize("name", BINARY)
def test_arithmetic_and_functions_of_two_arguments_have_the_derivative_of_the_textbook(name: str) -> None:
    function, by_x, by_y = BINARY[name]

    check(function, (X, Y), [by_x, by_y])
    check(function, (X, Y), [by_x], wrt=[0])
    check(function, (X, Y), [by_y], wrt=[1])


def test_a_number_that_is_not_an_input_has_no_derivative() -> None:
    check(lambda x, y: math.sin(x) ** 2 + y, (X, Y), [1.0], wrt=[1])
    assert jacobian(lambda x: 3.0, (X,), [0]).derivative.tolist() == [[[0.0]]] * len(X)
    assert jacobian(math.sin, (X,), []).derivative.shape == (len(X), 1, 0)


def test_a_type_check_for_float_holds_for_dual_numbers() -> None:
    check(lambda x: x * x if isinstance(x, float) and not isinstance(x, int) else 0.0, (ANY,), [2.0 * ANY])
