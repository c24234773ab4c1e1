"""`agv-ncs parameters`: what can be set."""

from __future__ import annotations

import math
from typing import Any

import click


@click.command("parameters")
def command() -> None:
    """List every parameter with its unit, default, allowed values and meaning, as a table in Markdown."""
    click.echo(markdown(), nl=False)


def markdown() -> str:
    """The parameters of all nodes as tables in Markdown, one for each node."""
    from agv_analysis.runtime.parameters import RecorderParameters
    from agv_analysis.scenario import SCHEMAS
    from agv_ros.parameters import SHARED, parameters_of

    schemas = {**SCHEMAS, "recorder": RecorderParameters}
    shared = [parameters_of(schemas["plant"])[name] for name in SHARED]
    text = _table("All nodes", shared)
    for node, schema in schemas.items():
        text += "\n" + _table(f"`{node}`", [p for p in parameters_of(schema).values() if p.name not in SHARED])
    return text


def _table(title: str, rows: list[Any]) -> str:
    lines = [
        f"## {title}", "", "| parameter | type | unit | default | allowed | changes at run time | meaning |",
        "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for row in rows:
        cells = (
            f"`{row.name}`", row.kind, row.unit, f"`{_yaml(row.default)}`", row.allowed, "yes" if row.runtime else "no",
            row.description,
        )  # fmt: skip
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def _yaml(value: Any) -> str:
    """A value as it stands in a params file."""
    if isinstance(value, tuple):
        return "[" + ", ".join(map(_yaml, value)) + "]"
    if value == "":
        return '""'
    return ".inf" if value == math.inf else str(value)
