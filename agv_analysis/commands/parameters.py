"""`agv-ncs parameters`: what can be set."""

from __future__ import annotations

import math
from typing import Any

import click


@click.command("parameters", short_help="List all parameters as a table in Markdown.")
def command() -> None:
    """List every parameter with its unit, default, allowed values and meaning, as a table in Markdown."""
    click.echo(markdown(), nl=False)


def markdown() -> str:
    """The parameters of all nodes as tables in Markdown, one for each node and for each part that it may choose."""
    from agv_analysis.runtime.node_help import NODE_SCHEMAS
    from agv_analysis.scenario import PART_CHOICES
    from agv_ros.parameters import SHARED, parameters_of

    shared = [parameters_of(NODE_SCHEMAS["plant"])[name] for name in SHARED]
    text = _table("All nodes", shared)
    for node, schema in NODE_SCHEMAS.items():
        known, tables = parameters_of(schema), {}
        if node in PART_CHOICES:
            choice = PART_CHOICES[node]
            tables = {part.where: choice.names(part.name) for part in choice.registry.usable().values()}
        others = {*SHARED, *(name for names in tables.values() for name in names)}
        text += "\n" + _table(f"`{node}`", [found for found in known.values() if found.name not in others])
        for where, names in tables.items():
            found = [known[name] for name in names if name in known]
            if found:
                text += "\n" + _table(f"`{node}`, {where}", found)
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
