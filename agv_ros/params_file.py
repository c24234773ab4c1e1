"""ROS 2 parameter files without ROS: what `--params-file` means, and `--set node.parameter=value` on top.

A file has one section a node, `/**` for all of them, each with `ros__parameters`; names may be nested or dotted.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import yaml

from agv_ros.parameters import SHARED, Parameter, ParameterError, build, parameters_of

_EVERY_NODE = ("/**", "**", "/*", "*")


def read_sections(path: str) -> dict[str, dict[str, Any]]:
    """Sections of a params file: node name (without namespace; `/**` for all) -> value by dotted name.

    Raises ParameterError if the file cannot be read or is no parameter file.
    """
    try:
        with open(path, encoding="utf-8") as file:
            return parse_sections(file.read(), path)
    except OSError as error:
        raise ParameterError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ParameterError(f"{path}: is not UTF-8 text: {error.reason} at byte {error.start}") from None


def parse_sections(text: str, name: str) -> dict[str, dict[str, Any]]:
    """As `read_sections`, from the text of a file called `name` in messages."""
    try:
        content = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ParameterError(f"{name}: is not YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict):
        raise ParameterError(f"{name}: no parameters in it; expected sections like 'controller: ros__parameters: ...'")
    sections: dict[str, dict[str, Any]] = {}
    for node, section in content.items():
        body = section.get("ros__parameters") if isinstance(section, dict) else None
        if not isinstance(body, dict):
            raise ParameterError(f"{name}: section {node!r} has no mapping 'ros__parameters' in it")
        key = "/**" if node in _EVERY_NODE else str(node).rsplit("/", 1)[-1]
        sections.setdefault(key, {}).update(_flat(body))
    return sections


def _flat(tree: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, dict):
            flat.update(_flat(value, f"{prefix}{name}."))
        else:
            flat[f"{prefix}{name}"] = value
    return flat


def _is_ros_own(name: str) -> bool:
    """Parameters that every rclpy node has without declaring them here."""
    return name == "use_sim_time" or name.startswith("qos_overrides.")


def parse_setting(text: str, known: Mapping[str, Mapping[str, Parameter]]) -> tuple[str, str, Any]:
    """(node, parameter, value) of a setting `node.parameter=value`; an integer is taken for a double where one is due.

    Raises ParameterError if the text has no such form or names no known parameter.
    """
    target, equals, literal = text.partition("=")
    node, dot, name = target.strip().partition(".")
    if not equals or not dot:
        raise ParameterError(f"--set {text}: expected node.parameter=value, as in controller.kx=25.0")
    if node not in known:
        raise ParameterError(f"--set {text}: unknown node {node!r}, must be one of {', '.join(known)}")
    if name not in known[node]:
        raise ParameterError(f"--set {text}: {node} has no parameter {name!r}, it has {', '.join(known[node])}")
    return node, name, _value(literal, known[node][name])


def _value(literal: str, parameter: Parameter) -> Any:
    try:
        value = literal if parameter.kind == "string" else yaml.safe_load(literal)
    except yaml.YAMLError:
        raise ParameterError(f"--set {parameter.name}={literal}: is not a YAML value") from None
    if parameter.kind == "double":
        return _as_double(value)
    if parameter.kind == "double_array" and isinstance(value, list):
        return [_as_double(item) for item in value]
    return value


def _as_double(value: Any) -> Any:
    """A double as a person types it: 250, 1e3, inf and nan are not floats to YAML 1.1, but are meant as such."""
    if isinstance(value, bool):
        return value
    try:
        return float(value)
    except (TypeError, ValueError):
        return value


def resolve(
    schemas: Mapping[str, type], sections: Mapping[str, Mapping[str, Any]], settings: Iterable[str] = (), name: str = ""
) -> dict[str, Any]:
    """Instances of all nodes' schemas from a file's sections and settings, by node name.

    A parameter that all nodes share (ts, start_time) and that is set for one node is set for all; two different values
    are refused. Raises ParameterError, whose text begins with `name`, the file's.
    """
    known = {node: parameters_of(schema) for node, schema in schemas.items()}
    try:
        values = {node: _from_file(node, sections, known) for node in schemas}
        _unknown_sections(sections, schemas)
        file_shared = _shared(values)
    except ParameterError as error:
        raise ParameterError(f"{name}: {error}" if name else str(error)) from None
    chosen: dict[str, dict[str, Any]] = {node: {} for node in schemas}
    for text in settings:
        node, parameter, value = parse_setting(text, known)
        chosen[node][parameter] = value
    shared = {**file_shared, **_shared(chosen)}
    resolved: dict[str, Any] = {}
    for node, schema in schemas.items():
        own = {**values[node], **chosen[node], **{key: item for key, item in shared.items() if key in known[node]}}
        resolved[node] = build(schema, own, node)
    return resolved


def _from_file(
    node: str, sections: Mapping[str, Mapping[str, Any]], known: Mapping[str, Mapping[str, Parameter]]
) -> dict[str, Any]:
    everywhere = {
        name: value for name, value in sections.get("/**", {}).items() if name in known[node] or _is_ros_own(name)
    }
    merged = {**everywhere, **sections.get(node, {})}
    return {name: value for name, value in merged.items() if not _is_ros_own(name)}


def _unknown_sections(sections: Mapping[str, Mapping[str, Any]], schemas: Mapping[str, type]) -> None:
    for node, section in sections.items():
        if node == "/**":
            names = {name for schema in schemas.values() for name in parameters_of(schema)}
            for name in section:
                if name not in names and not _is_ros_own(name):
                    raise ParameterError(f"section /**: no node has a parameter {name!r}")


def _shared(values: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    found: dict[str, tuple[str, Any]] = {}
    for node, parameters in values.items():
        for name in SHARED:
            if name not in parameters:
                continue
            value = parameters[name]
            first_node, first = found.setdefault(name, (node, value))
            if value != first and not (value != value and first != first):
                raise ParameterError(
                    f"{first_node}.{name} is {first!r} and {node}.{name} is {value!r}: all nodes must have the same"
                )
    return {name: value for name, (_, value) in found.items()}
