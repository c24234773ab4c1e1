"""Copies of plain functions, in which everything that accepts floats only is replaced."""

from __future__ import annotations

import builtins
import functools
import math
import sys
import threading
import types
import weakref
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np

from agv_analysis.stability.derivatives.branches import PACKAGE
from agv_analysis.stability.derivatives.math_functions import BUILTINS, DUAL_MATH
from agv_analysis.stability.derivatives.numpy_functions import DUAL_NUMPY

Function = TypeVar("Function", bound=Callable[..., Any])

_LEFT_ALONE = sys.stdlib_module_names | {"numba", "numpy", "scipy"}
"""Top-level modules whose functions are not copied."""


def differentiable(function: Function) -> Function:
    """A copy of a plain function (or functools.partial of one) that also accepts dual numbers; anything else as it is.

    In the copy's globals, closure and defaults, each plain function is replaced by such a copy as well, also behind the
    name of its module and in dicts, lists and tuples of functions, `functools.cache` and numba's decorators are
    removed, and `math`, the builtins `float`, `int`, `min`, `max` and `numpy.float64` are replaced by versions for dual
    numbers. Other classes, methods, compiled functions, and the functions of numpy, scipy and the standard library stay
    as they are.

    The copy is kept as long as the function exists, with the globals that it had when it was copied.
    """
    return cast(Function, substitute(function))


_COPIES: weakref.WeakKeyDictionary[types.FunctionType, types.FunctionType] = weakref.WeakKeyDictionary()
_COPYING = threading.RLock()


def substitute(value: Any) -> Any:
    """What a copied function uses in place of a value."""
    if value is math:
        return DUAL_MATH
    if value is np:
        return DUAL_NUMPY
    if isinstance(value, types.ModuleType):
        return value if _is_left_alone(value.__name__) else _ModuleView(value)
    if isinstance(value, (types.BuiltinFunctionType, type)):
        return BUILTINS.get(value, value)
    if isinstance(value, functools.partial):
        keywords = {name: substitute(argument) for name, argument in value.keywords.items()}
        return functools.partial(substitute(value.func), *map(substitute, value.args), **keywords)
    if type(value) in (dict, list, tuple):
        return _substitute_elements(value)
    function = _unwrapped(value)
    if not isinstance(function, types.FunctionType):
        return value
    return value if _is_left_alone(function.__module__) else _copy(function)


def _is_left_alone(module: str | None) -> bool:
    return str(module).startswith(PACKAGE) or str(module).partition(".")[0] in _LEFT_ALONE


def _substitute_elements(values: Any) -> Any:
    """A container of functions with their copies; itself if there is none in it."""
    items = list(values.values() if isinstance(values, dict) else values)
    replaced = [substitute(item) if callable(item) else item for item in items]
    if all(new is old for new, old in zip(replaced, items, strict=True)):
        return values
    return dict(zip(values, replaced, strict=True)) if isinstance(values, dict) else type(values)(replaced)


def _unwrapped(value: Any) -> Any:
    """The function inside functools.cache and numba's dispatchers, which accept no dual numbers."""
    if isinstance(value, functools._lru_cache_wrapper):
        return value.__wrapped__
    return getattr(value, "py_func", value) if type(value).__module__.startswith("numba.") else value


def _copy(function: types.FunctionType) -> types.FunctionType:
    with _COPYING:
        if function in _COPIES:
            return _COPIES[function]
        known: dict[str, Any] = {"__builtins__": _DUAL_BUILTINS, "__name__": function.__globals__.get("__name__")}
        cells = tuple(types.CellType() for _ in function.__closure__ or ())
        copy = types.FunctionType(function.__code__, known, function.__name__, None, cells or None)
        _COPIES[function] = copy  # before its parts are copied, which may call it
        for name in _names(function.__code__):
            if name in function.__globals__:
                known[name] = substitute(function.__globals__[name])
        for cell, original in zip(cells, function.__closure__ or (), strict=True):
            if _is_filled(original):
                cell.cell_contents = substitute(original.cell_contents)
        copy.__defaults__ = substitute(function.__defaults__)
        copy.__kwdefaults__ = substitute(function.__kwdefaults__)
        copy.__qualname__ = function.__qualname__
        return copy


def _names(code: types.CodeType) -> set[str]:
    """Globals and attributes that a function names, and those of the functions and comprehensions inside it."""
    inner = [_names(constant) for constant in code.co_consts if isinstance(constant, types.CodeType)]
    return set(code.co_names).union(*inner)


def _is_filled(cell: types.CellType) -> bool:
    try:
        return cell.cell_contents is not cell
    except ValueError:  # a name of the enclosing function that has no value yet
        return False


class _ModuleView:
    """A module, with copies in place of its functions."""

    def __init__(self, module: types.ModuleType) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return substitute(getattr(self._module, name))


def _import(*arguments: Any, **options: Any) -> Any:
    """The import statement inside a function."""
    return substitute(builtins.__import__(*arguments, **options))


_DUAL_BUILTINS = {
    **vars(builtins),
    **{kind.__name__: BUILTINS[kind] for kind in (float, int, min, max)},
    "__import__": _import,
}
