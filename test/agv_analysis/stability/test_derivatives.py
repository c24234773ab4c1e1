"""Derivatives by dual numbers against closed forms and complex steps, at rows that take different branches."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable
from math import cos as cosine
from math import sin
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from agv_analysis.stability.derivatives import Dual, differentiable, jacobian

Floats = NDArray[np.float64]

INSIDE = np.array([0.07, 0.4, 0.9])
OUTSIDE = np.array([1.1, 2.0, 4.5])
ANY = np.array([-2.3, -0.4, 0.2, 1.7])


def check(function: Callable[..., Any], arguments: tuple[Any, ...], expected: list[Any], wrt: Any = None) -> None:
    """Value as of the function itself at each row; derivative as `expected`, a list (inputs) of shapes (N,)."""
    wrt = range(len(arguments)) if wrt is None else wrt
    found = jacobian(function, arguments, wrt)
    count = len(found.value)
    rows = zip(*(np.broadcast_to(argument, count).tolist() for argument in arguments), strict=True)
    np.testing.assert_allclose(found.value, [np.atleast_1d(function(*row)) for row in rows], rtol=1e-14, atol=1e-15)
    wanted = np.stack([np.broadcast_to(column, count) for column in expected], axis=-1)
    np.testing.assert_allclose(found.derivative[:, 0], wanted, rtol=1e-13, atol=1e-15)
    assert found.not_differentiable == ()


def complex_step(function: Callable[..., Any], point: Floats) -> Floats:
    """Jacobian, shape (outputs, inputs), of a function written for numpy, to round-off."""
    return np.transpose([
        np.imag(function(*(point + 1e-30j * np.eye(len(point))[i]))) / 1e-30 for i in range(len(point))
    ])  # fmt: skip


# Elementary functions


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


X, Y = np.array([-2.3, -0.4, 0.2, 1.7]), np.array([0.3, -1.2, 2.4, -0.6])
SQUARE = X**2 + Y**2
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


# Branches


def test_rows_that_take_different_branches_are_put_back_in_order() -> None:
    def function(x: float) -> float:
        if x < 0.0:
            return -3.0 * x
        if math.isfinite(x) and not 1.0 < x <= 2.0:
            return x * x
        return 7.0 * x

    x = np.linspace(-3.0, 3.0, 501) + 1e-3
    check(function, (x,), [np.where(x < 0.0, -3.0, np.where((x > 1.0) & (x <= 2.0), 7.0, 2.0 * x))])


def test_many_rows_are_evaluated_in_blocks() -> None:
    x = np.linspace(-1.0, 1.0, 100_001) + 1e-9
    check(lambda x: x * x if x > 0.0 else x, (x,), [np.where(x > 0.0, 2.0 * x, 1.0)])


def test_loops_may_end_earlier_in_some_rows() -> None:
    def halve(x: float) -> tuple[float, float]:
        steps = 0
        while abs(x) > 1.0:
            x, steps = 0.5 * x, steps + 1
        for _ in range(2):
            x *= x
        return x, steps

    found = jacobian(halve, (np.array([0.5, 3.0, -5.0]),), [0])
    assert found.derivative.ravel().tolist() == [0.5, 0.0, 4 * 0.75**3 / 4, 0.0, -4 * 0.625**3 / 8, 0.0]


def test_a_count_per_row_may_be_the_length_of_a_loop_or_an_index() -> None:
    def power(x: float, n: int) -> float:
        product = 1.0
        for _ in range(n):
            product *= x
        return product + (10.0, 20.0, 30.0, 40.0)[n]

    n = np.array([3, 0, 2, 3])
    found = jacobian(power, (np.full(4, 2.0), n), [0])
    assert found.value.ravel().tolist() == [48.0, 11.0, 34.0, 48.0]
    assert found.derivative.ravel().tolist() == [12.0, 0.0, 4.0, 12.0]


@given(st.lists(st.floats(-2.0, 2.0), min_size=1, max_size=20), st.floats(0.125, 1.0))
def test_a_limit_passes_the_derivative_only_inside(x: list[float], limit: float) -> None:
    found = jacobian(lambda v, limit: min(max(v, -limit), limit), (np.array(x), limit), [0, 1])

    at_limit = np.abs(x) == limit
    outside = np.abs(x) > limit
    expected = np.stack([~outside, np.sign(x) * outside], axis=-1)
    np.testing.assert_array_equal(found.derivative[~at_limit, 0], expected[~at_limit])
    reported = {int(row) for kink in found.not_differentiable for row in kink.rows}
    assert reported == set(np.flatnonzero(at_limit).tolist())


# Points without a derivative


def rectified(x: float) -> float:
    if x > 0.0:
        return x
    return 0.0


def test_a_tie_is_reported_with_its_rows_function_and_source_line() -> None:
    (kink,) = jacobian(rectified, (np.array([1.0, 0.0, -1.0, 0.0]),), [0]).not_differentiable

    assert kink.rows.tolist() == [1, 3]
    assert re.fullmatch(r"rectified \(test_derivatives\.py:\d+\): if x > 0\.0:", kink.where)


@pytest.mark.parametrize(
    "function",
    [
        abs,
        lambda x: abs(x),
        lambda x: np.abs(x),
        lambda x: max(x, 0.0),
        lambda x: np.maximum(x, 0.0),
        lambda x: math.copysign(1.0, x),
        lambda x: math.floor(x),
        lambda x: np.sign(x),
        lambda x: x % 1.0,
        lambda x: x // 1.0,
        lambda x: math.hypot(x, 0.0),
        lambda x: math.sqrt(x * x),
        lambda x: math.atan2(x, -1.0),
        lambda x: math.remainder(x + 0.5, 1.0),
        lambda x: math.fmod(x + 2.0, 1.0),
        lambda x: round(x + 0.5),
        lambda x: 1.0 if x == 0.0 else math.sin(x) / x,
    ],
)
def test_kinks_and_jumps_are_reported(function: Callable[[float], float]) -> None:
    kinks = jacobian(function, (np.array([0.25, 0.0, -0.3]),), [0]).not_differentiable

    assert [kink.rows.tolist() for kink in kinks] == [[1]]
    assert "test_derivatives.py" in kinks[0].where


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x * abs(x),
        lambda x: max(x, 0.0) ** 2,
        lambda x: x * x if x > 0.0 else 0.0 * x,
        lambda x: min(max(x, -math.inf), math.inf),
        lambda x: max(x, x),
        lambda x: math.floor(0.5 * math.cos(0.0)) + x,
    ],
)
def test_a_tie_whose_branches_agree_is_differentiable(function: Callable[[float], float]) -> None:
    assert jacobian(function, (np.array([0.25, 0.0, -0.3]),), [0]).not_differentiable == ()


def test_a_tie_behind_a_tie_is_looked_at_along_both_branches() -> None:
    def corner(x: float, y: float) -> float:
        return 1.0 if x >= 0.0 or y >= 0.0 else x * y

    kinks = jacobian(corner, (np.zeros(1), np.zeros(1)), [0, 1]).not_differentiable
    assert [kink.rows.tolist() for kink in kinks] == [[0]]


def test_many_ties_in_one_row_are_reported_without_evaluating_all_combinations() -> None:
    calls: list[float] = []

    def law(x: float) -> float:
        calls.append(x)
        total = 0.0
        for _ in range(20):
            total += abs(x)
        return total

    (kink,) = jacobian(law, (np.zeros(3),), [0]).not_differentiable
    assert kink.rows.tolist() == [0, 1, 2]
    assert len(calls) < 50


def test_a_branch_that_raises_beside_a_tie_makes_a_kink() -> None:
    def law(x: float) -> float:
        if x > 1.0:
            raise ValueError(f"x must be <= 1, got {x:.1f}")
        return 2.0 * x

    assert [kink.rows.tolist() for kink in jacobian(law, (np.array([0.0, 1.0]),), [0]).not_differentiable] == [[1]]
    with pytest.raises(ValueError, match=r"^x must be <= 1, got 3\.0$"):
        jacobian(law, (np.array([0.0, 3.0]),), [0])


def test_equal_constants_are_no_tie() -> None:
    assert jacobian(lambda x, y: x if y > 0.0 else -x, (X, np.zeros(4)), [0]).not_differentiable == ()


def test_an_infinite_slope_leaves_other_inputs_alone() -> None:
    found = jacobian(lambda x, y: math.sqrt(x) + y, (np.zeros(1), 1.0), [0, 1])

    assert found.derivative.ravel().tolist() == [math.inf, 1.0]
    assert len(found.not_differentiable) == 1


def test_values_that_are_not_finite_stay_in_their_rows() -> None:
    found = jacobian(lambda x: 1.0 / x + math.log(x), (np.array([0.0, 1.0, np.nan]),), [0])
    assert np.isfinite(found.value[:, 0]).tolist() == [False, True, False]
    assert found.derivative[1].item() == 0.0


# Functions that call others


def wrapped(angle: float) -> float:
    return math.atan2(sin(angle), cosine(angle))


def even(n: int, x: float) -> float:
    return x if n == 0 else odd(n - 1, sin(x))


def odd(n: int, x: float) -> float:
    return x if n == 0 else even(n - 1, cosine(x))


@functools.cache
def cached(x: float) -> float:
    return math.exp(x)


LAWS: dict[str, Callable[[float], float]] = {"wrapped": wrapped, "cached": cached}


def test_functions_that_are_called_are_copied_too() -> None:
    x = np.array([0.3, 5.0, -8.0])
    check(lambda x: wrapped(x), (x,), [1.0])
    check(lambda x: LAWS["wrapped"](x) * cached(x), (x,), [[(1.0 + wrapped(v)) * cached(v) for v in x.tolist()]])
    check(lambda x: sum(f(x) for f in (wrapped, wrapped)), (x,), [2.0])


def test_functions_that_call_each_other_are_copied_once() -> None:
    x = np.array([0.3, 1.0])
    inner = np.cos(np.sin(x))
    check(lambda x: even(3, x), (x,), [np.cos(inner) * -np.sin(np.sin(x)) * np.cos(x)])
    assert differentiable(even) is differentiable(even)
    assert differentiable(even).__globals__["odd"].__globals__["even"] is differentiable(even)


def test_closures_defaults_and_functions_among_the_arguments_are_copied() -> None:
    def scaled(gain: float, f: Callable[[float], float] = math.sin) -> Callable[..., float]:
        def law(x: float, *, g: Callable[[float], float] = wrapped) -> float:
            return gain * f(x) + g(x)

        return law

    law = scaled(3.0)
    check(law, (ANY,), [3.0 * np.cos(ANY) + 1.0])
    check(functools.partial(law, g=math.sin), (ANY,), [4.0 * np.cos(ANY)])
    found = jacobian(lambda x, called: called(x), (ANY, law), [0])
    np.testing.assert_allclose(found.derivative.ravel(), 3.0 * np.cos(ANY) + 1.0, rtol=1e-14)


def test_imports_inside_a_function_are_replaced() -> None:
    def law(x: float) -> float:
        import math as m
        from math import exp

        return m.sin(x) + exp(x)

    check(law, (ANY,), [np.cos(ANY) + np.exp(ANY)])


def test_functions_behind_the_name_of_a_module_are_copied(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    (tmp_path / "foreign_laws.py").write_text("import math\n\n\ndef law(x):\n    return math.tanh(x)\n")
    monkeypatch.syspath_prepend(tmp_path)
    import foreign_laws  # type: ignore[import-not-found]

    check(lambda x: foreign_laws.law(x), (ANY,), [1.0 / np.cosh(ANY) ** 2])


def test_the_original_is_not_changed() -> None:
    before = dict(wrapped.__globals__)
    differentiable(wrapped)
    assert wrapped.__globals__ == before
    assert differentiable(math.gamma) is math.gamma
    assert type(wrapped(1.0)) is float


def test_a_type_check_for_float_holds_for_dual_numbers() -> None:
    check(lambda x: x * x if isinstance(x, float) and not isinstance(x, int) else 0.0, (ANY,), [2.0 * ANY])


# numpy inside a law


def test_numpy_functions_of_two_arguments() -> None:
    check(lambda x, y: np.arctan2(x, y) + np.hypot(x, y), (X, Y),
          [Y / SQUARE + X / np.sqrt(SQUARE), -X / SQUARE + Y / np.sqrt(SQUARE)])  # fmt: skip
    check(lambda x, y: np.minimum(x, y) + 2.0 * np.maximum(x, y), (X, Y), [1.0 + (X > Y), 1.0 + (Y > X)])
    check(lambda x, y: np.clip(x, -1.0, 1.0) + np.where(y > 0.0, y, 3.0 * y), (X, Y),
          [np.abs(X) < 1.0, np.where(Y > 0.0, 1.0, 3.0)])  # fmt: skip
    check(lambda x, y: np.square(x) + np.float64(2.0) * y - np.float64(1.0), (X, Y), [2.0 * X, 2.0])
    check(lambda x, y: np.float64(2.0) / x + (y if np.float64(0.0) < y else y * y), (X, Y),
          [-2.0 / X**2, np.where(Y > 0.0, 1.0, 2.0 * Y)])  # fmt: skip
    assert np.isnan(jacobian(lambda x: np.minimum(x, 1.0), (np.array([np.nan]),), [0]).value).all()


def test_small_arrays_of_dual_numbers() -> None:
    def rotated(x: float, y: float, theta: float) -> Any:
        turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
        return turn @ np.array([x, y]) + x * np.array([1.0, 0.0])

    def closed_form(x: Any, y: Any, theta: Any) -> Any:
        c, s = np.cos(theta), np.sin(theta)
        return np.array([c * x - s * y + x, s * x + c * y])

    found = jacobian(rotated, (X, Y, 0.7), [0, 1, 2])
    for row, point in enumerate(zip(X, Y, strict=True)):
        expected = complex_step(closed_form, np.array([*point, 0.7]))
        np.testing.assert_allclose(found.derivative[row], expected, rtol=1e-14, atol=1e-15)


def test_numpy_functions_without_a_version_are_named() -> None:
    with pytest.raises(TypeError, match=r"numpy\.logaddexp .*no version for dual numbers"):
        jacobian(lambda x: np.logaddexp(x, 0.0), (ANY,), [0])
    with pytest.raises(TypeError, match=r"numpy\.sinc has no version for dual numbers"):
        jacobian(lambda x: np.sinc(x), (ANY,), [0])


# Arguments and results


class Pose(NamedTuple):
    x: float
    y: float
    theta: float


class Gains(NamedTuple):
    kx: float
    name: str


def test_leaves_of_tuples_are_inputs() -> None:
    def law(e: float, memory: tuple[float, ...], pose: Pose, gains: Gains) -> tuple[float, tuple[float, ...]]:
        assert isinstance(pose, Pose)
        return gains.kx * e + sum(memory) * pose.theta, (memory[1], memory[0] * e)

    memory = (np.array([1.0, 2.0]), np.array([3.0, 4.0]))
    e = np.array([0.5, 0.6])
    theta: Any = np.array([10.0, 20.0])
    found = jacobian(law, (e, memory, Pose(0.0, 0.0, theta), Gains(25.0, "kx")), [0, 1, 2, 5, 6])

    np.testing.assert_array_equal(found.value[1], [25.0 * 0.6 + 6.0 * 20.0, 4.0, 2.0 * 0.6])
    np.testing.assert_array_equal(
        found.derivative[1], [[25.0, 20.0, 20.0, 6.0, 0.6], [0.0, 0.0, 1.0, 0.0, 0.0], [2.0, 0.6, 0.0, 0.0, 0.0]]
    )


def test_results_are_flattened_in_order() -> None:
    found = jacobian(lambda x: (1, (x, [2.0 * x]), np.float64(3.0), x > 5.0), (2.0,), [0])
    assert found.value.tolist() == [[1.0, 2.0, 4.0, 3.0, 0.0]]
    assert found.derivative[0, :, 0].tolist() == [0.0, 1.0, 2.0, 0.0, 0.0]


@pytest.mark.parametrize("result", [None, "stop", (1.0, None), 1j, {"v": 1.0}])
def test_a_result_that_is_no_number_is_named(result: Any) -> None:
    def law(x: float) -> Any:
        return result

    with pytest.raises(TypeError, match=re.escape(f"law must return a number or a tuple of numbers, got {result!r}")):
        jacobian(law, (1.0,), [0])


def test_a_result_of_varying_length_is_refused() -> None:
    with pytest.raises(TypeError, match="must return as many numbers at all rows, got 1 and 2"):
        jacobian(lambda x: (x,) if x > 0.0 else (x, x), (ANY,), [0])


def test_arguments_that_do_not_fit_are_named() -> None:
    def law(*_: Any) -> float:
        return 0.0

    with pytest.raises(ValueError, match=r"leaf 1 has \(3,\)"):
        jacobian(law, (np.zeros(2), np.zeros(3)), [0])
    with pytest.raises(ValueError, match=r"leaf 0 has \(2, 2\)"):
        jacobian(law, (np.zeros((2, 2)),), [0])
    with pytest.raises(ValueError, match=r"leaf 0 has \(0,\)"):
        jacobian(law, (np.zeros(0),), [0])
    with pytest.raises(ValueError, match=r"2 is not in 0 \.\. 1"):
        jacobian(law, (1.0, 2.0), [2])
    with pytest.raises(ValueError, match="an input twice"):
        jacobian(law, (1.0, 2.0), [1, 1])
    with pytest.raises(TypeError, match="input 0 must be a number"):
        jacobian(law, ("hold",), [0])


def test_a_conversion_that_would_lose_the_derivative_is_refused() -> None:
    dual = Dual(np.array([1.0]), np.array([[1.0]]), (0,))
    for convert in (float, int, math.sin, range):
        with pytest.raises(TypeError, match=r"would lose its derivative.*make it a plain function of floats"):
            convert(dual)
    with pytest.raises(TypeError, match="unhashable"):
        hash(dual)
    with pytest.raises(TypeError, match="call the function by jacobian"):
        bool(Dual(np.array([0.0, 1.0]), np.zeros((0, 2)), ()))


def test_exceptions_pass_through_unchanged() -> None:
    error = RuntimeError("no pose yet")

    def law(x: float) -> float:
        try:
            if x > 1.0:
                raise error
        except ValueError:
            return 0.0
        return x

    with pytest.raises(RuntimeError) as caught:
        jacobian(law, (np.array([0.0, 2.0]),), [0])
    assert caught.value is error


def test_a_handler_of_all_exceptions_does_not_catch_the_splitting_of_rows() -> None:
    def law(x: float) -> float:
        try:
            return x if x > 0.0 else 2.0 * x
        except Exception:
            return math.nan

    check(law, (ANY,), [np.where(ANY > 0.0, 1.0, 2.0)])


# The loop


def tracking_error(
    x_r: float, y_r: float, theta_r: float, x_c: float, y_c: float, theta_c: float
) -> tuple[float, float, float]:
    dx, dy = x_r - x_c, y_r - y_c
    cos, sin = math.cos(theta_c), math.sin(theta_c)
    return cos * dx + sin * dy, -sin * dx + cos * dy, theta_r - theta_c


def control_law(
    x_e: float, y_e: float, theta_e: float, v_r: float, w_r: float, kx: float, ky: float, ktheta: float
) -> tuple[float, float]:
    return v_r * math.cos(theta_e) + kx * x_e, w_r + v_r * (ky * y_e + ktheta * math.sin(theta_e))


def arc_step(x: float, y: float, theta: float, v: float, w: float, ts: float) -> tuple[float, float, float]:
    half = 0.5 * w * ts
    sinc = math.sin(half) / half if abs(half) > 1e-4 else 1.0 - half * half / 6.0
    chord = v * ts * sinc
    return x + chord * math.cos(theta + half), y + chord * math.sin(theta + half), theta + w * ts


def rows(count: int, columns: int) -> Floats:
    return np.random.default_rng(3).normal(size=(columns, count))


def test_jacobian_of_the_tracking_error() -> None:
    x_r, y_r, theta_r, x, y, theta = rows(50, 6)
    found = jacobian(tracking_error, (x_r, y_r, theta_r, x, y, theta), [3, 4, 5])

    cos, sin, zero = np.cos(theta), np.sin(theta), np.zeros(50)
    x_e, y_e = cos * (x_r - x) + sin * (y_r - y), -sin * (x_r - x) + cos * (y_r - y)
    expected = np.array([[-cos, -sin, y_e], [sin, -cos, -x_e], [zero, zero, zero - 1.0]])
    np.testing.assert_allclose(found.derivative, np.moveaxis(expected, 2, 0), rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(found.value, np.stack([x_e, y_e, theta_r - theta], axis=1), rtol=1e-14, atol=1e-15)


def test_jacobian_of_the_control_law() -> None:
    x_e, y_e, theta_e, v_r, w_r = rows(50, 5)
    found = jacobian(control_law, (x_e, y_e, theta_e, v_r, w_r, 25.0, 40.0, 10.0), [0, 1, 2, 7])

    zero = np.zeros(50)
    expected = np.array([
        [zero + 25.0, zero, -v_r * np.sin(theta_e), zero],
        [zero, 40.0 * v_r, 10.0 * v_r * np.cos(theta_e), v_r * np.sin(theta_e)],
    ])  # fmt: skip
    np.testing.assert_allclose(found.derivative, np.moveaxis(expected, 2, 0), rtol=1e-14)


def test_jacobian_of_a_step_along_an_arc() -> None:
    x, y, theta, v, w = rows(50, 5)
    ts = 0.005
    w[::7] = 0.0  # the series instead of sin(h)/h
    found = jacobian(arc_step, (x, y, theta, v, w, ts), range(5))

    def closed_form(x: Any, y: Any, theta: Any, v: Any, w: Any) -> Any:
        half = 0.5 * w * ts
        sinc = np.sin(half) / half if abs(half) > 1e-4 else 1.0 - half * half / 6.0
        chord = v * ts * sinc
        return np.array([x + chord * np.cos(theta + half), y + chord * np.sin(theta + half), theta + w * ts])

    for row in range(50):
        expected = complex_step(closed_form, np.array([x[row], y[row], theta[row], v[row], w[row]]))
        np.testing.assert_allclose(found.derivative[row], expected, rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(found.derivative[::7, 0, 4], -0.5 * v[::7] * ts**2 * np.sin(theta[::7]), rtol=1e-12)
    assert found.not_differentiable == ()


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-1.5, 1.5), st.floats(0.0, 2.0))
def test_jacobian_of_the_closed_loop_is_the_product_of_the_jacobians(
    x: float, y: float, theta: float, v_r: float
) -> None:
    def loop(x: float, y: float, theta: float) -> tuple[float, float, float]:
        v, w = control_law(*tracking_error(1.0, 2.0, 0.5, x, y, theta), v_r, 0.3, 25.0, 40.0, 10.0)
        return arc_step(x, y, theta, v, w, 0.005)

    error = jacobian(tracking_error, (1.0, 2.0, 0.5, x, y, theta), [3, 4, 5])
    command = jacobian(control_law, (*error.value[0].tolist(), v_r, 0.3, 25.0, 40.0, 10.0), [0, 1, 2])
    step = jacobian(arc_step, (x, y, theta, *command.value[0].tolist(), 0.005), range(5))
    expected = step.derivative[0, :, :3] + step.derivative[0, :, 3:] @ command.derivative[0] @ error.derivative[0]
    np.testing.assert_allclose(
        jacobian(loop, (x, y, theta), range(3)).derivative[0], expected, rtol=1e-11, atol=1e-12
    )  # fmt: skip


def test_numpy_s_float_is_a_number_like_the_builtin() -> None:
    def square(x: float) -> Any:
        return np.float64(x * x)

    found = jacobian(square, [np.array([2.0, -3.0])], [0])
    assert found.value[:, 0].tolist() == [4.0, 9.0]
    assert found.derivative[:, 0, 0].tolist() == [4.0, -6.0]
