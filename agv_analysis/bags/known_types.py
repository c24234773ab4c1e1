"""Definitions that a bag does not hold itself: those of a folder, and those of the ROS 2 distributions.

Bags in sqlite3 have none before Iron, and a recorder that does not find a definition leaves it empty. Types of the
distributions have changed over the years, so which one is meant decides, in this order, the recorded hash of the type,
the distribution that the bag names, and which of the definitions describes the messages (`topic_types`).
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from agv_analysis.bags.bag_errors import BagError, UndecodableError
from agv_analysis.bags.idl import definitions_in_idl
from agv_analysis.bags.message_batch import NO_DEFINITION
from agv_analysis.bags.message_definitions import assemble, installed_definition
from agv_analysis.bags.records import Schema
from agv_analysis.bags.schema import (
    WIDTHS,
    MissingTypeError,
    Struct,
    definitions_by_name,
    parse_schema,
    short_name,
)
from agv_ros.errors import UserError

UNDEFINED = "the bag does not hold the definition of its type"
_WITHOUT_ROSBAGS = f"{UNDEFINED}; those of ROS 2 come with rosbags: `pip install rosbags`"

_ENDINGS = (".msg", ".idl", ".srv")
_EVENT = "_Event"


class Definition(NamedTuple):
    """A definition with those of all types in it, and where it is from."""

    schema: Schema
    source: str
    """As in "ROS 2 humble"; empty if it is the bag's own."""
    gap: str = "is not in the bag, that of"
    width: int = WIDTHS[0]
    """Bytes of a character of its wstrings."""
    is_guess: bool = False
    """Is it merely possible that the type has no members, since the bag defines it by nothing?"""

    @property
    def form(self) -> Struct:
        """Members of the type. Raises UndecodableError."""
        return _parsed(self.schema.name, self.schema.encoding, self.schema.data, self.width)

    @property
    def is_worth_a_note(self) -> bool:
        """Could it be a wrong one? That a type has no members needs no definition."""
        return self.source != "" and not self.form.is_empty

    @property
    def note(self) -> str:
        """What is said of a definition that the bag does not hold."""
        return f"topic whose definition {self.gap} {self.source}"


class _Known(NamedTuple):
    text: str
    hash: str
    """RIHS01, empty if it is not known."""
    source: str


def is_undefined(schema: Schema) -> bool:
    """Does a bag name this type without defining it? A type without members looks the same."""
    return schema.encoding in ("", "ros2msg", "ros2idl") and not schema.data.strip()


class KnownTypes:
    """Definitions from outside of a bag."""

    def __init__(self, folder: Path | None = None) -> None:
        """`folder`: holds .msg, .idl or .srv files, as a package, a workspace's `share` or `src`, or loosely.

        Raises BagError if it does not.
        """
        self._folder = folder
        self._files: dict[str, list[Path]] = {}
        if folder is None:
            return
        for file in sorted(folder.rglob("*")):
            if file.suffix in _ENDINGS and file.is_file():
                self._files.setdefault(_name_of(file), []).append(file)
        if not self._files:
            raise BagError(f"{folder}: no definitions: there is no .msg, .idl or .srv file in it or in its folders")

    def candidates(self, schema: Schema, distro: str, type_hash: str) -> list[Definition]:
        """Definitions that a type may have: the bag's own `schema`, or, if that is empty, those from elsewhere.

        Types that the bag's own uses without describing them are taken from elsewhere, too. Of several that mean the
        same there is one, the newest. `distro`, `type_hash`: what the bag says, or empty.
        Raises UndecodableError if no definition is known, or none is understood.
        """
        if not is_undefined(schema):
            return _in_all_widths(self._completed(schema, distro))
        found: dict[Struct, Definition] = {}
        reason = no_definition()
        for known in self._candidates(schema.name, distro, type_hash):
            try:
                for definition in _in_all_widths(
                    Definition(schema.defined_by("ros2msg", known.text.encode()), known.source)
                ):
                    found.setdefault(definition.form, definition)
            except UndecodableError as error:
                reason = f"{UNDEFINED}, and that of {known.source} is not understood: {error}"
        if not found and reason == no_definition() and schema.encoding == "ros2msg":
            return [Definition(schema, "", is_guess=True)]
        if not found:
            raise UndecodableError(reason)
        return list(found.values())

    def _candidates(self, kind: str, distro: str, type_hash: str) -> list[_Known]:
        if self._folder is not None and (text := self._of_folder(kind, distro)) is not None:
            return [_Known(text, "", str(self._folder))]
        found = list(_of_distributions(kind, distro))
        if type_hash and (proven := [known for known in found if known.hash == type_hash]):
            return proven[:1]
        if not found and (text := _assembled(kind, _installed)) is not None:
            return [_Known(text, "", "the installed ROS 2")]
        return found

    def _of_folder(self, kind: str, distro: str) -> str | None:
        """Definition by the folder, with types that it does not hold from the distributions."""
        if self._read(kind) is None and self._read(_service(kind)) is None:
            return None

        return _assembled(kind, lambda name: self._alone(name, distro))

    def _alone(self, kind: str, distro: str) -> str | None:
        """Definition of one type without those of the types in it; None if there is none, or several."""
        text = self._read(kind)
        if text is None:
            found = _of_distributions(kind, distro)
            if len({parse_schema(kind, "ros2msg", known.text) for known in found}) > 1:
                return None
            text = found[0].text.split("\n====")[0] if found else _installed(kind)
        return text

    def _completed(self, schema: Schema, distro: str) -> Definition:
        """A definition with those of the types in it, if the bag does not hold these, but they are known elsewhere."""
        try:
            texts = definitions_by_name(schema.name, schema.encoding, schema.text)
            parse_schema(schema.name, schema.encoding, schema.text)
        except MissingTypeError:
            text = _assembled(schema.name, lambda name: texts.get(short_name(name)) or self._alone(name, distro))
            if text is not None:
                source = "ROS 2" if self._folder is None else str(self._folder)
                return Definition(schema.defined_by("ros2msg", text.encode()), source, "lacks types, those of")
        except UndecodableError:
            pass  # parsing it says why
        return Definition(schema, "")

    def _read(self, kind: str) -> str | None:
        """Text of one definition of the folder in the message language, without those of the types in it."""
        package, _, rest = kind.partition("/")
        short = rest.rpartition("/")[2]
        part = "msg" if rest.startswith("msg/") or "/" not in rest else rest.partition("/")[0]
        for name in (f"{package}/{part}/{short}", f"/{short}"):
            if files := self._files.get(name):
                return _one_text(files, f"{package}/{part}/{short}")
        return None


def _name_of(file: Path) -> str:
    """Type that a file defines: "package/msg/Name", or "/Name" if its folder does not say the package."""
    folder = file.parent
    if folder.name in ("msg", "srv"):
        return f"{folder.parent.resolve().name}/{folder.name}/{file.stem}"
    return f"/{file.stem}"


def _one_text(files: list[Path], kind: str) -> str:
    """What files say of one type: built workspaces hold each definition several times."""
    plain = [file for file in files if file.suffix != ".idl"] or files
    texts = {_text_of(file, kind): file for file in plain}
    if len(texts) > 1:
        one, other, *_ = texts.values()
        raise UndecodableError(f"{NO_DEFINITION}, and {one} and {other} give different ones")
    return next(iter(texts))


def _text_of(file: Path, kind: str) -> str:
    try:
        text = file.read_bytes().decode("utf-8", "replace")
    except OSError as error:
        raise BagError(f"{file}: cannot be read: {error.strerror}") from None
    if file.suffix != ".idl":
        return text
    try:
        found = definitions_in_idl(text)
    except UndecodableError as error:
        raise BagError(f"{file}: {error}") from None
    if "/srv/" in kind:
        return f"{found.get(f'{kind}_Request', '')}\n---\n{found.get(f'{kind}_Response', '')}"
    return found.get(kind, "")


# -- services ---------------------------------------------------------------------------------------------------------


def _service(kind: str) -> str:
    """Service that an event is of: "std_srvs/srv/Trigger" for "std_srvs/srv/Trigger_Event"."""
    for ending in (_EVENT, "_Request", "_Response"):
        if "/srv/" in kind and kind.endswith(ending):
            return kind.removesuffix(ending)
    return ""


def _assembled(kind: str, find: Callable[[str], str | None]) -> str | None:
    """Definition of a message or service event with those of all types in it; None if one is not found.

    Source of events: rosidl's `service_msgs/msg/ServiceEventInfo`, and at most one request and one response.
    """

    def definition(name: str) -> str:
        service = _service(name)
        if service and name.endswith(_EVENT):
            parts = "".join(f"{service}_{part}[<=1] {part.lower()}\n" for part in ("Request", "Response"))
            return f"service_msgs/ServiceEventInfo info\n{parts}"
        text = find(service) if service else find(_long(name))
        if text is None:
            raise UserError(name)
        if not service:
            return text
        request, _, response = text.partition("---")
        return response if name.endswith("_Response") else request

    try:
        return assemble(kind, definition)
    except UserError:
        return None


def _long(name: str) -> str:
    """Full name of a message type: "geometry_msgs/msg/Point" for "geometry_msgs/Point"."""
    package, _, rest = name.partition("/")
    return name if "/" in rest else f"{package}/msg/{rest}"


def _installed(name: str) -> str | None:
    try:
        return installed_definition(name)
    except UserError:
        return None


# -- the distributions ------------------------------------------------------------------------------------------------


@functools.cache
def _of_distributions(kind: str, distro: str) -> tuple[_Known, ...]:
    """Definitions of a type in the distribution that is named, or in all; equal ones once, the newest first."""
    found: dict[str, list[str]] = {}
    hashes: dict[str, str] = {}
    for name, store in _stores(distro):
        if kind not in store.types:
            continue
        text = str(store.generate_msgdef(kind, ros_version=2)[0])
        found.setdefault(text, []).append(name)
        hashes[text] = str(store.hash_rihs01(kind))
    return tuple(_Known(text, hashes[text], f"ROS 2 {_range(names)}") for text, names in found.items())


def _range(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[-1]} to {names[0]}"


def _stores(distro: str) -> Iterator[tuple[str, Any]]:
    """Types of the distribution that is named, or, if it is not known, of all, the newest first."""
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        return
    names = {store.value.removeprefix("ros2_"): store for store in Stores if store.value.startswith("ros2_")}
    chosen = {distro: names[distro]} if distro in names else dict(reversed(names.items()))
    for name, store in chosen.items():
        yield name, get_typestore(store)


# -- forms ------------------------------------------------------------------------------------------------------------


def no_definition() -> str:
    """Why a type without any definition is not decoded."""
    return NO_DEFINITION if importlib.util.find_spec("rosbags") else _WITHOUT_ROSBAGS


@functools.lru_cache(1024)
def _parsed(name: str, encoding: str, data: bytes, width: int) -> Struct:
    return parse_schema(name, encoding, Schema(0, name, encoding, data).text, width)


def _in_all_widths(definition: Definition) -> list[Definition]:
    """A definition, once for each width that its wstrings may have. Raises UndecodableError."""
    has_wstrings = definition.form.has_wstrings
    return [definition._replace(width=width) for width in (WIDTHS if has_wstrings else WIDTHS[:1])]
