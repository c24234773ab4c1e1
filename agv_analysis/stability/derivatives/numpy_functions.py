"""Versions of numpy's functions for dual numbers."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from agv_analysis.stability.derivatives.branches import decide
from agv_analysis.stability.derivatives.dual import ARRAY_FUNCTIONS, UFUNCS, Dual, step, value_of
from agv_analysis.stability.derivatives.math_functions import BUILTINS, MATH, SMOOTH, smooth


def _nan_or(extremum: Callable[..., Any]) -> Callable[[Any, Any], Any]:
    """numpy's minimum or maximum, which is NaN where an argument is."""

    def apply(a: Any, b: Any) -> Any:
        invalid = np.isnan(value_of(a)) | np.isnan(value_of(b))
        return a + b if invalid.any() and decide(np.atleast_1d(invalid)) else extremum(a, b)

    return apply


def _sign(x: Dual) -> Dual:
    return step(x, np.sign(x.value), x.value == 0.0)


def _plain(operand: Any) -> Any:
    """A numpy scalar as a Python number, whose operators would call the ufunc again."""
    return operand.item() if isinstance(operand, np.generic) else operand


def _where_array(condition: Any, x: Any, y: Any) -> Any:
    return x if condition else y


def _clip(a: Any, a_min: Any = None, a_max: Any = None) -> Any:
    """Lower limit first, as numpy: the upper one wins where they cross."""
    raised = a if a_min is None else UFUNCS[np.maximum](a, a_min)
    return raised if a_max is None else UFUNCS[np.minimum](raised, a_max)


_NUMPY_SMOOTH = {
    "asin": "arcsin", "acos": "arccos", "atan": "arctan", "asinh": "arcsinh", "acosh": "arccosh", "atanh": "arctanh",
}  # fmt: skip
"""Functions whose ufunc has another name than that of the math module."""

UFUNCS.update({
    **{
        getattr(np, _NUMPY_SMOOTH.get(name, name)): smooth(lambda x: x, *pair)
        for name, pair in SMOOTH.items()
        if name not in ("erf", "erfc")
    },
    np.deg2rad: MATH["radians"],
    np.rad2deg: MATH["degrees"],
    np.log: MATH["log"],
    np.arctan2: MATH["atan2"],
    np.hypot: MATH["hypot"],
    np.copysign: MATH["copysign"],
    np.fmod: MATH["fmod"],
    np.isfinite: MATH["isfinite"],
    np.isinf: MATH["isinf"],
    np.isnan: MATH["isnan"],
    np.minimum: _nan_or(BUILTINS[min]),
    np.maximum: _nan_or(BUILTINS[max]),
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
})  # fmt: skip

ARRAY_FUNCTIONS.update({np.where: _where_array, np.clip: _clip})


class _NumpyView:
    """numpy, whose functions know dual numbers and whose types do not."""

    def __getattr__(self, name: str) -> Any:
        value = getattr(np, name)
        return BUILTINS.get(value, value) if isinstance(value, type) else value


DUAL_NUMPY = _NumpyView()
"""numpy for dual numbers."""
