"""One page for the browser: the paper's figures, each beside the claims that it is about, then the future work."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from agv_analysis.report.page import template, write_page
from agv_analysis.reproduce.citation import ARXIV, AUTHORS, DOI, TITLE
from agv_analysis.reproduce.claim import FAILS, HOLDS, PART, REMARK, Finding
from agv_analysis.reproduce.figures import Figure
from agv_analysis.reproduce.report import TWINS, Table, measured_text, summary, text_of

PAGE = "claims.html"

CLASSES = {HOLDS: "asymptotic", REMARK: "bounded", PART: "bounded", FAILS: "unstable"}
"""Colour of a verdict, by the names that the pages have for the loop's."""

SHOWN_IN = {
    "Fig. 2a": ("lap",),
    "Fig. 3a": ("start", "oscillation"),
    "Fig. 3b": ("time_constant", "faster_with_gain", "faster_with_any_gain", "faster_unlimited", "impact"),
    "Fig. 3c": ("required_speed_at_start", "required_speed", "more_oscillation", "oscillation_is_slower", "optimum"),
    "Fig. 3e": ("limited_impact", "similar", "slowest"),
    "Fig. 3f": ("over_damped", "under_damped", "critical", "only_critical", "optimum_of_three", "optimum_limited"),
}
"""Claims by the figure of the paper that shows what they are about; of those in no figure the page has a table."""


class Picture(NamedTuple):
    """A picture in the page, and what stands beside it."""

    source: str
    """Its bytes, as an address."""
    caption: str
    rows: list[tuple[Finding, str, str]]
    """Claims with what was measured, in words, and the class of the verdict's colour."""


def write(findings: Sequence[Finding], drawn: Sequence[Figure], tables: Sequence[Table], folder: Path) -> None:
    """Write the page to `folder`, where the pictures are. Raises UserError if that is not possible."""
    by_key = {finding.claim.key: finding for finding in findings}
    pictures = [
        Picture(_source(folder / f"{one.file_name}.png"), one.where, _rows([by_key[key] for key in _claims_of(one)]))
        for one in drawn
    ]
    shown = {key for keys in SHOWN_IN.values() for key in keys}
    text = template("claims.html.j2").render(
        title=f"The paper's claims: {TITLE}",
        heading=summary(findings),
        authors=AUTHORS, paper=TITLE, arxiv=ARXIV, doi=DOI, twins=TWINS, pictures=pictures,
        others=_rows([finding for finding in findings if finding.claim.key not in shown]),
        tables=[(one.title, list(one.rows[0]), _cells(one), _source(folder / f"{one.key}.png")) for one in tables],
    )  # fmt: skip
    write_page(text, folder / PAGE)


def _claims_of(figure: Figure) -> tuple[str, ...]:
    return SHOWN_IN.get(figure.where.partition(":")[0], ())


def _rows(findings: Sequence[Finding]) -> list[tuple[Finding, str, str]]:
    return [(one, measured_text(one.measured), CLASSES[one.judgement.verdict]) for one in findings]


def _cells(table: Table) -> list[list[str]]:
    return [[text_of(value) for value in row.values()] for row in table.rows]


def _source(picture: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(picture.read_bytes()).decode()
