"""What tests hold derivatives against: expected ones at some points, and complex steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.stability.derivatives import jacobian

Floats = NDArray[np.float64]

ANY = np.array([-2.3, -0.4, 0.2, 1.7])
X, Y = np.array([-2.3, -0.4, 0.2, 1.7]), np.array([0.3, -1.2, 2.4, -0.6])
SQUARE = X**2 + Y**2


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
