"""YAML as ROS 2 reads it.

A params file is read by ROS nodes and by programs without ROS, and all must see the same values in it. ROS's reader
(rcl_yaml_param_parser) is not quite YAML 1.1, which PyYAML speaks: to it 1e3 and inf are doubles and y is true; 1_000,
1:30, null and 2024-01-01 are strings; aliases are refused. So PyYAML only parses here, the meaning of a word is ours.
"""

from __future__ import annotations

import math
import re
from typing import Any

import yaml

from agv_ros.errors import UserError

_TRUE = frozenset(("y", "Y", "yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON"))
_FALSE = frozenset(("n", "N", "no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF"))
_INTEGER = re.compile(r"[-+]?(0x[0-9a-f]+|0[0-7]*|[1-9][0-9]*)", re.IGNORECASE)
_DOUBLE = re.compile(r"[-+]?(([0-9]+\.?[0-9]*|\.[0-9]+)(e[-+]?[0-9]+)?|\.?inf|infinity|\.?nan)", re.IGNORECASE)

_LONGEST_INTEGER = 24
"""Characters; no longer one fits into 64 bits."""


class RosYamlError(UserError):
    """A text that ROS does not accept as YAML; says why and where."""


def load(text: str) -> Any:
    """Mappings, lists and scalars of a YAML document as ROS understands them; None if it is empty.

    Raises RosYamlError.
    """
    try:
        node = yaml.compose(text, Loader=_Loader)
    except (yaml.YAMLError, ValueError) as error:
        raise RosYamlError(f"is not YAML: {' '.join(str(error).split())}") from None
    except RecursionError:
        raise RosYamlError("is nested too deeply") from None
    return None if node is None else _tree(node)


def scalar(text: str) -> bool | int | float | str:
    """What an unquoted word means to ROS: a bool, a 64-bit integer, a double or a string."""
    if text in _TRUE or text in _FALSE:
        return text in _TRUE
    if len(text) <= _LONGEST_INTEGER and _INTEGER.fullmatch(text):
        value = _integer(text.lower())
        return value if -(2**63) <= value < 2**63 else float(value)
    if _DOUBLE.fullmatch(text):
        number = float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
        return text if math.isinf(number) and "n" not in text.lower() else number
    return text


def _integer(text: str) -> int:
    """Value of a C integer literal: 0x hexadecimal, 0 octal."""
    digits = text.lstrip("+-")
    return int(text, 16 if digits.startswith("0x") else 8 if digits.startswith("0") else 10)


def dump(tree: Any) -> str:
    """YAML of mappings, lists and scalars that ROS, `load` and any other reader understand alike."""
    return yaml.dump(tree, Dumper=_Dumper, sort_keys=False)


class _Loader(yaml.SafeLoader):
    """Refuses aliases, as ROS does; besides, a few of them can stand for more values than there is memory."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.composer.ComposerError(None, None, "ROS reads no aliases (*name)", mark)
        return super().compose_node(parent, index)


def _tree(node: yaml.Node) -> Any:
    if isinstance(node, yaml.SequenceNode):
        return [_tree(item) for item in node.value]
    if isinstance(node, yaml.MappingNode):
        tree: dict[str, Any] = {}
        for key, value in node.value:
            where = f"line {key.start_mark.line + 1}"
            if not isinstance(key, yaml.ScalarNode):
                raise RosYamlError(f"{where}: a name must be a single word")
            if key.value in tree:
                raise RosYamlError(f"{where}: {key.value!r} is there a second time")
            tree[key.value] = _tree(value)
        return tree
    is_quoted = isinstance(node, yaml.ScalarNode) and node.style in ("'", '"')
    return node.value if is_quoted else scalar(node.value) if node.value else None


class _Dumper(yaml.SafeDumper):
    """Quotes, beside what is not a string to YAML, what is none to ROS."""


def _represent_string(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    style = None if isinstance(scalar(text), str) else "'"
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Dumper.add_representer(str, _represent_string)
