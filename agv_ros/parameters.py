"""Typed parameters: one field says name, default, unit, meaning and bounds, for ROS and for everything without it.

A node's parameters are a frozen dataclass whose fields are made by `parameter` (or by `group`, a nested dataclass whose
names get a prefix, as in `uplink.p`). Nodes declare it to ROS, the runner and the analysis read it from a params file.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from agv_ros.errors import UserError

T = TypeVar("T")


class ParameterError(UserError):
    """A parameter that was refused; the text names it, what was found, what is allowed."""


@dataclass(frozen=True)
class Parameter:
    """What is known of one parameter, apart from its value."""

    name: str
    kind: str  # "double", "integer", "string", "bool", "double_array" or "string_array", as ROS names them
    default: Any
    unit: str
    description: str
    low: float | None = None
    high: float | None = None
    above: float | None = None
    choices: tuple[str, ...] = ()
    length: int | None = None
    runtime: bool = False
    remedy: str = ""
    """What to do where none of the choices is meant."""

    @property
    def _count(self) -> str:
        return "one or more" if self.length is None else str(self.length)

    @property
    def allowed(self) -> str:
        """What values are allowed, in words: `in [0, 1]`, `one of hold, align`."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        if self.kind == "string_array":
            return "one or more strings"
        if self.kind not in ("double", "integer"):
            return f"{self._count} finite numbers" if self.kind == "double_array" else f"a {self.kind}"
        if self.above is not None and self.high is None:
            return f"> {self.above:g} and finite"
        left = f"({self.above:g}" if self.above is not None else "(-inf" if self.low is None else f"[{self.low:g}"
        if self.high is None:
            return f"in {left}, inf)"
        return f"in {left}, {self.high:g}]"

    def check(self, owner: str, value: object) -> Any:
        """`value`, as the field's type, if it is allowed. Raises ParameterError naming `owner.name` otherwise."""
        where = f"{owner}.{self.name}" if owner else self.name
        if self.kind == "double":
            if isinstance(value, int) and not isinstance(value, bool):
                raise ParameterError(f"{where} is a double, got the integer {value}: write {value}.0")
            if not isinstance(value, float):
                raise ParameterError(f"{where} is a double, got {value!r}")
            self._check_number(where, value)
        elif self.kind == "integer":
            if not isinstance(value, int) or isinstance(value, bool):
                raise ParameterError(f"{where} is an integer, got {value!r}")
            self._check_number(where, value)
        elif self.kind == "bool":
            if not isinstance(value, bool):
                raise ParameterError(f"{where} is true or false, got {value!r}")
        elif self.kind == "string":
            if not isinstance(value, str):
                raise ParameterError(f"{where} is a string, got {value!r}")
            if self.choices and value not in self.choices:
                remedy = f": {self.remedy}" if self.remedy else ""
                raise ParameterError(f"{where} must be {self.allowed}, got {value!r}{remedy}")
        elif self.kind == "string_array":
            return self._check_strings(where, value)
        else:
            return self._check_array(where, value)
        return value

    def _check_strings(self, where: str, value: object) -> tuple[str, ...]:
        if not isinstance(value, list | tuple) or not value or not all(isinstance(item, str) for item in value):
            raise ParameterError(f"{where} is a list of {self.allowed}, got {value!r}")
        return tuple(value)

    def _check_number(self, where: str, value: float) -> None:
        fits = (
            (self.low is None or value >= self.low)
            and (self.above is None or value > self.above)
            and (value <= self.high if self.high is not None else value < math.inf)
        )
        if math.isnan(value) or not fits or value == -math.inf:
            raise ParameterError(f"{where} must be {self.allowed}, got {value!r}")

    def _check_array(self, where: str, value: object) -> tuple[float, ...]:
        if not hasattr(value, "__iter__") or isinstance(value, str):
            raise ParameterError(f"{where} is a list of {self._count} doubles, got {value!r}")
        numbers = list(value)
        for number in numbers:
            if isinstance(number, int) and not isinstance(number, bool):
                raise ParameterError(f"{where} is a list of doubles, got the integer {number}: write {number}.0")
            if not isinstance(number, float) or not math.isfinite(number):
                raise ParameterError(f"{where} must be {self.allowed}, got {numbers!r}")
        if not numbers if self.length is None else len(numbers) != self.length:
            raise ParameterError(f"{where} must be {self.allowed}, got {len(numbers)}: {numbers!r}")
        return tuple(numbers)


def parameter(
    default: T,
    description: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    choices: tuple[str, ...] | Callable[[], tuple[str, ...]] = (),
    runtime: bool = False,
    any_length: bool = False,
    remedy: str = "",
) -> T:
    """Dataclass field for one parameter.

    `low` and `high` are included, `above` is not; a double is finite unless `high` is inf. A `runtime` parameter can be
    changed while the node runs. A tuple default makes a double_array of that length, or of any but 0, or, of strings, a
    string_array; ROS has no empty ones. `remedy` says
    what to do where none of the `choices` is meant; they are a function where others may be added in a running process.
    """
    known = {
        "description": description, "unit": unit, "low": low, "high": high, "above": above, "choices": choices,
        "runtime": runtime, "any_length": any_length, "remedy": remedy,
    }  # fmt: skip
    return dataclasses.field(default=default, metadata={"parameter": known})


def group(schema: type[T]) -> T:
    """Dataclass field for a nested dataclass of parameters; its names get this field's name and a dot before them."""
    return dataclasses.field(default_factory=schema, metadata={"group": schema})


def merged(schema: Callable[[], type], refusal: Callable[[str], str] = lambda _: "") -> Any:
    """As `group`, but the names of the nested dataclass stay as they are, and `schema` gives the dataclass.

    It is called at once, so that processes that load instances of the dataclass know it, and again after
    `forget_parameters`.
    `refusal` says of the first word of a dotted name why there is no such parameter, if it knows.
    """
    schema()
    return dataclasses.field(
        default_factory=lambda: schema()(), metadata={"group": schema, "prefix": "", "refusal": refusal}
    )


def _group_of(field: dataclasses.Field[Any]) -> type:
    """The nested dataclass of a group."""
    found = field.metadata["group"]
    return found if isinstance(found, type) else found()


def _prefix(field: dataclasses.Field[Any]) -> str:
    """What stands before the names of a group's parameters."""
    return str(field.metadata.get("prefix", f"{field.name}."))


_KINDS = {bool: "bool", int: "integer", float: "double", str: "string", tuple: "double_array"}


def _kind_of(default: Any) -> str:
    """ROS' name for the type of a default."""
    if isinstance(default, tuple) and isinstance(default[0], str):
        return "string_array"
    return _KINDS[type(default)]


class KnownParameters(dict[str, Parameter]):
    """Parameters by their full (dotted) names, in the order of declaration; not to be changed."""

    refusals: tuple[Callable[[str], str], ...] = ()

    def refusal(self, name: str) -> str:
        """Why there is no parameter called `name`, empty if it is not known."""
        reasons = [refusal(name.partition(".")[0]) for refusal in self.refusals if "." in name]
        return next(filter(None, reasons), "")


def parameters_of(schema: type) -> KnownParameters:
    """The parameters of a schema by their full (dotted) names, in the order of declaration."""
    return _parameters_of(schema)


@functools.cache  # a sweep asks for each of its points
def _parameters_of(schema: type) -> KnownParameters:
    found = KnownParameters()
    for field in dataclasses.fields(schema):
        if "group" in field.metadata:
            for name, inner in parameters_of(_group_of(field)).items():
                full = _prefix(field) + name
                found[full] = dataclasses.replace(inner, name=full)
            found.refusals += (field.metadata["refusal"],) if "refusal" in field.metadata else ()
            continue
        known = dict(field.metadata["parameter"])
        free, choices = known.pop("any_length"), known.pop("choices")
        length = len(field.default) if isinstance(field.default, tuple) and not free else None
        found[field.name] = Parameter(
            name=field.name,
            kind=_kind_of(field.default),
            default=field.default,
            length=length,
            choices=choices() if callable(choices) else choices,
            **known,
        )
    return found


def forget_parameters() -> None:
    """To be called where a schema has become another one: choices and groups are asked for anew."""
    _parameters_of.cache_clear()


def check_values(schema: type, values: Mapping[str, object], owner: str = "") -> dict[str, Any]:
    """Values by dotted name, each as its field's type.

    Raises ParameterError for an unknown name, a wrong type or a value out of bounds.
    """
    known = parameters_of(schema)
    checked = {name: known[name].check(owner, value) for name, value in values.items() if name in known}
    for name in values:
        if name not in known:
            why = known.refusal(name) or f"{owner} has {', '.join(known)}"
            raise ParameterError(f"unknown parameter {owner}.{name}: {why}")
    return checked


def build(schema: type[T], values: Mapping[str, object], owner: str = "") -> T:
    """Instance of `schema` from values by dotted name; what is absent keeps its default.

    Raises ParameterError as `check_values` does, and for values that do not go together.
    """
    return _assemble(schema, check_values(schema, values, owner))


def _assemble(schema: type[T], values: Mapping[str, Any]) -> T:
    arguments: dict[str, Any] = {}
    for field in dataclasses.fields(schema):  # type: ignore[arg-type]
        if "group" in field.metadata:
            prefix = _prefix(field)
            inner = {name[len(prefix) :]: value for name, value in values.items() if name.startswith(prefix)}
            arguments[field.name] = _assemble(_group_of(field), inner)
        elif field.name in values:
            arguments[field.name] = values[field.name]
    return schema(**arguments)


def as_dict(instance: object) -> dict[str, Any]:
    """All values of a schema's instance by dotted name."""
    found: dict[str, Any] = {}
    for field in dataclasses.fields(instance):  # type: ignore[arg-type]
        value = getattr(instance, field.name)
        if "group" in field.metadata:
            found.update({_prefix(field) + name: inner for name, inner in as_dict(value).items()})
        else:
            found[field.name] = value
    return found


@dataclass(frozen=True)
class LoopParameters:
    """What every node of a loop must agree on, and how its nodes find each other."""

    ts: float = parameter(0.005, "sampling period T_s, the same on all nodes", unit="s", low=1e-6, high=10.0)
    start_time: float = parameter(
        1.0, "instant t_0 of step 0, the same on all nodes; never 0, which means 'no time' in ROS", unit="s",
        low=1e-3, high=2e9,
    )  # fmt: skip
    wait_for_subscribers: int = parameter(
        1,
        "a node listens to its inputs only once each of its outputs has this many subscribers; 1: recorders do not "
        "count, and nodes start without loss in any order, 2: with one recorder, that too, 0: it does not wait",
        low=0,
        high=100,
    )
    stop_timeout: float = parameter(
        1.2,
        "a node that is stopped waits this long, at most, for messages on their way to it or to its "
        "subscribers; a recorder on a busy machine may lag by seconds",
        unit="s",
        low=0.0,
        high=60.0,
    )
    plan_steps: int = parameter(
        0,
        "how many commands the controller sends ahead with each one, on edge/plan, the same on all nodes; 0: none",
        low=0,
        high=1000,
    )
    look_ahead: float = parameter(
        0.0,
        "how far ahead in time the reference of edge/error is, rounded to whole periods, the same on all "
        "nodes; 0: that of now; for a control law that looks ahead",
        unit="s",
        low=0.0,
        high=60.0,
    )
    stamp_window: float = parameter(
        10.0,
        "a message whose stamp is more than this after the newest one is rejected, unless ten in a row agree that the "
        "loop has leapt; the same on all nodes",
        unit="s",
        low=0.01,
        high=3600.0,
    )
    frame_prefix: str = parameter(
        "",
        "what the frames base_link and reference begin with, in messages and on /tf, as robot_state_publisher has it: "
        "agv1/ for one AGV of several; all share the frame map",
    )

    @functools.cached_property
    def window_steps(self) -> int:
        """Whole periods of `stamp_window`, one at least."""
        return max(1, round(self.stamp_window / self.ts))

    @functools.cached_property
    def steps_ahead(self) -> int:
        """Whole periods that edge/error looks ahead."""
        return round(self.look_ahead / self.ts)


SHARED = (
    "ts", "start_time", "wait_for_subscribers", "stop_timeout", "plan_steps", "look_ahead", "stamp_window",
    "frame_prefix",
)  # fmt: skip


@dataclass(frozen=True)
class TwoDomains(LoopParameters):
    """Parameters of a node between the AGV and the edge where each has a DDS domain of its own."""

    plant_domain_id: int = parameter(
        -1, "ROS_DOMAIN_ID of the AGV; -1: the one that this process was started in", low=-1, high=232
    )
    edge_domain_id: int = parameter(
        -1, "ROS_DOMAIN_ID of the edge; another than the AGV's makes the relay the only way between them; -1: the one "
        "that this process was started in",
        low=-1, high=232,
    )  # fmt: skip
