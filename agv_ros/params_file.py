"""ROS 2 parameter files without ROS: what `--params-file` means, and `--set node.parameter=value` on top.

A file has one section a node, `/**` for all of them, each with `ros__parameters`; names may be nested or dotted.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from agv_ros.errors import open_text
from agv_ros.parameters import SHARED, KnownParameters, Parameter, ParameterError, build, check_values, parameters_of
from agv_ros.ros_yaml import RosYamlError, load


def read_sections(path: str) -> dict[str, dict[str, Any]]:
    """Sections of a params file in its order: node name (without namespace; `/**` for all) -> value by dotted name.

    Raises ParameterError if the file cannot be read or is not a parameter file.
    """
    with open_text(path, ParameterError) as file:
        return parse_sections(file.read(), path)


def parse_sections(text: str, name: str) -> dict[str, dict[str, Any]]:
    """As `read_sections`, from the text of a file called `name` in messages."""
    try:
        content = load(text)
    except RosYamlError as error:
        raise ParameterError(f"{name}: {error}") from None
    if not isinstance(content, dict):
        raise ParameterError(f"{name}: no parameters in it; expected sections like 'controller: ros__parameters: ...'")
    sections: dict[str, dict[str, Any]] = {}
    origin: dict[tuple[str, str], str] = {}
    for title, body in _bodies(content, "", name):
        key = _node_of(title)
        section = sections.setdefault(key, {})
        for parameter, value in _flat(body).items():
            first = origin.setdefault((key, parameter), title)
            if first != title and section[parameter] != value:
                raise ParameterError(f"{name}: sections {first} and {title} give {key}.{parameter} two values")
            section[parameter] = value
    return sections


def _bodies(tree: Mapping[str, Any], namespace: str, name: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Sections in the order of the file: (name with namespaces, parameters). Namespaces may be levels of their own."""
    for key, section in tree.items():
        title = f"{namespace}{key}"
        if isinstance(section, dict) and "ros__parameters" not in section and section:
            yield from _bodies(section, f"{title}/", name)
            continue
        body = section.get("ros__parameters") if isinstance(section, dict) else None
        if not isinstance(body, dict):
            raise ParameterError(f"{name}: section {title!r} has no mapping 'ros__parameters' in it")
        yield title, body


def _node_of(title: str) -> str:
    """Name of the node that a section is for, without its namespace; `/**` for all."""
    node = title.rsplit("/", 1)[-1]
    return "/**" if node in ("*", "**") else node


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, dict):
            flat.update(_flat(value, f"{prefix}{name}."))
        else:
            flat[f"{prefix}{name}"] = value
    return flat


def is_ros_own(name: str) -> bool:
    """Parameters that every rclpy node has without declaring them here."""
    return name in ("use_sim_time", "start_type_description_service") or name.startswith("qos_overrides.")


def parse_setting(text: str, known: Mapping[str, KnownParameters], option: str = "--set") -> tuple[str, str, Any]:
    """(node, parameter, value) of a setting `node.parameter=value`; an integer is taken for a double where one is due.

    `option` is what the setting was given by.

    Raises ParameterError if the text has no such form, names no known parameter or gives a value that is not allowed.
    """
    target, equals, literal = text.partition("=")
    node, dot, name = target.strip().partition(".")
    if not equals or not dot:
        raise ParameterError(f"{option} {text}: expected node.parameter=value, as in controller.kx=25.0")
    if node not in known:
        raise ParameterError(f"{option} {text}: unknown node {node!r}, must be one of {', '.join(known)}")
    if name not in known[node]:
        why = known[node].refusal(name) or f"it has {', '.join(known[node])}"
        raise ParameterError(f"{option} {text}: {node} has no parameter {name!r}, {why}")
    try:
        return node, name, known[node][name].check(node, _value(literal, known[node][name]))
    except (ParameterError, RosYamlError) as error:
        raise ParameterError(f"{option} {text}: {error}") from None


def _value(literal: str, parameter: Parameter) -> Any:
    value = literal if parameter.kind == "string" else load(literal)
    if parameter.kind == "double":
        return _as_double(value)
    if parameter.kind == "double_array" and isinstance(value, list):
        return [_as_double(item) for item in value]
    return value


def _as_double(value: Any) -> Any:
    """A number as a person types it: 250 is an integer to ROS, but meant as a double."""
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


def resolve(
    schemas: Mapping[str, type], sections: Mapping[str, Mapping[str, Any]], settings: Iterable[str] = (), name: str = ""
) -> dict[str, Any]:
    """Instances of all nodes' schemas from a file's sections and settings, by node name.

    A parameter that all nodes share (ts, start_time) and that is set for one node is set for all; two different values
    are refused. Raises ParameterError, whose text begins with `name`, the file's, or with the setting.
    """
    known = {node: parameters_of(schema) for node, schema in schemas.items()}
    chosen: dict[str, dict[str, Any]] = {node: {} for node in schemas}
    for text in settings:
        node, parameter, value = parse_setting(text, known)
        chosen[node][parameter] = value
    chosen_shared = _shared(chosen)
    try:
        values = {node: _from_file(node, schema, sections) for node, schema in schemas.items()}
        _refuse_unknown_for_all(sections, known)
        shared = {**_shared(values), **chosen_shared}
        return {
            node: build(schema, {**values[node], **chosen[node], **shared}, node) for node, schema in schemas.items()
        }
    except ParameterError as error:
        raise ParameterError(f"{name}: {error}" if name else str(error)) from None


def _from_file(node: str, schema: type, sections: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """A node's values, checked. As in ROS, a later section wins, whether it is the node's or that of all nodes."""
    known = parameters_of(schema)
    merged: dict[str, Any] = {}
    for title, section in sections.items():
        if title == "/**":
            merged.update({name: value for name, value in section.items() if name in known})
        elif title == node:
            merged.update({name: value for name, value in section.items() if not is_ros_own(name)})
    return check_values(schema, merged, node)


def _refuse_unknown_for_all(
    sections: Mapping[str, Mapping[str, Any]], known: Mapping[str, Mapping[str, Parameter]]
) -> None:
    for name in sections.get("/**", {}):
        if not is_ros_own(name) and not any(name in parameters for parameters in known.values()):
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
