"""Rows that take different branches, and points at which there is no derivative."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agv_analysis.stability.derivatives import jacobian
from test.agv_analysis.stability.derivatives.closed_forms import ANY, X, check


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
    assert re.fullmatch(r"rectified \(test_branches\.py:\d+\): if x > 0\.0:", kink.where)


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
    assert "test_branches.py" in kinks[0].where


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


def test_a_handler_of_all_exceptions_does_not_catch_the_splitting_of_rows() -> None:
    def law(x: float) -> float:
        try:
            return x if x > 0.0 else 2.0 * x
        except Exception:
            return math.nan

    check(law, (ANY,), [np.where(ANY > 0.0, 1.0, 2.0)])
