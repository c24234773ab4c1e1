"""The parameters of parts: the schemas that nodes declare, and the values that a part gets out of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import make_dataclass
from typing import Any

from agv_ros.parameters import Parameter, group, parameter
from agv_ros.parts import Part, PartError

_OF_ROS = ("use_sim_time", "start_type_description_service", "qos_overrides")
"""Parameters that a node has without declaring them."""


def refuse_taken(part: Part, taken: Sequence[str]) -> None:
    """Raise PartError for a part that is called as a parameter of its node, and so would be its group of parameters."""
    if part.parameters and part.name in (*taken, *_OF_ROS):
        raise PartError(f"{part.where}: its node has a parameter {part.name}, so none can be called so: rename it")


def schema_of(class_name: str, parts: Mapping[str, Part], taken: Sequence[str], module: dict[str, Any]) -> type:
    """A schema with a group of parameters for each part that has some: names `part.parameter`.

    Parts whose names are `taken` by parameters of the node are left out. The classes are put into the `module` given by
    its globals, where other processes find them; as long as the parts are the same ones, so is the class.
    """
    if class_name in module and module[class_name].of_parts == parts:
        return module[class_name]  # type: ignore[no-any-return]
    fields: list[tuple[str, type, Any]] = []
    for part in parts.values():
        if part.parameters and part.name not in (*taken, *_OF_ROS):
            own = _dataclass(
                f"{class_name}_{part.name}", [(p.name, float, _field_of(p)) for p in part.parameters], module
            )
            fields.append((part.name, own, group(own)))
    made = _dataclass(class_name, fields, module)
    made.of_parts = dict(parts)  # type: ignore[attr-defined]
    return made


def _dataclass(name: str, fields: list[tuple[str, type, Any]], module: dict[str, Any]) -> type:
    made = make_dataclass(name, fields, frozen=True, namespace={"__module__": module["__name__"]})
    module[name] = made
    return made


def values_of(part: Part, groups: object) -> tuple[float, ...]:
    """The values of a part's parameters in an instance of `schema_of`, in the order of its signature.

    Raises PartError for a part that was not there yet when the schema was made.
    """
    if not part.parameters:
        return ()
    own = getattr(groups, part.name, None)
    if own is None:
        raise PartError(
            f"{part.where} could not be loaded when its parameters were declared: let its module import nothing of "
            "agv_ncs but agv_ros.parts; or it was registered after its node's parameters were made: make them anew"
        )
    return tuple(getattr(own, known.name) for known in part.parameters)


def _field_of(known: Parameter) -> Any:
    return parameter(
        known.default, known.description, unit=known.unit, low=known.low, high=known.high, above=known.above,
        runtime=known.runtime,
    )  # fmt: skip


def field_of(part: Part, name: str) -> Any:
    """Dataclass field for one parameter of a part, as `parameter` makes it."""
    return _field_of(next(known for known in part.parameters if known.name == name))
