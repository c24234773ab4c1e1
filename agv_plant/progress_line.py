"""How far the plant is, as its log says it and its runner reads it."""

from __future__ import annotations

import re


def progress_line(k: int, steps: float) -> str:
    """What the plant logs of its progress."""
    return f"step {k} of {steps}"


def progress_of(line: str) -> int | None:
    """The step in a line of the plant's log, None if the line is not about one."""
    found = re.search(r"step (\d+) of \S+$", line)
    return int(found[1]) if found else None
