"""Plain functions, compiled: those of the nodes, and the loops over a bag's messages.

Theory of operation. numba compiles a function that calls other functions only if these are compiled as well, but the
nodes' functions are plain ones and stay so. `compiled` therefore follows the calls: it makes a copy of the function in
whose globals every plain function is replaced by its own compiled copy. The code is the same, compiled without
fast-math, so the numbers are the same to the last bit.

Over lanes, a function is compiled for a loop over many runs side by side, which LLVM turns into vector instructions:
with polynomials in place of `math.sin` and `math.cos` (`lane_math`), without a test before each division.

What is compiled is kept on disk, by numba's own cache, which knows a function by its file and so would not see that
another file, the control law say, has changed. The cache's folder is therefore named after all code and all constants
that went in.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import logging
import math
import os
import threading
import types
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agv_analysis.compiled.folder_lock import one_process_at_a_time
from agv_analysis.compiled.lane_math import cosine, sine
from agv_ros.substitution import Function, Replacements, calls_of, functions_in, named_by, plain, replaced, with_globals

HAS_NUMBA = importlib.util.find_spec("numba") is not None
"""Is numba installed? Without it, everything runs as plain Python."""

_LOCATOR = "agv_analysis.compiled.cache.ContentLocator"

LOG = logging.getLogger(__name__)
"""Says which function is about to be compiled, because it is not on disk."""

_LANE_SOURCES = tuple(Path(__file__).parent / name for name in ("lane_math.py", "lane_memory.py", "lane_rows.py"))

_COMPILING = threading.Lock()
"""Held where numba's settings are changed for a moment."""


def compiled(function: Function, replacements: Replacements | None = None) -> Callable[..., Any]:
    """`function` with all functions that it calls, compiled; as plain Python where numba is not installed.

    It is compiled at its first call, and releases the interpreter's lock while it runs. Arrays go in as they are; see
    `numbers` for what runs without numba. A function that `replacements` names is called in place of the other.
    """
    return _compiled(function, tuple((replacements or {}).items()))


def compiled_over_lanes(function: Function, constants: tuple[tuple[str, Any], ...]) -> Callable[..., Any]:
    """`function`, whose innermost loop is one over lanes, compiled so that this loop can be vectorised; needs numba.

    In its globals `constants` stand by name, and beside them `load_lane` and `store_lane` of `lane_memory`. Whether it
    has been vectorised or not, and by vectors of which length, the numbers are the same: no operation is contracted.
    """
    with _COMPILING:
        return _compiled_over_lanes(function, constants)


@functools.cache
def _compiled_over_lanes(function: Function, constants: tuple[tuple[str, Any], ...]) -> Callable[..., Any]:
    from agv_analysis.compiled.lane_memory import load_lane, store_lane

    named = with_globals(function, {**dict(constants), "load_lane": load_lane, "store_lane": store_lane})
    return _compile(named, _cache_folder(named, {}, _LANE_SOURCES), {}, _over_lanes())


@functools.cache
def _over_lanes() -> _Way:
    """How functions are compiled over lanes."""
    module, made = types.ModuleType("math over lanes"), dict[Function, Any]()
    vars(module).update({name: value for name, value in vars(math).items() if not name.startswith("__")})
    for name, function in (("sin", sine), ("cos", cosine)):
        setattr(module, name, _inlined(function, {}, made, _PLAINLY))
    return _Way({"error_model": "numpy"}, {"math": module}, {})


@functools.cache
def _compiled(function: Function, replacements: tuple[tuple[Function, Function], ...]) -> Callable[..., Any]:
    called = dict(replacements)
    if not HAS_NUMBA:
        return replaced(function, called)
    folder = _cache_folder(function, called)
    with _COMPILING:
        return _compile(function, folder, called)


def numbers(array: Any) -> Any:
    """An array as a compiled function takes it; as lists of plain numbers, which are faster, where nothing is compiled.

    Only for arrays that are read.
    """
    return array if HAS_NUMBA else array.tolist()


class _Way(NamedTuple):
    """How functions are compiled: options of numba's, and modules that stand for others of the same name."""

    options: Mapping[str, Any]
    modules: Mapping[str, types.ModuleType]
    inlined: dict[tuple[tuple[Function, Function], ...], dict[Function, Any]]
    """What has been compiled to be put inside callers, by replacements: for all functions that call it."""


_PLAINLY = _Way({}, {}, {})


def _compile(
    function: Function, folder: Path | None, replacements: Replacements, way: _Way = _PLAINLY
) -> Callable[..., Any]:
    """`function` compiled, to be kept in `folder` if there is one."""
    import numba

    if folder is not None and not any(folder.glob("*.nbi")):  # numba's index of what is there
        LOG.info("%s is compiled, and kept in %s", function.__qualname__, folder)
    made = way.inlined.setdefault(tuple(replacements.items()), {})
    copy = with_globals(function, _compiled_calls(function, replacements, made, way))
    # Looked at by the decorator, not later. An older numba has no such locators, and compiles for each place anew.
    wanted = {"CACHE_DIR": str(folder or ""), "CACHE_LOCATOR_CLASSES": _LOCATOR}
    usual = {name: getattr(numba.config, name) for name in wanted if hasattr(numba.config, name)}
    try:
        for name in usual:
            setattr(numba.config, name, wanted[name])
        dispatcher: Any = numba.njit(nogil=True, cache=folder is not None, **way.options)(copy)
    finally:
        for name, value in usual.items():
            setattr(numba.config, name, value)
    if folder is not None:
        dispatcher.compile = functools.partial(_compile_or_wait, dispatcher.compile, folder)
    found: Callable[..., Any] = dispatcher
    return found


def _compile_or_wait(compile_it: Callable[..., Any], folder: Path, *signature: Any) -> Any:
    """Compile for a signature, or wait while another process does so and load what it has kept."""
    with one_process_at_a_time(folder):
        return compile_it(*signature)


def _compiled_calls(
    function: Function, replacements: Replacements, made: dict[Function, Any], way: _Way
) -> dict[str, Any]:
    """What a function calls, by name, compiled to be put inside each of its callers; `made` is what already is."""
    found: dict[str, Any] = {
        name: module
        for name, module in way.modules.items()
        if isinstance(plain(function).__globals__.get(name), types.ModuleType)
    }
    for name, called in calls_of(function, replacements):
        if called not in made:
            made[called] = _inlined(called, replacements, made, way)
        found[name] = made[called]
    return found


def _inlined(function: Function, replacements: Replacements, made: dict[Function, Any], way: _Way) -> Any:
    """A function compiled to be put inside each of its callers.

    It is compiled once, however many call it, and without what Python would need to call it, which takes as long
    as the function itself where arguments are nested tuples.
    """
    import numba

    inside = numba.njit(nogil=True, forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, **way.options)
    return inside(with_globals(function, _compiled_calls(function, replacements, made, way)))


def _cache_folder(function: Function, replacements: Replacements, sources: tuple[Path, ...] = ()) -> Path | None:
    """Folder for the compiled function, made if need be; None if it cannot be, or if nothing is to be kept.

    `sources` are files that went in beside those of the functions.

    A closure is known to numba's cache by what it encloses, which is another object in every process. A function that
    was typed into an interpreter or a notebook has no file, whose bytes would tell it from what it was before.
    """
    if plain(function).__closure__ or not all(map(_has_source, functions_in(function, replacements))):
        return None
    try:
        folder = _cache_base() / _digest(function, replacements, sources)
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # Path.home() may not exist
        return None
    return folder if os.access(folder, os.W_OK) else None


def _has_source(function: Function) -> bool:
    """Has a function a file, or, if it was made from a text, this text as its documentation?"""
    name = plain(function).__code__.co_filename
    return Path(name).is_file() or (name.startswith("<") and "def " in (function.__doc__ or ""))


def _cache_base() -> Path:
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    return Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "agv_ncs"


def _digest(function: Function, replacements: Replacements, sources: tuple[Path, ...]) -> str:
    """Name of the code that goes into a compiled function: all sources, and the constants taken from other files."""
    digest = hashlib.sha256()
    for part in functions_in(function, replacements):
        source = Path(plain(part).__code__.co_filename)
        digest.update(source.read_bytes() if source.is_file() else (part.__doc__ or "").encode())
        code = plain(part).__code__  # which tells apart functions of one file
        constants = {name: value for name, value in named_by(part) if _is_constant(value)}
        written = [value for value in code.co_consts if _is_constant(value)]
        digest.update(code.co_code + repr((written, sorted(constants.items()))).encode())
        for name, value in sorted(named_by(part), key=lambda named: named[0]):
            if isinstance(value, np.ndarray):
                digest.update(f"{name} {value.dtype} {value.shape}".encode() + value.tobytes())
    for source in sources:
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _is_constant(value: object) -> bool:
    """Is it a number, a text, or a tuple of such?"""
    return isinstance(value, (bool, int, float, str)) or (isinstance(value, tuple) and all(map(_is_constant, value)))
