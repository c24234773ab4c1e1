"""Functions that call others, in whichever way."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from math import cos as cosine
from math import sin
from typing import Any

import numpy as np
import pytest

from agv_analysis.stability.derivatives import differentiable, jacobian
from test.agv_analysis.stability.derivatives.closed_forms import ANY, check


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
