"""Parts of the loop that can be exchanged: plain functions with a name, of this package or of another one.

Theory of operation. A part is a function of floats. Some of its arguments are known to the loop by their names (the
tracking error, say); the others are its own parameters, each with a default, and with `Annotated` also a unit, bounds
and a description:

    def law(x_e, y_e, theta_e, v_r, w_r, k: Annotated[float, Quantity("gain", unit="1/s", low=0.0)] = 2.0):

A registry names the parts of one kind: those of this package, and those that other packages announce by entry points.
For each it makes an adapter, a function with the arguments that the loop calls it with, whatever the part's own order.
Nodes call the adapter; the simulation compiles it in place of the default one. An adapter refuses NaN where its
arguments are in range, so that a wrong part ends a run, compiled or not, instead of spoiling it.

What goes wrong in another package's part is one line that names the part and the reason. A part that cannot be used
has no effect until it is chosen.
"""

from __future__ import annotations

import inspect
import keyword
import math
import re
import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Real
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from agv_ros.parameters import Parameter, ParameterError
from agv_ros.substitution import Function

IN_RANGE = 1e100
"""A number of at least this size belongs to a loop that diverges; what a part makes of it is not held against it."""

_LONGEST_VALUE = 200
"""Characters of a value in a message."""


class PartError(ParameterError):
    """A part that cannot be used; the text names it and the reason."""


class NotANumberError(PartError):
    """A part returned NaN. Raised by adapters without a text, for they are compiled."""

    def __str__(self) -> str:
        return "returns NaN"


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

    arguments: str
    """Those of an adapter, as source: `x_e, y_e, ..., memory, parameters`."""
    required: tuple[str, ...]
    """Arguments that every part takes, first and in this order."""
    result: str
    """What a part returns, as source: `v, w` or `(x, y), (p, q)`."""
    shape: tuple[Any, ...]
    """The same as tuples in tuples, with None for each number."""
    returned: str
    """What an adapter returns, as source, in the names of `result`; {states} and {memory} where a part has such."""
    words: str
    """What a part returns, for messages: `v [m/s] and w [rad/s]`."""
    in_range: tuple[str, ...]
    """Arguments, as source, that must be in range for NaN to be the part's fault."""
    optional: tuple[str, ...] = ()
    """Arguments that a part gets if it names them."""
    states: str = ""
    """Where arguments of the part's own stand that are its state: after this argument and before the next required one.

    They are returned, too, in the same order after the results before them. Empty: such parts have none.
    """
    memory: bool = False
    """May a part name an argument `memory`, a tuple of floats that it returns anew, as the last result?"""
    runtime: bool = False
    """Can the parameters of such parts be changed while a node runs?"""
    known: Mapping[str, Any] = field(default_factory=dict)
    """What `returned` and `in_range` name beside arguments and results."""


@dataclass(frozen=True)
class Part:
    """A function that was chosen by its name."""

    name: str
    where: str
    """What it is called in messages: `control law integral (my_laws:integral)`."""
    function: Function
    """The function as it was written."""
    adapter: Function
    """The same with the arguments that the loop calls it with."""
    unchecked: Function
    """The same with these arguments, its result as it is."""
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


# -- from a function to a part -----------------------------------------------------------------------------------------


def part_of(name: str, where: str, function: Function, call: Call) -> Part:
    """A part from its function. Raises PartError for a signature that the loop cannot call, naming what is wrong."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) or keyword.iskeyword(name):
        raise PartError(f"{where}: its name must be letters, digits and _, as its parameters are called {name}.gain")
    if not isinstance(function, types.FunctionType):
        raise PartError(f"{where} must be a function, found {shortened(function)}")
    signature = inspect.signature(function)
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
        raise PartError(
            f"{where}: its first arguments must be {', '.join(call.required)}, found {', '.join(names) or 'none'}"
        )
    memory: tuple[float, ...] = ()
    parameters, limits = [], []
    for argument in list(signature.parameters.values())[len(wanted) :]:
        if argument.name == "memory" and call.memory:
            memory = _initial_memory(argument, where)
        elif argument.name not in call.optional:
            found, is_limit = _parameter_of(argument, _hint_of(argument, function, where), where, call.runtime)
            parameters.append(found)
            limits += [found.name] if is_limit else []
    adapter, unchecked = _adapters(
        name, where, function, names, states, [known.name for known in parameters], len(memory), call
    )
    return Part(
        name, where, function, adapter, unchecked, frozenset(names), tuple(parameters), tuple(limits), states, memory
    )  # fmt: skip


def _initial_memory(argument: inspect.Parameter, where: str) -> tuple[float, ...]:
    begin = argument.default
    numbers = isinstance(begin, tuple) and all(isinstance(x, (int, float)) and math.isfinite(x) for x in begin)
    if not numbers or not begin:
        found = "no default" if begin is argument.empty else shortened(begin)
        raise PartError(f"{where}: memory must have a tuple of numbers as default, which it begins with, got {found}")
    return tuple(map(float, begin))


def _hint_of(argument: inspect.Parameter, function: Function, where: str) -> Any:
    """The type that an argument is declared with; evaluated alone, for others may be imported for types only."""
    if argument.annotation is argument.empty:
        return None
    alone = types.SimpleNamespace(__annotations__={argument.name: argument.annotation})
    try:
        return get_type_hints(alone, function.__globals__, include_extras=True)[argument.name]
    except Exception as error:  # an annotation that does not evaluate can raise anything
        raise PartError(
            f"{where}: the type of its parameter {argument.name} cannot be read: {in_one_line(error)}"
        ) from error


def _parameter_of(argument: inspect.Parameter, hint: Any, where: str, runtime: bool) -> tuple[Parameter, bool]:
    known, default = Quantity(""), argument.default
    if get_origin(hint) is Annotated:
        known = next((extra for extra in get_args(hint)[1:] if isinstance(extra, Quantity)), known)
        hint = get_args(hint)[0]
    if default is argument.empty:
        raise PartError(f"{where}: its parameter {argument.name} needs a default, as in {argument.name}=1.0")
    if type(default) is int:
        raise PartError(f"{where}: its parameter {argument.name} must be a float, got {default}: write {default}.0")
    if not isinstance(default, float) or hint not in (None, float):
        raise PartError(f"{where}: its parameter {argument.name} must be a float, got {shortened(argument)}")
    high = math.inf if known.high is None and math.isinf(default) else known.high
    found = Parameter(
        argument.name, "double", float(default), known.unit, known.description or f"parameter of {where}",
        known.low, high, known.above, runtime=runtime,
    )  # fmt: skip
    try:
        found.check("", found.default)
    except ParameterError as error:
        raise PartError(f"{where}: the default of its parameter {error}") from None
    return found, known.limit or math.isinf(default)


_WHERE: dict[types.CodeType, str] = {}
"""What a part is called in messages, by the code of its adapter."""


def _adapters(
    name: str, where: str, function: Function, arguments: Sequence[str], states: Sequence[str],
    parameters: Sequence[str], memory: int, call: Call,
) -> tuple[Function, Function]:  # fmt: skip
    """The function that the loop calls, and the same whose result is left as it is.

    The part gets its arguments by name, its states and parameters out of tuples. Not closures, which could not be
    compiled and kept: what they call is a global of their own. Numbers are made floats, for a compiler must know that
    they are.
    """
    values = {state: f"states[{i}]" for i, state in enumerate(states)}
    values |= {parameter: f"parameters[{i}]" for i, parameter in enumerate(parameters)}
    called = f"part({', '.join(values.get(argument, argument) for argument in arguments)})"
    kept, remembered = [f"s{i}" for i in range(len(states))], [f"m{i}" for i in range(memory)]
    pattern = ", ".join([call.result, *kept, *([f"({', '.join(remembered)},)"] if memory else [])])
    results = [*re.findall(r"\w+", call.result), *kept]
    of_states = f"({''.join(f'float({s}), ' for s in kept)})"
    of_memory = f"({''.join(f'float({m}), ' for m in remembered)})" if memory else "memory"
    nan = " or ".join(f"math.isnan({result})" for result in results)
    size = " + ".join(f"abs({argument})" for argument in call.in_range)
    title = re.sub(r"\W", "_", where.partition(" (")[0])
    text = (
        f"def {title}({call.arguments}):\n"
        f"    {pattern} = {called}\n"
        f"    if ({nan}) and {size} < {IN_RANGE!r}:\n"
        f"        raise NotANumberError\n"
        f"    return {call.returned.format(states=of_states, memory=of_memory)}\n\n\n"
        f"def unchecked({call.arguments}):\n"
        f"    return {called}\n"
    )
    known: dict[str, Any] = {"part": function, "math": math, "NotANumberError": NotANumberError, **call.known}
    exec(compile(text, f"<adapter of {where}>", "exec"), known)
    adapter, unchecked = known[title], known["unchecked"]
    adapter.__doc__ = text  # what tells it apart from adapters of other signatures
    _WHERE[adapter.__code__] = where
    return adapter, unchecked


# -- parts that are wrong ----------------------------------------------------------------------------------------------


def try_part(part: Part, call: Call, *arguments: Any) -> None:
    """Call a part as the loop does. Raises PartError if it raises, or returns anything but finite numbers."""
    try:
        found = part.unchecked(*arguments)
    except Exception as error:  # another package's code, in which anything can go wrong
        raise PartError(f"{part.where} {complaint(error)}") from error
    words = [call.words, *part.states, *([f"its memory, {len(part.memory)} of them"] if part.memory else [])]
    if _shape(found) != _expected_shape(part, call):
        raise PartError(f"{part.where} must return numbers, a tuple of {', '.join(words)}; got {shortened(found)}")
    if not all(math.isfinite(x) for x in _flat(found)):
        named = dict(zip(call.arguments.split(", "), arguments, strict=True))
        given = ", ".join(f"{name} = {shortened(named[name])}" for name in call.required)
        raise PartError(f"{part.where} must return finite numbers, got {shortened(found)} for {given}")


def _shape(found: Any) -> Any:
    """Tuples in tuples as they are, with None for each number, and the type of what is not a number."""
    if isinstance(found, tuple):
        return tuple(map(_shape, found))
    return None if isinstance(found, Real) else type(found)


def _expected_shape(part: Part, call: Call) -> Any:
    memory = [(None,) * len(part.memory)] if part.memory else []
    return (*call.shape, *(None for _ in part.states), *memory)


def _flat(found: Any) -> Any:
    if isinstance(found, tuple):
        for inner in found:
            yield from _flat(inner)
    else:
        yield found


def complaint(error: BaseException) -> str:
    """What a part did, as the end of a sentence that begins with its name."""
    return str(error) if isinstance(error, NotANumberError) else f"raises {in_one_line(error)}"


def culprit(error: BaseException) -> str:
    """The part out of whose adapter an error came, empty if it came from elsewhere."""
    frame, found = error.__traceback__, ""
    while frame is not None:
        found = _WHERE.get(frame.tb_frame.f_code, found)
        frame = frame.tb_next
    return found


def in_one_line(error: BaseException) -> str:
    """An error in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def shortened(value: object) -> str:
    """A value for a message."""
    text = str(value) if isinstance(value, inspect.Parameter) else repr(value)
    return text if len(text) <= _LONGEST_VALUE else text[:_LONGEST_VALUE] + " ..."
