"""numpy inside a function."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from agv_analysis.stability.derivatives import jacobian
from test.agv_analysis.stability.derivatives.closed_forms import ANY, SQUARE, X, Y, check, complex_step


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


def test_numpy_s_float_is_a_number_like_the_builtin() -> None:
    def square(x: float) -> Any:
        return np.float64(x * x)

    found = jacobian(square, [np.array([2.0, -3.0])], [0])
    assert found.value[:, 0].tolist() == [4.0, 9.0]
    assert found.derivative[:, 0, 0].tolist() == [4.0, -6.0]
