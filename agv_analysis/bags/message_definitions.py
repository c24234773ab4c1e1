"""Message definitions as a bag carries them: the .msg text of a type and of all types in it (MCAP's `ros2msg`)."""

from __future__ import annotations

import importlib.util
import os
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from agv_ros.errors import UserError

_PRIMITIVES = {
    "bool", "byte", "char", "float32", "float64", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64",
    "uint64", "string", "wstring",
}  # fmt: skip

_NAME = re.compile(r"(?P<package>[A-Za-z]\w*)/(?:(?P<part>msg|srv)/)?(?P<kind>[A-Za-z]\w*)", re.ASCII)

_SEPARATOR = "\n" + "=" * 80 + "\n"


def schema_of(type_name: str) -> str:
    """Definition of a type such as `geometry_msgs/msg/PoseStamped`, those of the types in it appended.

    Raises UserError if a package that the type needs is not installed.
    """
    return assemble(type_name, installed_definition)


def assemble(type_name: str, definition: Callable[[str], str]) -> str:
    """Definition of a type, those of the types in it appended; `definition` gives each alone, by its short name."""
    root = _short(type_name)
    found = {root: definition(root)}
    waiting = [root]
    while waiting:
        name = waiting.pop(0)
        for inner in _types_in(name, found[name]):
            if inner not in found:
                found[inner] = definition(inner)
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
            yield _short(kind) if "/" in kind else _sibling(name, kind)


def _sibling(name: str, kind: str) -> str:
    """A message type that a definition of the type `name` names without its package."""
    return "std_msgs/Header" if kind == "Header" else f"{name.split('/')[0]}/{kind}"


def installed_definition(name: str) -> str:
    """Definition of a message (`geometry_msgs/Pose`) or service (`std_srvs/srv/Trigger`) by its installed package.

    Raises UserError if the package is not installed.
    """
    found = _NAME.fullmatch(name)
    if found is None:
        raise UserError(f"{name!r} is not the name of a message type, such as geometry_msgs/msg/PoseStamped")
    package, part, kind = found["package"], found["part"], found["kind"]
    for share in _share_folders(package):
        path = share / package / (part or "msg") / f"{kind}.{part or 'msg'}"
        if path.is_file():
            return path.read_text(encoding="utf-8")
    raise UserError(f"no definition of the message type {name} found: is the package {package} installed?")


def _share_folders(package: str) -> Iterator[Path]:
    """Where a package's share folder may be: beside its Python module, as ROS and pip both lay it, or as ament says."""
    found = importlib.util.find_spec(package)  # without importing it: the name may come from a bag
    if found is not None and found.origin and len(Path(found.origin).parents) > 4:
        yield Path(found.origin).parents[4] / "share"
    for prefix in (*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix):
        yield Path(prefix) / "share"
