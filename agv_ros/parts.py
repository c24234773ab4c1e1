"""Parts of the loop that can be exchanged: plain functions with a name, of this package or of another one.

Theory of operation. A part is a function of floats. Some of its arguments are known to the loop by their names (the
tracking error, say); the others are its own parameters, each with a default, and with `Annotated` also a unit, bounds
and a description:

    def law(x_e, y_e, theta_e, v_r, w_r, k: Annotated[float, Quantity("gain", unit="1/s", low=0.0)] = 2.0):

A registry names the parts of one kind: those of this package, and those that other packages announce by entry points.
For each it makes an adapter, a function with the arguments that the loop calls it with, whatever the part's own order.
Nodes call the adapter; the simulation compiles it in place of the default one.
"""

from __future__ import annotations

import functools
import inspect
import math
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, make_dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from agv_ros.parameters import Parameter, ParameterError, group, parameter
from agv_ros.substitution import Function


class PartError(ParameterError):
    """A part that cannot be used; the text names it and the reason."""


@dataclass(frozen=True)
class Quantity:
    """What is known of a part's parameter beside its name and default, for `Annotated[float, Quantity(...)]`."""

    description: str
    unit: str = ""
    low: float | None = None
    """Smallest value allowed."""
    high: float | None = None
    """Largest value allowed; `math.inf` allows infinity, too."""
    above: float | None = None
    """The value must be larger than this."""
    limit: bool = False
    """Does it limit something, so that a larger value limits less? Always so where the default is infinite."""


@dataclass(frozen=True)
class Call:
    """How the loop calls the parts of one kind."""

    required: tuple[str, ...]
    """Arguments that every part takes, first and in this order."""
    optional: tuple[str, ...] = ()
    """Arguments that a part gets if it names them."""
    results: tuple[str, ...] = ()
    """What it returns, in words, for messages."""
    states: str = ""
    """Where arguments of the part's own stand that are its state: after this argument and before the next required one.

    They are returned, too, in the same order after the results before them. Empty: such parts have none.
    """
    memory: bool = False
    """May a part name an argument `memory`, a tuple of floats that it returns anew, as the last result?"""


@dataclass(frozen=True)
class Part:
    """A function that was chosen by its name."""

    name: str
    source: str
    """Where it comes from, for messages: `agv_ncs`, or the entry point's value."""
    function: Function
    """The function as it was written."""
    adapter: Function
    """The same with the arguments that the loop calls it with."""
    arguments: frozenset[str]
    """Names of all its arguments."""
    parameters: tuple[Parameter, ...]
    """Its own parameters, in the order of its signature."""
    limits: tuple[str, ...]
    """Those of them that limit something."""
    states: tuple[str, ...] = ()
    """Names of its states."""
    memory: tuple[float, ...] = ()
    """What its memory begins with."""

    @property
    def defaults(self) -> tuple[float, ...]:
        """Default of each parameter."""
        return tuple(parameter.default for parameter in self.parameters)


@dataclass(frozen=True)
class Registry:
    """The parts of one kind by name."""

    kind: str
    """What such a part is called in messages: `control law`."""
    group: str
    """Group of entry points by which other packages announce theirs."""
    call: Call
    template: str
    """Source of an adapter: {call} is the call of the part, {name} the adapter's name."""
    own: Mapping[str, Function]
    """Those of this package."""
    _found: dict[str, Part] = field(default_factory=dict, compare=False)

    def names(self) -> tuple[str, ...]:
        """Names of all parts: those of this package, then those of other installed ones."""
        return (*self.own, *(name for name in installed(self.group) if name not in self.own))

    def find(self, name: str) -> Part:
        """The part called `name`.

        Raises PartError if there is none, if two have this name, or if it cannot be loaded or called.
        """
        if name not in self._found:
            self._found[name] = self._load(name)
        return self._found[name]

    def _load(self, name: str) -> Part:
        points = installed(self.group).get(name, ())
        sources = [*(["that of agv_ncs"] if name in self.own else []), *(f"{point.value}" for point in points)]
        if not sources:
            raise PartError(f"there is no {self.kind} {name!r}, must be one of {', '.join(self.names())}")
        if len(sources) > 1:
            raise PartError(f"two {self.kind}s are called {name}: {' and '.join(sources)}; rename one")
        if name in self.own:
            return part_of(name, "agv_ncs", self.own[name], self)
        where = f"{self.kind} {name} ({points[0].value})"
        try:
            function = points[0].load()
        except Exception as error:  # another package's code, in which anything can go wrong
            raise PartError(f"{where} cannot be loaded: {error}") from error
        function = getattr(function, "py_func", function)  # one that its author has compiled with numba
        if not isinstance(function, types.FunctionType):
            raise PartError(f"{where} must be a function, found {function!r}")
        return part_of(name, points[0].value, function, self)

    def usable(self) -> dict[str, Part]:
        """All parts that can be loaded; the others are refused when they are chosen."""
        found = {}
        for name in self.names():
            try:
                found[name] = self.find(name)
            except PartError:
                continue
        return found

    def where(self, name: str) -> str:
        """Name and source of a part, for messages."""
        source = self.find(name).source
        return f"{self.kind} {name}" if source == "agv_ncs" else f"{self.kind} {name} ({source})"


@functools.cache
def installed(group: str) -> dict[str, tuple[EntryPoint, ...]]:
    """Entry points of a group by name; more than one where packages chose the same name."""
    found: dict[str, tuple[EntryPoint, ...]] = {}
    for point in sorted(set(entry_points(group=group)), key=lambda point: (point.name, point.value)):
        found[point.name] = (*found.get(point.name, ()), point)
    return found


def part_of(name: str, source: str, function: Function, registry: Registry) -> Part:
    """A part from its function. Raises PartError for a signature that the loop cannot call, naming what is wrong."""
    where, call = f"{registry.kind} {name} ({source})", registry.call
    try:
        hints = get_type_hints(function, include_extras=True)
        signature = inspect.signature(function)
    except Exception as error:  # an annotation that does not evaluate can raise anything
        raise PartError(f"{where}: its signature cannot be read: {error}") from error
    names = list(signature.parameters)
    for argument in signature.parameters.values():
        if argument.kind in (argument.VAR_POSITIONAL, argument.VAR_KEYWORD, argument.KEYWORD_ONLY):
            raise PartError(f"{where}: argument {argument.name} must be an ordinary one, found {argument}")
    states: tuple[str, ...] = ()
    wanted = list(call.required)
    if call.states and call.states in names:
        begin, after = names.index(call.states) + 1, wanted[wanted.index(call.states) + 1]
        if after in names:
            states = tuple(names[begin : names.index(after)])
            wanted[begin:begin] = states
    if names[: len(wanted)] != wanted:
        raise PartError(f"{where}: its first arguments must be {', '.join(wanted)}, found {', '.join(names) or 'none'}")
    memory: tuple[float, ...] = ()
    parameters, limits = [], []
    for argument in list(signature.parameters.values())[len(wanted) :]:
        if argument.name == "memory" and call.memory:
            memory = _initial_memory(argument, where)
        elif argument.name not in call.optional:
            found, is_limit = _parameter_of(argument, hints.get(argument.name), where)
            parameters.append(found)
            limits += [found.name] if is_limit else []
    adapter = _adapter(name, function, names, states, tuple(p.name for p in parameters), registry)
    return Part(
        name, source, function, adapter, frozenset(names), tuple(parameters), tuple(limits), states, memory
    )  # fmt: skip


def _initial_memory(argument: inspect.Parameter, where: str) -> tuple[float, ...]:
    begin = argument.default
    if not isinstance(begin, tuple) or not all(isinstance(x, (int, float)) and math.isfinite(x) for x in begin):
        raise PartError(f"{where}: memory must have a tuple of numbers as default, which it begins with, got {begin!r}")
    return tuple(map(float, begin))


def _parameter_of(argument: inspect.Parameter, hint: Any, where: str) -> tuple[Parameter, bool]:
    known = Quantity("")
    if get_origin(hint) is Annotated:
        known = next((extra for extra in get_args(hint)[1:] if isinstance(extra, Quantity)), known)
        hint = get_args(hint)[0]
    default = argument.default
    if default is argument.empty:
        raise PartError(f"{where}: its parameter {argument.name} needs a default")
    if isinstance(default, bool) or not isinstance(default, (int, float)) or hint not in (None, float, int):
        raise PartError(f"{where}: its parameter {argument.name} must be a float, got {argument}")
    high = math.inf if known.high is None and math.isinf(default) else known.high
    found = Parameter(
        argument.name, "double", float(default), known.unit, known.description or f"parameter of {where}",
        known.low, high, known.above, runtime=True,
    )  # fmt: skip
    try:
        found.check("", found.default)
    except ParameterError as error:
        raise PartError(f"{where}: default of a parameter: {error}") from None
    return found, known.limit or math.isinf(default)


def _adapter(
    name: str, function: Function, arguments: Sequence[str], states: Sequence[str],
    parameters: Sequence[str], registry: Registry,
) -> Function:  # fmt: skip
    """The function that the loop calls: the part's arguments by name, its states and parameters out of tuples.

    Not a closure, which could not be compiled and kept: what it calls is a global of its own.
    """
    values = {state: f"states[{i}]" for i, state in enumerate(states)}
    values |= {parameter: f"parameters[{i}]" for i, parameter in enumerate(parameters)}
    call = f"part({', '.join(values.get(argument, argument) for argument in arguments)})"
    several = len(states)
    unpacked = "".join(f", s{i}" for i in range(several))
    packed = "(" + "".join(f"s{i}, " for i in range(several)) + ")"
    text = registry.template.format(
        name=f"{registry.kind.replace(' ', '_')}_{name}", call=call, unpacked=unpacked, packed=packed,
        memory=", memory" if "memory" in arguments and registry.call.memory else "",
    )  # fmt: skip
    known: dict[str, Any] = {"part": function}
    exec(compile(text, f"<adapter of {registry.kind} {name}>", "exec"), known)
    adapter = next(
        value for key, value in known.items() if isinstance(value, types.FunctionType) and key != "part"
    )  # fmt: skip
    adapter.__doc__ = text  # what tells it apart from adapters of other signatures
    return adapter


def schema_of(class_name: str, parts: Mapping[str, Part], module: dict[str, Any]) -> type:
    """A schema with a group of parameters for each part that has some: names `part.parameter`.

    The classes are put into the `module` given by its globals, where other processes find them.
    """
    fields: list[tuple[str, type, Any]] = []
    for part in parts.values():
        if part.parameters:
            own = _dataclass(
                f"{class_name}_{part.name}", [(p.name, float, _field_of(p)) for p in part.parameters], module
            )
            fields.append((part.name, own, group(own)))
    return _dataclass(class_name, fields, module)


def _dataclass(name: str, fields: list[tuple[str, type, Any]], module: dict[str, Any]) -> type:
    made = make_dataclass(name, fields, frozen=True, namespace={"__module__": module["__name__"]})
    module[name] = made
    return made


def _field_of(known: Parameter) -> Any:
    return parameter(
        known.default, known.description, unit=known.unit, low=known.low, high=known.high, above=known.above,
        runtime=known.runtime,
    )  # fmt: skip


def field_of(part: Part, name: str) -> Any:
    """Dataclass field for one parameter of a part, as `parameter` makes it."""
    return _field_of(next(known for known in part.parameters if known.name == name))


def checked(part: Part, where: str, outcome: Callable[[], Any]) -> tuple[float, ...]:
    """The numbers that a part returned, flattened. Raises PartError if it raises, or returns something else."""
    try:
        found = outcome()
    except Exception as error:  # another package's code, in which anything can go wrong
        raise PartError(f"{where} raises {type(error).__name__}: {error}") from error
    flat = tuple(_flat(found))
    if not all(isinstance(x, (int, float)) for x in flat):
        raise PartError(f"{where} must return numbers, got {found!r}")
    return flat


def _flat(found: Any) -> Any:
    if isinstance(found, tuple):
        for inner in found:
            yield from _flat(inner)
    else:
        yield found
