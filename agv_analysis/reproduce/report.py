"""The results as tables: on the terminal, as Markdown, as JSON."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agv_analysis.output_file import JSON_MARK, MARKDOWN_MARK, not_linked_out
from agv_analysis.report.table import print_framed
from agv_analysis.reproduce.citation import ARXIV, AUTHORS, DOI, TITLE
from agv_analysis.reproduce.claim import FAILS, HOLDS, PART, REMARK, Finding, Values
from agv_analysis.version import version
from agv_ros.errors import UserError

_ROUNDING = 1e-8
"""Below this a measured value differs between machines."""

DIVERGED = 1e9
"""From this size on a measured value says nothing but that the loop diverges."""

TWINS = (
    "Twins are two AGVs that begin a micrometre apart and meet the same losses; their number is their distance at the "
    "end as a multiple of that at the beginning."
)
"""What stands beside the claims, which name them."""

_COLOURS = {HOLDS: "green", REMARK: "yellow", PART: "yellow", FAILS: "red"}


@dataclass(frozen=True)
class Table:
    """A result of the future work: rows of equal names."""

    key: str
    title: str
    rows: Sequence[Values]
    named: int
    """Number of columns, from the left, that identify a row."""
    drawn: Sequence[str]
    """The columns that its figure shows."""


def text_of(value: Any) -> str:
    """A measured value for people: four digits, 0 for what is rounding, `never` for what did not happen.

    `diverges`: no finite number, or one beyond DIVERGED.
    """
    if value is None:
        return "never"
    if not isinstance(value, float):
        return str(value)
    if not abs(value) < DIVERGED:
        return "diverges"
    if abs(value) < _ROUNDING:
        return "0"
    shown = f"{value:.4g}"
    return shown if abs(value) < 1.0 else f"{float(shown):.10g}"  # no exponent for being large


def measured_text(values: Values) -> str:
    """Measured values on one line."""
    return "; ".join(f"{name}: {text_of(value)}" for name, value in values.items())


def summary(findings: Sequence[Finding]) -> str:
    """Which claims hold, in a sentence without a full stop."""
    counts = Counter(finding.judgement.verdict for finding in findings)
    return (
        f"Of {len(findings)} claims {counts[HOLDS]} hold and {counts[FAILS]} do not; {counts[REMARK]} hold with a "
        f"remark, {counts[PART]} in part"
    )


def print_claims(findings: Sequence[Finding]) -> None:
    """Print which claims hold in a frame, then each with what was measured and the verdict."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table as Grid

    grid = Grid(show_lines=True)
    for name in ("Paper", "Claim", "Measured", "Verdict"):
        grid.add_column(name)
    for finding in findings:
        judgement = finding.judgement
        remark = f"\n{escape(judgement.remark)}" if judgement.remark else ""
        verdict = f"[{_COLOURS[judgement.verdict]}]{judgement.verdict}[/]{remark}"
        cells = (finding.claim.where, finding.claim.text, measured_text(finding.measured))
        grid.add_row(*map(escape, cells), verdict)
    console = Console(highlight=False)
    print_framed(console, [("Verdict", escape(summary(findings))), ("Paper", escape(f"{TITLE} (arXiv:{ARXIV})"))])
    console.print(TWINS)
    console.print(grid)


def print_table(table: Table) -> None:
    """Print a table of the future work."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table as Grid

    grid = Grid(title=escape(table.title), title_justify="left", box=SIMPLE_HEAD)  # without borders it fits 80 columns
    for name in table.rows[0]:
        grid.add_column(escape(name), justify="right")
    for row in table.rows:
        grid.add_row(*(escape(text_of(value)) for value in row.values()))
    Console(highlight=False).print(grid)


def claims_markdown(findings: Sequence[Finding]) -> str:
    """The claims as a table in Markdown."""
    rows: list[Values] = [
        {
            "paper": finding.claim.where,
            "claim": finding.claim.text,
            "measured": measured_text(finding.measured),
            "verdict": finding.judgement.verdict,
            "remark": finding.judgement.remark,
        }
        for finding in findings
    ]
    return _markdown(rows)


def table_markdown(table: Table) -> str:
    """A table of the future work in Markdown, under its title."""
    return f"### {table.title}\n\n{_markdown(table.rows)}"


def _markdown(rows: Sequence[Values]) -> str:
    lines = [list(rows[0]), ["---"] * len(rows[0]), *([text_of(value) for value in row.values()] for row in rows)]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)


CLAIMS_FILE = "claims.json"
"""By it a directory is known as one of this command's."""


def write(findings: Sequence[Finding], tables: Sequence[Table], source: str, folder: Path) -> None:
    """Write claims.md, future.md and claims.json, which holds both, to `folder`.

    Raises UserError if that cannot be written to.
    """
    try:
        _write(folder / "claims.md", claims_markdown(findings) + MARKDOWN_MARK)
        _write(folder / "future.md", "\n".join(map(table_markdown, tables)) + MARKDOWN_MARK)
        text = json.dumps({**JSON_MARK, **to_json(findings, tables, source)}, indent=2, allow_nan=False)
        _write(folder / CLAIMS_FILE, text + "\n")
    except OSError as error:
        raise UserError(f"{folder}: cannot be written to: {error.strerror}") from None


def _write(path: Path, text: str) -> None:
    not_linked_out(path).write_text(text, encoding="utf-8")


def to_json(findings: Sequence[Finding], tables: Sequence[Table], source: str) -> dict[str, Any]:
    """The results by name; null: it did not happen, or the number is infinite."""
    claims = [
        {
            "key": finding.claim.key,
            "where": finding.claim.where,
            "claim": finding.claim.text,
            "measured": _finite(finding.measured),
            "verdict": finding.judgement.verdict,
            "remark": finding.judgement.remark,
        }
        for finding in findings
    ]
    return {
        "version": version(),
        "paper": {"authors": AUTHORS, "title": TITLE, "arxiv": ARXIV, "doi": DOI},
        "source": source,
        "claims": claims,
        "future_work": {table.key: [_finite(row) for row in table.rows] for table in tables},
    }


def _finite(values: Values) -> Values:
    """JSON has no infinity."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value for name, value in values.items()
    }
