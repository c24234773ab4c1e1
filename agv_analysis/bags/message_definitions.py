"""Message definitions as a bag carries them: the .msg text of a type and of all types in it (MCAP's `ros2msg`)."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from agv_ros.errors import UserError

_PRIMITIVES = {
    "bool", "byte", "char", "float32", "float64", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64",
    "uint64", "string", "wstring",
}  # fmt: skip

_SEPARATOR = "\n" + "=" * 80 + "\n"


def schema_of(type_name: str) -> str:
    """Definition of a type such as `geometry_msgs/msg/PoseStamped`, those of the types in it appended.

    Raises UserError if a package that the type needs is not installed.
    """
    root = _short(type_name)
    found = {root: _definition(root)}
    waiting = [root]
    while waiting:
        name = waiting.pop(0)
        for inner in _types_in(name, found[name]):
            if inner not in found:
                found[inner] = _definition(inner)
                waiting.append(inner)
    text = found.pop(root)
    return text + "".join(f"{_SEPARATOR}MSG: {name}\n{inner}" for name, inner in found.items())


def _short(type_name: str) -> str:
    package, _, name = type_name.replace("/msg/", "/").partition("/")
    return f"{package}/{name}"


def _types_in(name: str, text: str) -> Iterator[str]:
    """Names of the message types of a definition's fields, in their order."""
    for line in text.splitlines():
        words = line.split("#")[0].split()
        if len(words) < 2 or "=" in words[1]:  # blank, comment or constant
            continue
        kind = words[0].split("[")[0].split("<")[0]
        if kind not in _PRIMITIVES:
            yield _short(kind) if "/" in kind else f"{name.split('/')[0]}/{kind}"


def _definition(name: str) -> str:
    package, _, kind = name.partition("/")
    for share in _share_folders(package):
        path = share / package / "msg" / f"{kind}.msg"
        if path.is_file():
            return path.read_text(encoding="utf-8")
    raise UserError(f"no definition of the message type {name} found: is the package {package} installed?")


def _share_folders(package: str) -> Iterator[Path]:
    """Where a package's share folder may be: beside its Python module, as ROS and pip both lay it, or as ament says."""
    try:
        origin = importlib.import_module(package).__file__
    except ImportError:
        origin = None
    if origin is not None:
        yield Path(origin).parents[4] / "share"
    for prefix in (*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix):
        yield Path(prefix) / "share"
