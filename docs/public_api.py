"""What the project promises to keep, from the code: `python docs/public_api.py` writes public_api.json, - prints it.

A line for each promise, so that a comparison names what has changed. docs/api_promise.md says what the promise is.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import fields, is_dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import click

REPOSITORY = Path(__file__).parents[1]
STORED = REPOSITORY / "docs/public_api.json"


def described() -> dict[str, dict[str, str]]:
    """The promises by kind: names of Python, commands, keys of JSON, parameters, topics, entry points, executables."""
    return {
        "python": dict(_python()),
        "commands": dict(_commands()),
        "json": dict(_json()),
        "parameters": dict(_parameters()),
        "topics": dict(_topics()),
        "entry points": dict(_entry_points()),
        "executables": dict(_executables()),
    }


def text() -> str:
    """docs/public_api.json."""
    return json.dumps(described(), indent=1, ensure_ascii=False) + "\n"


def signature_of(function: Any) -> str:
    """Parameters of a function with types and defaults, written alike by every version of Python."""
    written = []
    for one in inspect.signature(function).parameters.values():
        star = {one.VAR_POSITIONAL: "*", one.VAR_KEYWORD: "**"}.get(one.kind, "")
        kind = " (by keyword)" if one.kind is one.KEYWORD_ONLY else ""
        value = "a function" if inspect.isfunction(one.default) else repr(one.default)
        default = "" if one.default is one.empty else f" = {value}"
        written.append(f"{star}{one.name}: {one.annotation}{default}{kind}")
    return f"({', '.join(written)})"


def _python() -> Iterator[tuple[str, str]]:
    import agv_ncs

    for name in agv_ncs.__all__:
        value = getattr(agv_ncs, name)
        if inspect.isclass(value):
            yield name, "class"
            yield from ((f"{name}.{member}", of) for member, of in _members(value))
        elif callable(value):
            yield name, signature_of(value)
        else:
            yield name, type(value).__name__


def _members(kind: type) -> Iterator[tuple[str, str]]:
    if is_dataclass(kind):
        yield from ((one.name, f"field {one.type}") for one in fields(kind) if not one.name.startswith("_"))
    for name in getattr(kind, "_fields", ()):
        yield name, "field"
    for name, value in vars(kind).items():
        if name.startswith("_"):
            continue
        if isinstance(value, property):
            yield name, "property"
        elif isinstance(value, classmethod | staticmethod):
            yield name, signature_of(value.__func__)
        elif inspect.isfunction(value):
            yield name, signature_of(value)


def _commands(group: click.Group | None = None, above: str = "agv-ncs") -> Iterator[tuple[str, str]]:
    if group is None:
        group = importlib.import_module("agv_analysis.cli").main
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        yield f"{above} {name}", "command"
        for one in command.params:
            is_option = isinstance(one, click.Option)
            said = "/".join((*one.opts, *one.secondary_opts)) if is_option else one.human_readable_name
            choices = f" of {', '.join(map(str, one.type.choices))}" if isinstance(one.type, click.Choice) else ""
            yield (
                f"{above} {name} {said}",
                one.type.name + choices + ", may be repeated" * getattr(one, "multiple", False),
            )
        if isinstance(command, click.Group):
            yield from _commands(command, f"{above} {name}")


DOCUMENTS = {
    "stability": "stability {outages} --set plant.duration=5.0 --set error_detector.lap_time=5.0 --corridor 0.25",
    "analyse": "analyse {bag}",
    "require": "require {paper} --set error_detector.lap_time=5.0",
    "channel": "channel {outages}",
    "link": "link {bag}",
    "bag info": "bag info {bag}",
    "bag outages": "bag outages {bag} --topic /edge/pose",
    "replay --compare": "replay {bag} --compare",
}
"""Commands whose `--json` is promised, with short work; `simulate` writes what `analyse` does."""


def _json(documents: Mapping[str, str] = DOCUMENTS) -> Iterator[tuple[str, str]]:
    from agv_analysis.cli import main
    from agv_analysis.doctor.examination import examine

    where = {"outages": "config/outages.yaml", "paper": "config/paper.yaml", "bag": "bags/sample"}
    for name, words in documents.items():
        with tempfile.TemporaryDirectory() as folder, redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            file = Path(folder) / "document.json"
            command = words.format(**{key: REPOSITORY / path for key, path in where.items()}).split()
            main([*command, "--json", str(file)], standalone_mode=False)
            document = json.loads(file.read_text(encoding="utf-8"))
        yield from ((f"{name}: {key}", "key") for key in sorted(set(_keys(document))))
    yield from ((f"doctor: {key}", "key") for key in examine(0.0).to_json())


def _keys(of: Any, above: str = "") -> Iterator[str]:
    """Keys of a document, those inside of others after a dot; a list is its first item. Numbers are not names."""
    if isinstance(of, dict):
        for key, value in of.items():
            if key.isdecimal():
                continue
            yield f"{above}{key}"
            yield from _keys(value, f"{above}{key}.")
    elif isinstance(of, list) and of:
        yield from _keys(of[0], above)


def _parameters() -> Iterator[tuple[str, str]]:
    from agv_analysis.runtime.node_help import NODE_SCHEMAS
    from agv_ros.parameters import parameters_of

    for node, schema in NODE_SCHEMAS.items():
        for name, known in parameters_of(schema).items():
            yield f"{node}.{name}", f"{known.kind} [{known.unit}] {known.default!r}"


def _topics() -> Iterator[tuple[str, str]]:
    """From the source of the recorder, so that no ROS is needed."""
    tree = ast.parse((REPOSITORY / "agv_analysis/runtime/recorder_node.py").read_text(encoding="utf-8"))
    for node in tree.body:
        if isinstance(node, ast.AnnAssign) and ast.unparse(node.target) == "TOPICS":
            assert isinstance(node.value, ast.Dict)
            for key, kind in zip(node.value.keys, node.value.values, strict=True):
                assert isinstance(key, ast.Constant)
                yield str(key.value), ast.unparse(kind)


def _entry_points() -> Iterator[tuple[str, str]]:
    from agv_cloud.control.registry import CONTROL_LAWS
    from agv_cloud.staleness.registry import STALENESS_POLICIES
    from agv_plant.channels.registry import GROUP
    from agv_plant.vehicle.registry import VEHICLES

    yield GROUP, "group"
    yield from ((registry.group, "group") for registry in (CONTROL_LAWS, VEHICLES, STALENESS_POLICIES))


def _executables() -> Iterator[tuple[str, str]]:
    from agv_analysis.runtime.executables import NODE_MODULES

    yield from ((f"ros2 run agv_ncs {name}", "executable") for name in NODE_MODULES)


if __name__ == "__main__":
    if sys.argv[1:] == ["-"]:
        sys.stdout.write(text())
    else:
        STORED.write_text(text(), encoding="utf-8")
