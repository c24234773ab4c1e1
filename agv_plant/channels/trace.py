"""A channel that was measured: the outcomes of a CSV or JSON file, slot by slot."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from agv_ros.errors import UserError, open_text
from agv_ros.json_text import parse_json

ENDS = ("repeat", "hold", "stop")
"""What follows the last outcome: the first one again, deliveries forever, or an error."""

_WORDS = {
    "lost": {"0": False, "1": True},
    "verdict": {"delivered": False, "lost": True},
}
"""The columns that can hold outcomes, each with its words; True where lost."""


class TraceError(UserError):
    """A trace that cannot be used; the text names file, line and reason."""


def trace(k: int, outcomes: Sequence[bool], end: str) -> bool:
    """Outcome `k` of those measured, which are one at least; `end` is one of ENDS.

    Loss rate and outages are the trace's own. Raises TraceError for a slot behind the end of a trace that may not be
    outrun.
    """
    if k < len(outcomes):
        return outcomes[k]
    if end == "stop":
        raise TraceError(
            f"the trace ends after {len(outcomes)} slots, and slot {k} is asked for: make the run shorter, or set "
            "trace_end to repeat or hold"
        )
    return end == "repeat" and outcomes[k % len(outcomes)]


def parse_trace(lines: Iterable[str], name: str) -> tuple[bool, ...]:
    """Outcomes from the lines of a CSV file called `name` in messages, True where lost.

    The first line names the columns: `lost` (0 or 1) or `verdict` (delivered or lost), and, if the file says so
    itself, `k`, which must count 0, 1, 2 and so on. Further columns are passed over. Raises TraceError naming the line.
    """
    reader = csv.reader(lines)
    try:
        header = [cell.strip() for cell in next(reader, [])]
        named = [column for column in _WORDS if column in header]
        if len(named) != 1:
            raise TraceError(f"{name}:1: one column must be called lost or verdict, found {','.join(header)!r}")
        outcomes: list[bool] = []
        empty = 0
        for row in reader:
            if not any(map(str.strip, row)):
                empty = empty or reader.line_num
                continue
            if empty:  # unless nothing follows
                raise TraceError(f"{name}:{empty}: the row is empty, so what became of its slot is not known")
            cells = dict(zip(header, map(str.strip, row), strict=False))
            outcomes.append(_outcome(cells, named[0], len(outcomes), f"{name}:{reader.line_num}"))
    except csv.Error as error:
        raise TraceError(f"{name}:{reader.line_num}: {error}") from None
    if not outcomes:
        raise TraceError(f"{name}: no rows below the header")
    return tuple(outcomes)


def _outcome(cells: dict[str, str], column: str, k: int, where: str) -> bool:
    if cells.get("k", str(k)) != str(k):
        raise TraceError(f"{where}: k must count 0, 1, 2 ..., expected {k}, found {cells['k']!r}")
    words, found = _WORDS[column], cells.get(column, "")
    if found not in words:
        raise TraceError(f"{where}: {column} must be {' or '.join(words)}, found {found!r}")
    return words[found]


def parse_json_trace(text: str, name: str) -> tuple[bool, ...]:
    """Outcomes from the text of a JSON file called `name` in messages, True where lost.

    An object with one list called `lost` (of 0 or 1) or `verdict` (of "delivered" or "lost"), an element a slot. Other
    members are passed over. Raises TraceError naming the line of broken JSON, or the element.
    """
    try:
        content = parse_json(text)
    except json.JSONDecodeError as error:
        raise TraceError(f"{name}:{error.lineno}: {error.msg}") from None
    named = [column for column in _WORDS if column in content] if isinstance(content, dict) else []
    if len(named) != 1 or not isinstance(content[named[0]], list):
        raise TraceError(f"{name}: must be an object with one list called lost or verdict")
    column = named[0]
    cells = [str(int(value)) if isinstance(value, bool) else str(value) for value in content[column]]
    if not cells:
        raise TraceError(f"{name}: the list {column} is empty")
    return tuple(_outcome({column: cell}, column, k, f"{name}: {column}[{k}]") for k, cell in enumerate(cells))


def load_trace(path: str) -> tuple[bool, ...]:
    """Outcomes from a file whose name ends in .json, as `parse_json_trace`, or from any other, as `parse_trace`.

    Raises TraceError, for a recording too: it has to be turned into a trace first.
    """
    if path.endswith(".mcap") or (Path(path) / "metadata.yaml").exists():
        raise TraceError(f"{path}: is a recording; make a trace of it with agv-ncs replay {path} --outages FILE")
    if path.endswith(".json"):
        with open_text(path, TraceError, encoding="utf-8-sig") as file:
            return parse_json_trace(file.read(), path)
    with open_text(path, TraceError, encoding="utf-8-sig", newline="") as file:
        return parse_trace(file, path)
