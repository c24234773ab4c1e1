"""Interval arithmetic against numbers drawn from within: bounds hold for all of them, sharp where they can be."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_analysis.run import Floats
from agv_analysis.stability.derivatives import differentiable
from agv_analysis.stability.derivatives.interval import (
    Interval,
    NoBoundsError,
    bounds_of,
    product,
    slopes,
    stacked,
    variable,
    within,
)
from agv_cloud.control.kanayama import kanayama
from agv_cloud.tracking_error import tracking_error
from agv_plant.vehicle.unicycle import euler_step

SLACK = 1e-12
"""Rounding, which the bounds do not follow."""


def brake(x: float, y: float, v: float) -> float:
    return abs(x * v) + math.sqrt(1.0 + x * x) * math.exp(-abs(y)) - x / (2.0 + y * y)


def limited(x: float, y: float, v: float) -> float:
    return min(max(x, -10.0), 10.0) * math.sin(y + v) - math.exp(v) * math.atan(x)


def error(x: float, y: float, v: float) -> tuple[float, float, float]:
    return tracking_error(*euler_step(x, y, v, 1.5, 0.3, 0.1), 0.1 * v, x * y, y)


def law(x: float, y: float, v: float) -> tuple[float, float]:
    return kanayama(x, y, v, 1.3, 0.2)


FUNCTIONS: list[Callable[[float, float, float], Any]] = [brake, limited, error, law]

sides = st.tuples(st.floats(-3.0, 3.0), st.floats(0.0, 1.0))


def values(result: Any) -> list[float]:
    return list(result) if isinstance(result, tuple) else [result]


@settings(max_examples=150, deadline=None)
@given(box=st.tuples(sides, sides, sides), index=st.integers(0, len(FUNCTIONS) - 1), seed=st.integers(0, 999))
def test_values_and_mean_slopes_lie_within(box: tuple[tuple[float, float], ...], index: int, seed: int) -> None:
    function = FUNCTIONS[index]
    low = np.array([[a] for a, _ in box])
    high = low + np.array([[width] for _, width in box])
    inputs: list[Any] = [variable(Interval(low[i], high[i]), i) for i in range(3)]
    found = values(differentiable(function)(*inputs))
    rng = np.random.default_rng(seed)
    one, other = (low + rng.uniform(size=(3, 1)) * (high - low) for _ in range(2))
    of_one, of_other = (values(function(*point[:, 0].tolist())) for point in (one, other))
    for number, at_one, at_other in zip(found, of_one, of_other, strict=True):
        bounds = bounds_of(number)
        assert bounds.low[0] - SLACK <= at_one <= bounds.high[0] + SLACK
        difference = sum(
            (slope * (one - other)[i] for i, slope in enumerate(slopes(number, range(3)))),
            Interval(np.zeros(1), np.zeros(1)),
        )
        assert difference.low[0] - SLACK <= at_one - at_other <= difference.high[0] + SLACK


@pytest.mark.parametrize("ufunc", [np.sin, np.cos])
def test_turns_are_bounded_sharply(ufunc: Callable[[Floats], Floats]) -> None:
    rng = np.random.default_rng(4)
    low = rng.uniform(-20.0, 20.0, 400)
    high = low + rng.choice([0.0, 0.1, 1.0, 3.0, 7.0], 400)
    found: Any = ufunc(Interval(low, high))  # type: ignore[arg-type]
    dense = ufunc(np.linspace(low, high, 20_001))
    np.testing.assert_allclose(found.low, dense.min(axis=0), atol=1e-6)
    np.testing.assert_allclose(found.high, dense.max(axis=0), atol=1e-6)


def test_a_number_times_itself_is_a_square() -> None:
    x = Interval(np.array([-1.0, 0.5, -3.0]), np.array([2.0, 1.0, -2.0]))
    square = x * x
    assert square.low.tolist() == [0.0, 0.25, 4.0]
    assert square.high.tolist() == [4.0, 1.0, 9.0]


def test_products_of_matrices_hold_those_of_matrices_within() -> None:
    rng = np.random.default_rng(2)
    a_low, b_low = rng.normal(size=(3, 4, 5)), rng.normal(size=(4, 2, 5))
    a_high, b_high = a_low + rng.uniform(size=a_low.shape), b_low + rng.uniform(size=b_low.shape)
    found = product(Interval(a_low, a_high), Interval(b_low, b_high))
    for _ in range(50):
        a, b = (x + rng.uniform(size=x.shape) * (y - x) for x, y in ((a_low, a_high), (b_low, b_high)))
        exact = np.einsum("nmk,mpk->npk", a, b)
        assert (found.low <= exact + SLACK).all()
        assert (exact <= found.high + SLACK).all()


def test_what_is_open_is_refused() -> None:
    about_zero = within(Interval(np.array([-1.0]), np.array([1.0])))
    with pytest.raises(NoBoundsError, match="not all numbers within their bounds"):
        differentiable(lambda x: 1.0 if x > 0.0 else 0.0)(about_zero)
    with pytest.raises(NoBoundsError, match="not all numbers within their bounds"):
        differentiable(lambda x: min(x, 0.5))(about_zero)
    with pytest.raises(NoBoundsError, match="division"):
        differentiable(lambda x: 1.0 / x)(about_zero)
    with pytest.raises(NoBoundsError, match="cbrt"):
        np.cbrt(bounds_of(about_zero))


def test_a_comparison_that_all_numbers_answer_alike_has_an_outcome() -> None:
    low, high = (
        Interval(np.array([0.0, 1.0]), np.array([0.5, 2.0])),
        Interval(np.array([3.0, 3.0]), np.array([4.0, 3.0])),
    )
    assert (low < high).all()
    assert (high >= low).all()
    assert not (low > high).any()
    assert not (low == high).any()
    assert (stacked([high])[0] == high).tolist() == [False, True]  # [3, 4] may be two numbers
