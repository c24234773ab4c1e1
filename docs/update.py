"""Bring README.md and docs/ up to date with what the code does: `make docs`. A test fails where they are not."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
DEMO = "<!-- demo:begin -->\n", "<!-- demo:end -->"
RANKING = "<!-- ranking:begin -->\n", "<!-- ranking:end -->"


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
    command("reproduce", "--out", out)
    return (
        "# The paper's claims\n\nMade by `agv-ncs reproduce`, which also draws the paper's figures. Every value is "
        "measured when the command runs, on the scenario of `config/paper.yaml` with the settings that the claim "
        "names; with `--ros` on recorded runs of the nodes. What no single run shows (twins, a pose that is always n "
        "steps old, scans of a gain) is simulated either way. The paper's text gives neither its track nor K_y and "
        "K_theta: the scenario is a choice.\n\nThe error is `y_r - y_c`, settled when it stays below 1 cm. Twins are "
        "two AGVs that begin a micrometre apart and meet the same losses; their number is their distance at the end as "
        "a multiple of that at the beginning.\n\n" + (Path(out) / "claims.md").read_text(encoding="utf-8")
    )


def policies_page() -> str:
    """docs/policies.md with its ranking made anew."""
    from agv_analysis.reproduce.future import policy_tables
    from agv_analysis.reproduce.report import table_markdown

    text = (REPOSITORY / "docs/policies.md").read_text(encoding="utf-8")
    return between(*RANKING, "\n".join(map(table_markdown, policy_tables())), text)


def between(begin: str, end: str, block: str, text: str) -> str:
    """`text` with another block between two marks."""
    pattern = f"{re.escape(begin)}.*?(?={re.escape(end)})"
    return re.sub(pattern, lambda _: begin + block, text, flags=re.DOTALL)


def demo_block(analysed: str) -> str:
    """The part of README.md that shows what the demo prints, from what `analyse` printed; paths are the demo's."""
    table = "\n".join(line.rstrip() for line in re.split(r"\nbag: ", analysed)[0].splitlines())
    return f"```\n{table}\nbag:     bags/demo\npicture: bags/demo/overview.png\nreport:  bags/demo/report.html\n```\n"


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
    (REPOSITORY / "docs/parameters.md").write_text(parameters_page(), encoding="utf-8")
    (REPOSITORY / "README.md").write_text(readme_with(demo_block(analysed)), encoding="utf-8")


if __name__ == "__main__":
    main()
