"""Texts, messages and docstrings keep to the word list of docs/style.md, and pass two linters of prose."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
STYLE = REPOSITORY / "docs/style.md"
FOLDERS = ("agv_*", "docs", "config", "launch", "examples", "deployment", "fuzz", "release", "torture", "benchmarks")
KINDS = (".py", ".md", ".j2", ".yaml", ".xml")


def texts() -> list[Path]:
    """All files in which people read English; the changelog tells history, and the list names its own words."""
    found = [path for folder in FOLDERS for top in REPOSITORY.glob(folder) for path in top.rglob("*")]
    pages = [*REPOSITORY.glob("*.md"), *found, REPOSITORY / "Makefile"]
    return [path for path in pages if path.suffix in KINDS and path not in (STYLE, REPOSITORY / "CHANGELOG.md")]


def word_list() -> dict[str, str]:
    rows = re.findall(r"^\| (.+?) \| (.+?) \|$", STYLE.read_text().partition("## Word list")[2], re.MULTILINE)
    return {written: better for written, better in rows if written != "written"}


def findings(text: str) -> list[str]:
    """Phrases of the list in a text, also across the end of a line and of a comment's or string's line."""
    joined = re.sub(r"\s*\n\s*(#|f?\"|')?\s*", " ", re.sub(r"[\"']\s*\n", "\n", text))
    return [
        f"{written!r}: write {better}"
        for written, better in word_list().items()
        if re.search(rf"\b{re.escape(written)}\b", joined, re.IGNORECASE)
    ]


def test_no_text_has_a_phrase_of_the_list() -> None:
    assert len(texts()) > 300
    found = {str(path.relative_to(REPOSITORY)): findings(path.read_text()) for path in texts()}
    assert {path: said for path, said in found.items() if said} == {}


def test_the_search_finds_phrases_across_lines() -> None:
    assert len(word_list()) >= 20
    for text in ("nobody knows", "it is told\n    # of a change", 'f"it takes "\n        f"for granted"', "for\never"):
        assert findings(text), text
    assert findings("a busybody is told officially") == []


def test_the_page_has_twenty_traps() -> None:
    assert re.findall(r"^(\d+)\. \*\*", STYLE.read_text(), re.MULTILINE) == [f"{i}" for i in range(1, 21)]


@pytest.mark.parametrize("linter", ["codespell", "proselint"])
def test_the_linters_that_make_test_runs_object_to_what_is_wrong(linter: str, tmp_path: Path) -> None:
    """And `make test` runs each of them."""
    program = Path(sys.executable).parent / linter
    if not program.exists():
        pytest.skip(f"needs {linter}: pip install '.[test]'")
    assert f"$(BIN)/{linter}" in (REPOSITORY / "Makefile").read_text()
    bad = tmp_path / "bad.md"
    bad.write_text("It recieves teh pose at this point in time.\n")
    arguments = ["--config", str(REPOSITORY / ".proselintrc.json"), "check"] if linter == "proselint" else []
    said = subprocess.run(
        [str(program), *arguments, str(bad)], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert said.returncode != 0
    assert json.loads((REPOSITORY / ".proselintrc.json").read_text())["checks"]["typography"] is False
