"""Run the tutorials: every block of code of each page, in order, beside the files of a fresh clone.

A block `console` holds commands of `agv-ncs`, a block `python` continues the page's session of Python. A block `text`
behind one is what it printed, where `...` stands for lines that are left out. A picture `../images/tutorial_NAME.png`
is the file NAME.png that the page wrote.

`make docs` puts what was printed and drawn into the pages; a test compares.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

REPOSITORY = Path(__file__).parents[1]
PAGES = sorted((REPOSITORY / "docs/tutorials").glob("*.md"))
BLOCK = re.compile(r"^```(console|python)\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?", re.MULTILINE | re.DOTALL)
PICTURE = re.compile(r"\.\./images/tutorial_(\w+)\.png")
WIDTH = 100
"""Columns of the terminal that the pages show."""

Command = Callable[[list[str]], tuple[int, str]]
"""Runs `agv-ncs` with these arguments: exit status and output."""


class Block(NamedTuple):
    """A block of code, and the text that the page shows behind it; None if it shows none."""

    language: str
    code: str
    shown: str | None


def blocks(page: str) -> list[Block]:
    """The blocks of code of a page, in order."""
    return [Block(*found.groups()) for found in BLOCK.finditer(page)]


def fresh_files(folder: Path) -> None:
    """Copy to `folder` what the tutorials use of a clone."""
    for name in ("config", "bags/sample", "examples"):
        shutil.copytree(REPOSITORY / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "*.png"))


def run(page: str, command: Command) -> Iterator[tuple[Block, str]]:
    """Run the blocks of a page in the working directory; gives each with what it printed.

    Raises RuntimeError where a command fails, and what Python raises.
    """
    session: dict[str, Any] = {"__name__": "tutorial"}
    for block in blocks(page):
        yield block, _commands(block.code, command) if block.language == "console" else _python(block.code, session)


def _commands(code: str, command: Command) -> str:
    printed = []
    for line in code.replace("\\\n", " ").splitlines():
        program, *words = shlex.split(line, comments=True)
        if program != "agv-ncs":
            raise RuntimeError(f"{line}: tutorials run agv-ncs alone")
        status, said = command(words)
        if status != 0:
            raise RuntimeError(f"{line}: exit status {status}\n{said}")
        printed.append(said)
    return "\n".join(printed)


def _python(code: str, session: dict[str, Any]) -> str:
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(code, "tutorial", "exec"), session)
    return printed.getvalue()


def is_shown(shown: str, printed: str) -> bool:
    """Is `shown` what was printed, but for lines left out at `...` and spaces at the ends of lines?"""
    lines = [re.escape(line) if line != "..." else r"(?s:.*?)" for line in _lines(shown)]
    return re.fullmatch("\n".join(lines), "\n".join(_lines(printed))) is not None


def _lines(text: str) -> list[str]:
    return [line.rstrip() for line in text.strip("\n").splitlines()]


def with_printed(page: str, printed: list[str]) -> str:
    """The page with what its blocks print now; a block that leaves out lines is kept where it is still true.

    Raises ValueError where it is not: which lines are of interest cannot be guessed.
    """
    said = iter(printed)

    def anew(found: re.Match[str]) -> str:
        now, shown = next(said), found[3]
        if shown is None or is_shown(shown, now):
            return found[0]
        if "\n...\n" in f"\n{shown}":
            raise ValueError(f"choose anew which lines to show:\n{shown}\nof:\n{now}")
        return found[0].replace(f"```text\n{shown}```", "```text\n" + "\n".join(_lines(now)) + "\n```")

    return BLOCK.sub(anew, page)


def update(path: Path, command: Command) -> None:
    """Run a page, and write what it printed and drew."""
    page = path.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder, _inside(folder):
        fresh_files(Path(folder))
        printed = [said for _, said in run(page, command)]
        for name in PICTURE.findall(page):
            shutil.copy(f"{name}.png", REPOSITORY / f"docs/images/tutorial_{name}.png")
    path.write_text(with_printed(page, printed), encoding="utf-8")


@contextlib.contextmanager
def _inside(folder: str) -> Iterator[None]:
    """`folder` as the working directory."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def in_a_process(words: list[str]) -> tuple[int, str]:
    """`agv-ncs` as a user runs it."""
    program = [sys.executable, "-m", "agv_analysis.cli", *words]
    environment = {**os.environ, "COLUMNS": str(WIDTH)}
    done = subprocess.run(
        program, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    return done.returncode, done.stdout


def main() -> None:
    """Bring all tutorials up to date."""
    for path in PAGES:
        update(path, in_a_process)


if __name__ == "__main__":
    main()
