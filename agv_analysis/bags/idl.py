"""Definitions in IDL -> the same in ROS 2's message language, which the rest of this package reads.

Sources: MCAP registry, `ros2idl`: definitions one after the other, each behind a line of `=` and a line `IDL: type`;
https://design.ros2.org/articles/idl_interface_definition.html. The library rosbags parses the language.
"""

from __future__ import annotations

import re
from typing import Any

from agv_analysis.bags.bag_errors import UndecodableError

_HEADS = re.compile(r"^={20,}\s*\nIDL:.*$", re.MULTILINE)
_INCLUDES = re.compile(r"^[ \t]*#.*$", re.MULTILINE)


def definitions_in_idl(text: str) -> dict[str, str]:
    """Definitions by the full names of their types ("geometry_msgs/msg/Point"). Raises UndecodableError."""
    try:
        from rosbags.typesys import get_types_from_idl
    except ImportError:
        raise UndecodableError("its definition is in IDL, which needs rosbags: `pip install rosbags`") from None
    found: dict[str, str] = {}
    for part in _HEADS.split(text):
        if not part.strip():
            continue
        try:
            types = get_types_from_idl(_INCLUDES.sub("", part))
        except Exception as error:  # rosbags lets through what its parser raises
            why = " ".join(str(error).split())[:80]
            raise UndecodableError(f"its definition in IDL is not understood ({why})") from None
        for name, (_, fields) in types.items():
            found[str(name)] = "".join(f"{_type(kind)} {field}\n" for field, kind in fields)
    return found


def _type(kind: Any) -> str:
    """A type of rosbags as the message language writes it."""
    form, content = kind
    if form.name == "BASE":
        name, bound = content
        return f"{name}<={bound}" if bound else str(name)
    if form.name == "NAME":
        return str(content)
    element, length = content
    if form.name == "ARRAY":
        return f"{_type(element)}[{length}]"
    return f"{_type(element)}[{f'<={length}' if length else ''}]"
