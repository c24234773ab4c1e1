"""Plain functions with other functions called in place of those that they call, however deep in the calls."""

from __future__ import annotations

import functools
import types
from collections.abc import Callable, Iterator, Mapping
from typing import Any

Function = Callable[..., Any]
"""A plain function: `def`, not a class or an object that can be called."""

Replacements = Mapping[Function, Function]
"""Functions by those in whose place they are called."""


def plain(function: Function) -> types.FunctionType:
    """A plain function as one, for its code and its globals."""
    assert isinstance(function, types.FunctionType)
    return function


def with_globals(function: Function, values: Mapping[str, Any]) -> Function:
    """A copy of a function in which these names, of its module or enclosed by it, mean something else."""
    return types.FunctionType(
        plain(function).__code__,
        {**plain(function).__globals__, **values},
        plain(function).__name__,
        plain(function).__defaults__,
        tuple(types.CellType(values.get(name, value)) for name, value in _enclosed(function)) or None,
    )


def replaced(function: Function, replacements: Replacements) -> Function:
    """`function` as plain Python, with `replacements` called in the place of others, however deep in the calls."""
    return _replaced(function, tuple(replacements.items()))


@functools.cache
def _replaced(function: Function, replacements: tuple[tuple[Function, Function], ...]) -> Function:
    called = dict(replacements)
    if not any(part in called for part in functions_in(function, {})):
        return function
    return with_globals(
        function, {name: _replaced(inner, replacements) for name, inner in calls_of(function, called)}
    )  # fmt: skip


def _enclosed(function: Function) -> list[tuple[str, Any]]:
    cells = [cell.cell_contents for cell in plain(function).__closure__ or ()]
    return list(zip(plain(function).__code__.co_freevars, cells, strict=True))


def named_by(function: Function) -> Iterator[tuple[str, Any]]:
    """Everything outside of itself that a function names."""
    for name in plain(function).__code__.co_names:
        if name in plain(function).__globals__:
            yield name, plain(function).__globals__[name]
    yield from _enclosed(function)


def calls_of(function: Function, replacements: Replacements) -> list[tuple[str, Function]]:
    """Plain functions that a function names, each after the name that it has there; replacements in their places."""
    return [
        (name, replacements.get(value, value))
        for name, value in named_by(function)
        if isinstance(value, types.FunctionType)
    ]


def functions_in(function: Function, replacements: Replacements) -> list[Function]:
    """A function and all that it calls, each once, in the order of the calls."""
    found = {function: None}
    for _, called in calls_of(function, replacements):
        found.update(dict.fromkeys(functions_in(called, replacements)))
    return list(found)
