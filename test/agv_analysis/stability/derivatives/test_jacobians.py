"""Arguments and results of `jacobian`, and the Jacobians of the loop."""

from __future__ import annotations

import math
import re
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agv_analysis.stability.derivatives import Dual, jacobian
from test.agv_analysis.stability.derivatives.closed_forms import ANY, Floats, complex_step


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
