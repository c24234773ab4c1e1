"""Parameters of a node: declared from their schema, with ranges and descriptions, and read."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterUninitializedException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from agv_ros.parameters import LoopParameters, Parameter, ParameterError, as_dict, build, parameters_of

P = TypeVar("P", bound=LoopParameters)


def declare(node: Node, schema: type[P]) -> P:
    """Declare a schema's parameters and read their values. Raises ParameterError."""
    values = {}
    for name, parameter in parameters_of(schema).items():
        default = list(parameter.default) if parameter.kind.endswith("_array") else parameter.default
        try:
            values[name] = node.declare_parameter(name, default, _descriptor(parameter)).value
        except InvalidParameterTypeException as error:
            found: Any = getattr(error, "parameter", None)
            value = found.value if isinstance(found, RosParameter) else _override(node, name)
            parameter.check(node.get_name(), value)
            raise ParameterError(f"{node.get_name()}.{name} is a {parameter.kind}: {error}") from None
        except (InvalidParameterValueException, ParameterUninitializedException):
            parameter.check(node.get_name(), _override(node, name))
            raise ParameterError(f"{node.get_name()}.{name} must be {parameter.allowed}") from None
    return build(schema, {name: _plain(value) for name, value in values.items()}, node.get_name())


def _override(node: Node, name: str) -> Any:
    """The value that was asked for from outside (rclpy has no public name for it)."""
    override = node._parameter_overrides.get(name)
    return None if override is None else override.value


def _plain(value: Any) -> Any:
    """Array parameters arrive as array.array."""
    return tuple(value) if hasattr(value, "tolist") or isinstance(value, list) else value


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    unit = f" [{parameter.unit}]" if parameter.unit else ""
    descriptor = ParameterDescriptor(
        description=parameter.description + unit,
        additional_constraints=f"must be {parameter.allowed}" if parameter.kind != "bool" else "",
        read_only=not parameter.runtime,
    )
    low = parameter.low if parameter.low is not None else parameter.above
    if low is not None and parameter.high is not None:
        if parameter.kind == "integer":
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(parameter.high), step=0)]
        elif parameter.kind == "double" and not math.isinf(low):
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=parameter.high, step=0.0)]
    return descriptor


def overrides(settings: object) -> list[RosParameter[Any]]:
    """rclpy parameter overrides that give a node exactly these settings."""
    assert dataclasses.is_dataclass(settings)
    return [
        RosParameter(name, value=list(value) if isinstance(value, tuple) else value)
        for name, value in as_dict(settings).items()
    ]
