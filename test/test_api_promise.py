"""What is public is what docs/public_api.json says: nothing is gone, and nothing new is not written down."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).parents[1]


def changes(before: dict[str, dict[str, str]], now: dict[str, dict[str, str]]) -> list[str]:
    """What of a description is gone, has changed or is new, a line each."""
    found = []
    for kind in sorted({*before, *now}):
        old, new = before.get(kind, {}), now.get(kind, {})
        both = [name for name in old if name in new]
        found += [f"{kind}: {name} is gone" for name in old if name not in new]
        found += [f"{kind}: {name} is new" for name in new if name not in old]
        found += [f"{kind}: {name} was {old[name]}, is {new[name]}" for name in both if old[name] != new[name]]
    return found


def test_the_comparison_names_each_change() -> None:
    before = {"python": {"run": "(a: int)", "Run": "class"}, "topics": {"agv/pose": "PoseStamped"}}
    now = {"python": {"run": "(a: int, b: int)", "Bag": "class"}, "topics": {"agv/pose": "PoseStamped"}}
    assert changes(before, now) == [
        "python: Run is gone", "python: Bag is new", "python: run was (a: int), is (a: int, b: int)",
    ]  # fmt: skip
    assert changes(now, now) == []


def test_what_is_public_is_what_is_written_down() -> None:
    """In a process of its own: other tests add parts to this one."""
    command = [sys.executable, "docs/public_api.py", "-"]
    said = subprocess.run(command, cwd=REPOSITORY, stdout=subprocess.PIPE, text=True, check=True).stdout
    now: dict[str, Any] = json.loads(said)
    stored: dict[str, Any] = json.loads((REPOSITORY / "docs/public_api.json").read_text(encoding="utf-8"))
    assert changes(stored, now) == [], "keep the promise of docs/api_promise.md, or write it anew: make docs"
    assert all(now.values())
