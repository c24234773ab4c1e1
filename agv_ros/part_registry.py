"""Registries: functions of one kind by name, of this package, of other installed ones, and of this process alone.

What goes wrong in another package's function is one line that names it and the reason. One that cannot be used has
no effect until it is chosen.
"""

from __future__ import annotations

import functools
import importlib
import pkgutil
import types
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from agv_ros.parameters import forget_parameters
from agv_ros.parts import Call, Part, PartError, in_one_line, part_of, shortened
from agv_ros.substitution import Function


@dataclass(frozen=True)
class Functions:
    """Functions of one kind by name: those of this package, and those that other packages announce."""

    kind: str
    """What such a function is called in messages: `control law`."""
    group: str
    """Group of entry points by which other packages announce theirs."""
    own: Mapping[str, Function]
    """Those of this package."""
    reserved: tuple[str, ...] = ()
    """Names of this package that stand for something else than a function."""
    _registered: dict[str, tuple[str, Function]] = field(default_factory=dict, compare=False)
    """Functions of this process alone, each after what it is called in messages."""

    def names(self) -> tuple[str, ...]:
        """All names: those of this package, of other installed ones, be they usable or not, and of this process."""
        return tuple(dict.fromkeys((*self.own, *self.reserved, *installed(self.group), *self._registered)))

    def register(self, name: str, function: Function) -> None:
        """Add a function for this process alone, or put another one in the place of one that was added so.

        Raises PartError for a name that is taken, or if it is not a function.
        """
        self._registered[name] = self._named(name, function)
        forget_parameters()

    def _named(self, name: str, function: Function) -> tuple[str, Function]:
        """What a function that is registered is called in messages, and the function itself."""
        if name in self.names() and name not in self._registered:
            raise PartError(f"there is a {self.kind} {name} already: choose another name")
        function = getattr(function, "py_func", function)  # one that its author has compiled with numba
        if not isinstance(function, types.FunctionType):
            raise PartError(f"{self.kind} {name} must be a function, found {shortened(function)}")
        return f"{self.kind} {name} (registered by {function.__module__})", function

    @property
    def remedy(self) -> str:
        """What to do where a name is none of `names`."""
        return f"if another package has this {self.kind}, install it (its entry point is in the group {self.group})"

    def load(self, name: str) -> tuple[str, Function]:
        """What the function called `name` is called in messages, and the function itself.

        Raises PartError if there is none, if two have this name, or if it cannot be loaded.
        """
        if name in self._registered:
            return self._registered[name]
        points = installed(self.group).get(name, ())
        known = name in self.own or name in self.reserved
        sources = [*(["that of agv_ncs"] if known else []), *(f"{point.value} of another package" for point in points)]
        if not sources:
            raise PartError(
                f"there is no {self.kind} {name!r}, must be one of {', '.join(self.names())}: {self.remedy}"
            )
        if len(sources) > 1:
            raise PartError(f"two {self.kind}s are called {name}: {' and '.join(sources)}; rename one")
        if name in self.own:
            return f"{self.kind} {name}", self.own[name]
        where = f"{self.kind} {name} ({points[0].value})"
        try:
            function = points[0].load()
        except (Exception, SystemExit) as error:  # another package's code, in which anything can go wrong
            reason = (
                " ".join(str(error).split()) if isinstance(error, (ImportError, AttributeError)) else in_one_line(error)
            )
            raise PartError(f"{where} cannot be loaded: {reason}") from error
        function = getattr(function, "py_func", function)  # one that its author has compiled with numba
        if not callable(function):
            raise PartError(f"{where} must be a function, found {shortened(function)}")
        return where, function


@dataclass(frozen=True)
class Registry(Functions):
    """The parts of one kind by name."""

    call: Call = Call("", (), "", (), "", "", ())
    _found: dict[str, Part] = field(default_factory=dict, compare=False)

    def register(self, name: str, function: Function) -> None:
        """Add a part for this process alone, or put another one with the same parameters in its place.

        Raises PartError as for functions, and if it cannot be called.
        """
        where, function = self._named(name, function)
        part, before = part_of(name, where, function, self.call), self._found.get(name)
        names = [known.name for known in part.parameters]
        if before is not None and names != [known.name for known in before.parameters]:
            raise PartError(
                f"{where}: its parameters are {', '.join(names) or 'none'}, but scenarios may hold values of "
                f"{', '.join(known.name for known in before.parameters) or 'none'}, with which it was registered "
                "before: choose another name"
            )
        self._found[name] = part
        super().register(name, function)

    def find(self, name: str) -> Part:
        """The part called `name`. Raises PartError as `load` does, and if it cannot be called."""
        if name not in self._found:
            where, function = self.load(name)
            self._found[name] = part_of(name, where, function, self.call)
        return self._found[name]

    def own_part(self, name: str) -> Part:
        """A part of this package, whatever other packages call theirs."""
        return part_of(name, f"{self.kind} {name}", self.own[name], self.call)

    def usable(self) -> dict[str, Part]:
        """All parts that can be loaded; the others are refused when they are chosen."""
        return {name: self.find(name) for name in self.names() if not self.refusal(name)}

    def refusal(self, name: str) -> str:
        """Why the part called `name` cannot be used; empty if it can, or if there is none."""
        if name in self.names():
            try:
                self.find(name)
            except PartError as error:
                return str(error)
        return ""


def own_parts(package: str, first: str, besides: Collection[str], name: str = "") -> dict[str, Function]:
    """The functions of this package's parts by name, found in the modules of a folder, so that a new one is one file.

    That of a module is the one called as the module is, or `name`; `besides` are the modules that hold none. They are
    in the order of the alphabet after the `first`, which is the default.
    """
    folder = importlib.import_module(package)
    found: dict[str, Function] = {}
    modules = (known.name for known in pkgutil.iter_modules(folder.__path__))
    for module in sorted(modules, key=lambda module: (module != first, module)):
        if module not in besides:
            function = getattr(importlib.import_module(f"{package}.{module}"), name or module, None)
            if not isinstance(function, types.FunctionType):
                raise PartError(f"{package}.{module} has no function {name or module}, and is not said to hold none")
            found[module] = function
    return found


@functools.cache
def installed(group: str) -> dict[str, tuple[EntryPoint, ...]]:
    """Entry points of a group by name; more than one where packages chose the same name."""
    found: dict[str, tuple[EntryPoint, ...]] = {}
    for point in sorted(set(_entry_points().select(group=group)), key=lambda point: (point.name, point.value)):
        found[point.name] = (*found.get(point.name, ()), point)
    return found


@functools.cache
def _entry_points() -> Any:
    """Those of all groups, for which the files of all installed packages are read: once for all registries."""
    return entry_points()
