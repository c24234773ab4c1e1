"""Bring README.md and docs/ up to date with what the code does: `make docs`. A test fails where they are not."""

from __future__ import annotations

import ast
import inspect
import os
import re
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).parents[1]
DEMO = "<!-- demo:begin -->\n", "<!-- demo:end -->"
RANKING = "<!-- ranking:begin -->\n", "<!-- ranking:end -->"
NAMES = "<!-- names:begin -->\n", "<!-- names:end -->"
TYPES = "<!-- types:begin -->\n", "<!-- types:end -->"
CRITERIA_TABLE = "<!-- criteria:begin -->\n", "<!-- criteria:end -->"


def command(*arguments: str) -> str:
    """What a command of agv-ncs prints."""
    environment = {**os.environ, "COLUMNS": "110"}
    return subprocess.run(
        [sys.executable, "-m", "agv_analysis.cli", *arguments],
        cwd=REPOSITORY, env=environment, stdout=subprocess.PIPE, text=True, check=True,
    ).stdout  # fmt: skip


def parameters_page() -> str:
    """docs/parameters.md."""
    return (
        "# Parameters\n\nMade by `agv-ncs parameters` from the declarations in the code. `/**/<node>:` in a params "
        "file addresses a node in any namespace.\n\n" + command("parameters")
    )


def paper_page(out: str) -> str:
    """docs/paper.md; the paper is reproduced in the directory `out`."""
    from agv_analysis.output_file import MARKDOWN_MARK
    from agv_analysis.reproduce.citation import CITATION
    from agv_analysis.reproduce.report import TWINS

    command("reproduce", "--out", out)
    return (
        f"# The paper's claims\n\n{CITATION}.\n\n"
        "Made by `agv-ncs reproduce`, which also draws the paper's figures, and writes a page, `claims.html`, with the "
        "claims beside them. Every value is measured when the command runs, on the scenario of `config/paper.yaml` "
        "with the settings that the claim names; with `--ros` on recorded runs of the nodes. What no single run shows "
        "(twins, a pose that is always n steps old, scans of a gain) is simulated either way. The paper's text gives "
        "neither its track nor K_y and K_theta: the scenario is a choice. Sections and equations are numbered as the "
        "paper prints them.\n\nAn error has settled when less than 1 cm is left of it, a command when `v - v_r` stays "
        "within 2 % of its largest value. Steps count from k = 0. "
        + TWINS
        + "\n\n"
        + (Path(out) / "claims.md").read_text(encoding="utf-8").removesuffix(MARKDOWN_MARK)
    )


def policies_page() -> str:
    """docs/policies.md with its ranking made anew."""
    from agv_analysis.reproduce.future import policy_tables
    from agv_analysis.reproduce.report import table_markdown

    text = (REPOSITORY / "docs/policies.md").read_text(encoding="utf-8")
    return between(*RANKING, "\n".join(map(table_markdown, policy_tables())), text)


def stability_page() -> str:
    """docs/stability.md with its table of criteria made anew."""
    from agv_analysis.stability.criteria import CRITERIA

    rows = ["| key | asks | assumes |", "| --- | --- | --- |"]
    rows += [f"| `{one.key}` | {escaped(one.asks)} | {escaped(one.assumes)} |" for one in CRITERIA]
    text = (REPOSITORY / "docs/stability.md").read_text(encoding="utf-8")
    return between(*CRITERIA_TABLE, "\n".join(rows) + "\n", text)


def python_api_page() -> str:
    """docs/python_api.md with its tables made anew, from the signatures and docstrings of the code."""
    text = (REPOSITORY / "docs/python_api.md").read_text(encoding="utf-8")
    return between(*TYPES, api_types(), between(*NAMES, api_names(), text))


def api_names() -> str:
    """A table of all names of agv_ncs."""
    import agv_ncs

    rows = ["| name | what it is |", "|---|---|"]
    for name in agv_ncs._MODULES:
        value = getattr(agv_ncs, name)
        said = "version of the installed package" if name == "__version__" else first_line(value)
        arguments = f"({', '.join(inspect.signature(value).parameters)})" if inspect.isfunction(value) else ""
        rows.append(f"| `{name}{arguments}` | {escaped(said)} |")
    return "\n".join(rows) + "\n"


def first_line(value: Any) -> str:
    """The first paragraph of a docstring as one line."""
    return " ".join((inspect.getdoc(value) or "").partition("\n\n")[0].split())


def api_types() -> str:
    """A table of the fields and properties of each type of agv_ncs that holds results."""
    import agv_ncs

    types = (
        agv_ncs.Run, agv_ncs.Observations, agv_ncs.Analysis, agv_ncs.Margins, agv_ncs.Corridor, agv_ncs.Bag,
        agv_ncs.SweepResult, agv_ncs.Outcome, agv_ncs.Quantity,
    )  # fmt: skip
    return "\n".join(
        f"### {kind.__name__}\n\n{first_line(kind)}\n\n| field | type | meaning |\n|---|---|---|\n"
        + "".join(f"| `{name}` | {escaped(of)} | {escaped(meaning)} |\n" for name, of, meaning in fields_of(kind))
        for kind in types
    )


def fields_of(kind: type) -> Iterator[tuple[str, str, str]]:
    """Name, type and meaning of each public field, property and method that a class itself has, from its source."""
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(body, ast.ClassDef)
    for node, after in zip(body.body, [*body.body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            is_documented = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            meaning = str(after.value.value) if is_documented else ""  # type: ignore[union-attr]
            name, of = node.target.id, ast.unparse(node.annotation)
        elif isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            is_property = any(isinstance(one, ast.Name) and one.id == "property" for one in node.decorator_list)
            name = node.name if is_property else f"{node.name}({', '.join(a.arg for a in node.args.args[1:])})"
            of, meaning = ast.unparse(node.returns) if node.returns else "", ast.get_docstring(node) or ""
        else:
            continue
        if not name.startswith("_"):
            yield name, f"`{of}`", " ".join(meaning.partition("\n\n")[0].split())


def escaped(text: str) -> str:
    """Text for a cell of a table."""
    return text.replace("|", "\\|")


def between(begin: str, end: str, block: str, text: str) -> str:
    """`text` with another block between two marks."""
    pattern = f"{re.escape(begin)}.*?(?={re.escape(end)})"
    return re.sub(pattern, lambda _: begin + block, text, flags=re.DOTALL)


def demo_block(analysed: str) -> str:
    """The part of README.md that shows what the demo prints first and last, from what `analyse` printed.

    Paths are the demo's.
    """
    frame = "\n".join(line.rstrip() for line in re.split(r"^Link *$", analysed, flags=re.MULTILINE)[0].splitlines())
    return (
        f"```\n{frame}\n...\nbag:     bags/demo\npicture: bags/demo/overview.png\nreport:  bags/demo/report.html\n```\n"
    )


def readme_with(block: str) -> str:
    """README.md with another demo block."""
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    return between(*DEMO, block, text)


def main() -> None:
    """Run the demo's scenario and write everything anew."""
    with tempfile.TemporaryDirectory() as folder:
        bag = str(Path(folder) / "bag")
        command("run", "config/outages.yaml", "--bag", bag)
        analysed = command("analyse", bag, "--picture", "docs/images/demo.png")
    with tempfile.TemporaryDirectory() as folder:
        (REPOSITORY / "docs/paper.md").write_text(paper_page(folder), encoding="utf-8")
    (REPOSITORY / "docs/policies.md").write_text(policies_page(), encoding="utf-8")
    (REPOSITORY / "docs/stability.md").write_text(stability_page(), encoding="utf-8")
    (REPOSITORY / "docs/python_api.md").write_text(python_api_page(), encoding="utf-8")
    (REPOSITORY / "docs/parameters.md").write_text(parameters_page(), encoding="utf-8")
    for script in ("docs/public_api.py", "docs/tutorials.py"):
        subprocess.run([sys.executable, script], cwd=REPOSITORY, check=True)
    (REPOSITORY / "README.md").write_text(readme_with(demo_block(analysed)), encoding="utf-8")


if __name__ == "__main__":
    main()
