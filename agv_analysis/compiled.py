"""Plain functions, compiled: those of the nodes, and the loops over a bag's messages.

Theory of operation. numba compiles a function that calls other functions only if these are compiled as well, but the
nodes' functions are plain ones and stay so. `compiled` therefore follows the calls: it makes a copy of the function in
whose globals every plain function is replaced by its own compiled copy. The code is the same, compiled without
fast-math, so the numbers are the same to the last bit.

What is compiled is kept on disk, by numba's own cache, which knows a function by its file and so would not see that
another file, the control law say, has changed. The cache's folder is therefore named after all code and all constants
that went in.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import os
import threading
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

HAS_NUMBA = importlib.util.find_spec("numba") is not None
"""Is numba installed? Without it, everything runs as plain Python."""

_COMPILING = threading.Lock()
"""Held where numba's settings are changed for a moment."""


@functools.cache
def compiled(function: types.FunctionType) -> Callable[..., Any]:
    """`function` with all functions that it calls, compiled; itself where numba is not installed.

    It is compiled at its first call, and releases the interpreter's lock while it runs. Arrays go in as they are; see
    `numbers` for what runs without numba.
    """
    if not HAS_NUMBA:
        return function
    with _COMPILING:
        return _compile(function, _cache_folder(function))


@functools.cache
def compiled_with(function: types.FunctionType, **called: types.FunctionType) -> Callable[..., Any]:
    """`function` compiled with functions of one's choice in place of its globals of these names.

    Not enclosed by it, since what is compiled of a closure cannot be kept.
    """
    known = {**function.__globals__, **called}
    return compiled(types.FunctionType(function.__code__, known, function.__name__))


def numbers(array: Any) -> Any:
    """An array as a compiled function takes it; as lists of plain numbers, which are faster, where nothing is compiled.

    Only for arrays that are read.
    """
    return array if HAS_NUMBA else array.tolist()


def _compile(function: types.FunctionType, folder: Path | None, inside: bool = False) -> Callable[..., Any]:
    """`function` compiled, to be kept in `folder` if there is one, or to be put `inside` each of its callers."""
    import numba

    inner = {name: _compile(called, None, inside=True) for name, called in _called(function)}
    copy = types.FunctionType(
        function.__code__,
        {**function.__globals__, **inner},
        function.__name__,
        function.__defaults__,
        tuple(types.CellType(inner.get(name, value)) for name, value in _enclosed(function)) or None,
    )
    usual = numba.config.CACHE_DIR
    try:
        numba.config.CACHE_DIR = str(folder or "")  # looked at by the decorator, not later
        dispatcher: Callable[..., Any] = numba.njit(nogil=True, cache=folder is not None, forceinline=inside)(copy)
    finally:
        numba.config.CACHE_DIR = usual
    return dispatcher


def _enclosed(function: types.FunctionType) -> list[tuple[str, Any]]:
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    return list(zip(function.__code__.co_freevars, cells, strict=True))


def _named(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    """Everything outside of itself that a function names."""
    for name in function.__code__.co_names:
        if name in function.__globals__:
            yield name, function.__globals__[name]
    yield from _enclosed(function)


def _called(function: types.FunctionType) -> list[tuple[str, types.FunctionType]]:
    return [(name, value) for name, value in _named(function) if isinstance(value, types.FunctionType)]


def _cache_folder(function: types.FunctionType) -> Path | None:
    """Folder for the compiled function, made if need be; None if it cannot be, or for a closure.

    A closure is known to numba's cache by what it encloses, which is another object in every process.
    """
    if function.__closure__:
        return None
    try:
        folder = _cache_base() / _digest(function)
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # Path.home() may not exist
        return None
    return folder if os.access(folder, os.W_OK) else None


def _cache_base() -> Path:
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    return Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "agv_ncs"


def _digest(function: types.FunctionType) -> str:
    """Name of the code that goes into a compiled function: all sources, and the constants taken from other files."""
    digest = hashlib.sha256()
    for part in _functions(function):
        digest.update(Path(part.__code__.co_filename).read_bytes())
        digest.update(part.__code__.co_code)  # which tells apart functions of one file
        constants = {name: value for name, value in _named(part) if isinstance(value, (bool, int, float, str))}
        digest.update(repr(sorted(constants.items())).encode())
    return digest.hexdigest()[:16]


def _functions(function: types.FunctionType) -> list[types.FunctionType]:
    """A function and all that it calls, each once, in the order of the calls."""
    found = {function: None}
    for _, called in _called(function):
        found.update(dict.fromkeys(_functions(called)))
    return list(found)
