"""Message definitions as a bag carries them (MCAP's `ros2msg`) -> flat list of members, in the order of the wire.

Sources: MCAP registry, `ros2msg`: the definition, then those of the types in it, each after a line of `=` and a line
`MSG: package/Name`; https://design.ros2.org/articles/legacy_interface_definition.html for the language.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

from agv_analysis.bags.bag_errors import UndecodableError
from agv_analysis.bags.idl import definitions_in_idl

STRING = "string"

WSTRING = "wstring"
WIDTHS = (4, 2)
"""Bytes of a character of a wstring, which its encapsulation does not tell: ROS 2 Jazzy writes 4, DDS-XTypes has 2."""

PLACEHOLDER = "structure_needs_at_least_one_member"
"""The member that ROS 2 gives to a message without any, because IDL knows no such struct."""

PRIMITIVES = {
    "bool": "?", "byte": "u1", "char": "u1", "uint8": "u1", "int8": "i1", "uint16": "u2", "int16": "i2",
    "uint32": "u4", "int32": "i4", "uint64": "u8", "int64": "i8", "float32": "f4", "float64": "f8",
}  # fmt: skip
"""Types of fixed size -> numpy's code without byte order; a type is aligned to its size."""

_BUILT_IN = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
}
"""Types that some writers leave out of their definitions."""

_MAX_DEPTH = 32
_MAX_MEMBERS = 4096
"""Bounds on what a definition may ask for; common_interfaces stays below 8 and 100."""

_SEPARATOR = re.compile(r"^={20,}\s*$", re.MULTILINE)
_FIELD = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?P<string_bound><=\d+)?"
    r"(?P<array>\[(?P<bound><=)?(?P<length>\d*)\])?\s+(?P<name>[A-Za-z]\w*)(?P<rest>\s*=.*|\s.*|)"
)


class MissingTypeError(UndecodableError):
    """A definition that uses a type without describing it."""


@dataclass(frozen=True)
class Member:
    """One member of a message on the wire."""

    path: str
    """Dotted path within its struct."""
    element: str | Struct
    """numpy's code of a primitive, STRING, a wstring with its width ("wstring2"), or what an array consists of."""
    length: int | None = None
    """Elements of an array, None for a single value; the bound of a sequence, None where it has none."""
    is_sequence: bool = False


@dataclass(frozen=True)
class Struct:
    """A message, or what an array of messages consists of; messages that are single members are unfolded into it."""

    members: tuple[Member, ...]

    @property
    def is_empty(self) -> bool:
        """Is this a message without values?"""
        return all(m.path.rpartition(".")[2] == PLACEHOLDER for m in self.members)

    @property
    def has_sequences(self) -> bool:
        """Can two messages of this type differ in their number of values?"""
        return any(m.is_sequence or (isinstance(m.element, Struct) and m.element.has_sequences) for m in self.members)

    @property
    def has_wstrings(self) -> bool:
        """Does the layout depend on how wide the characters of a wstring are?"""
        return any(
            m.element.has_wstrings if isinstance(m.element, Struct) else is_wstring(m.element) for m in self.members
        )


def is_wstring(element: str) -> bool:
    """Is this member a wstring, of whatever width?"""
    return element.startswith(WSTRING)


def parse_schema(name: str, encoding: str, text: str, width: int = WIDTHS[0]) -> Struct:
    """Members of the type `name` ("geometry_msgs/msg/PoseStamped"); `width`: bytes of a character of its wstrings.

    Raises UndecodableError if the text is not understood, lacks a type, or describes a type without end.
    """
    texts = definitions_by_name(name, encoding, text)
    return Struct(tuple(_Unfolding(texts, width).members(short_name(name), "", 0)))


def definitions_by_name(name: str, encoding: str, text: str) -> dict[str, str]:
    """Definitions, in the message language, of the type `name` and of all types in it, by their short names.

    Raises UndecodableError if the text is not understood.
    """
    if encoding not in ("ros2msg", "ros2idl"):
        raise UndecodableError(f"its definition is in {encoding or 'no language'!r}; ros2msg and ros2idl are read")
    named = _by_name(short_name(name), text) if encoding == "ros2msg" else _by_name_in_idl(name, text)
    return {**_BUILT_IN, **named}


def short_name(name: str) -> str:
    """Name of a type as definitions have it: "geometry_msgs/Point" for "geometry_msgs/msg/Point"."""
    return name.replace("/msg/", "/")


def _by_name_in_idl(name: str, text: str) -> dict[str, str]:
    texts = {short_name(kind): definition for kind, definition in definitions_in_idl(text).items()}
    if short_name(name) not in texts:
        raise UndecodableError("its definition in IDL does not describe it")
    return texts


def _by_name(name: str, text: str) -> dict[str, str]:
    """Text of each type in a definition."""
    first, *others = _SEPARATOR.split(text)
    texts = {name: first}
    for other in others:
        head, _, body = other.strip().partition("\n")
        if not head.startswith("MSG:"):
            raise UndecodableError(f"its definition has a part that begins with {head[:60]!r} instead of 'MSG: type'")
        texts[short_name(head[4:].strip())] = body
    return texts


class _Unfolding:
    """Unfolds a type into members, counting them."""

    def __init__(self, texts: dict[str, str], width: int) -> None:
        self._texts = texts
        self._width = width
        self._count = 0

    def members(self, name: str, prefix: str, depth: int) -> Iterator[Member]:
        """Members of the type `name`, their paths beginning with `prefix`."""
        if depth > _MAX_DEPTH:
            raise UndecodableError(f"its definition is nested more than {_MAX_DEPTH} deep")
        known: set[str] = set()
        for line in self._texts[name].splitlines():
            member = parse_line(line)
            if member is None:
                continue
            if member.path in known:
                raise UndecodableError(f"its definition declares {prefix}{member.path} twice")
            known.add(member.path)
            self._count += 1
            if self._count > _MAX_MEMBERS:
                raise UndecodableError(f"its definition has more than {_MAX_MEMBERS} members")
            yield from self._unfold(name, prefix, member, depth)
        if not known:
            yield Member(f"{prefix}{PLACEHOLDER}", "u1")

    def _unfold(self, parent: str, prefix: str, member: Member, depth: int) -> Iterator[Member]:
        path, kind = prefix + member.path, str(member.element)
        is_array = member.is_sequence or member.length is not None
        if kind == STRING or kind in PRIMITIVES:
            yield Member(path, PRIMITIVES.get(kind, STRING), member.length, member.is_sequence)
        elif kind == WSTRING:
            yield Member(path, f"{WSTRING}{self._width}", member.length, member.is_sequence)
        elif is_array:
            struct = Struct(tuple(self.members(resolve_type(self._texts, kind, parent), "", depth + 1)))
            yield Member(path, struct, member.length, member.is_sequence)
        else:
            yield from self.members(resolve_type(self._texts, kind, parent), f"{path}.", depth + 1)


def resolve_type(texts: dict[str, str], kind: str, parent: str) -> str:
    """Full name, among the definitions `texts`, of a type as a member of `parent` names it. Raises UndecodableError."""
    short = short_name(kind)
    package = parent.rpartition("/")[0]
    candidates = [short] if "/" in short else [f"{package}/{short}", f"std_msgs/{short}"]
    for candidate in candidates:
        if candidate in texts:
            return candidate
    raise MissingTypeError(f"its definition uses the type {kind!r} without describing it")


def parse_line(line: str) -> Member | None:
    """The member that a line declares, its type by name; None for a constant or a comment."""
    line = line.strip()
    if not line or line.startswith("#"):
        return None
    found = _FIELD.match(line)
    if found is None:
        raise UndecodableError(f"its definition has a line that is not understood: {line[:80]!r}")
    if found["rest"].lstrip().startswith("="):
        return None
    length = int(found["length"]) if found["length"] else None
    if length is not None and length > 2**32:
        raise UndecodableError(f"its member {found['name']!r} has {length} elements")
    is_sequence = found["array"] is not None and (length is None or found["bound"] is not None)
    return Member(found["name"], found["type"], length, is_sequence)
