"""What is public is what docs/public_api.json says: nothing is gone, and nothing new is not written down."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

REPOSITORY = Path(__file__).parents[1]

_spec = importlib.util.spec_from_file_location("public_api", REPOSITORY / "docs/public_api.py")
assert _spec is not None
assert _spec.loader is not None
public_api = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(public_api)


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


Remove = Callable[[pytest.MonkeyPatch], None]


def _without_a_function(patch: pytest.MonkeyPatch) -> None:
    import agv_ncs

    patch.setattr(agv_ncs, "__all__", [name for name in agv_ncs.__all__ if name != "simulate"])


def _without_an_option(patch: pytest.MonkeyPatch) -> None:
    from agv_analysis.commands.run import command

    patch.setattr(command, "params", [one for one in command.params if one.name != "bag"])


def _without_a_key(patch: pytest.MonkeyPatch) -> None:
    from agv_analysis.bags.bag_summary import BagSummary

    whole = BagSummary.to_json
    patch.setattr(BagSummary, "to_json", lambda self: {k: v for k, v in whole(self).items() if k != "is_complete"})


def _without_a_parameter(patch: pytest.MonkeyPatch) -> None:
    import agv_ros.parameters as parameters

    whole = parameters.parameters_of
    patch.setattr(parameters, "parameters_of", lambda kind: {k: v for k, v in whole(kind).items() if k != "ts"})


def _without_a_topic(patch: pytest.MonkeyPatch) -> None:
    whole = Path.read_text
    patch.setattr(Path, "read_text", lambda *a, **k: whole(*a, **k).replace('"edge/slot": TimeReference,', ""))


def _without_a_group(patch: pytest.MonkeyPatch) -> None:
    import agv_plant.channels.registry as registry

    patch.setattr(registry, "GROUP", "agv_ncs.radios")


GONE: dict[str, tuple[Remove, Callable[[], Iterable[tuple[str, str]]], str]] = {
    "python": (_without_a_function, public_api._python, "simulate"),
    "commands": (_without_an_option, public_api._commands, "agv-ncs run --bag"),
    "json": (
        _without_a_key,
        lambda: public_api._json({"bag info": public_api.DOCUMENTS["bag info"]}),
        "bag info: is_complete",
    ),
    "parameters": (_without_a_parameter, public_api._parameters, "plant.ts"),
    "topics": (_without_a_topic, public_api._topics, "edge/slot"),
    "entry points": (_without_a_group, public_api._entry_points, "agv_ncs.channels"),
}


@pytest.mark.parametrize("kind", GONE)
def test_what_is_taken_away_is_seen(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the code itself, one promise of each kind."""
    remove, described, name = GONE[kind]
    stored = json.loads((REPOSITORY / "docs/public_api.json").read_text(encoding="utf-8"))[kind]
    assert name in stored
    remove(monkeypatch)
    assert f"{kind}: {name} is gone" in changes({kind: stored}, {kind: dict(described())})
