"""A sweep on disk: what it is in sweep.json, each part that is done in a file of its own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from agv_analysis.output_file import not_linked_out
from agv_analysis.simulation import STATISTICS
from agv_analysis.simulation.batch import Table
from agv_analysis.sweep.plan import Part, Sweep, SweepError
from agv_analysis.version import version
from agv_ros.json_text import parse_json


class Store:
    """A directory that keeps the parts of one sweep."""

    def __init__(self, folder: Path, sweep: Sweep, resume: bool) -> None:
        """Begin a sweep in a directory that is not there yet, or go on with it.

        Raises SweepError if the directory cannot be made, holds another sweep, or holds one without `resume`.
        """
        self._parts = folder / "parts"
        about = folder / "sweep.json"
        if not resume:
            _make(folder, self._parts, about, describe(sweep))
        elif not about.exists():
            raise SweepError(f"{folder}: no sweep to go on with, {about.name} is not there: leave out --resume")
        else:
            _compare(about, describe(sweep))

    def save(self, part: Part, table: Table) -> None:
        """Keep a part; it is there as a whole or not at all."""
        path = self._path(part)
        unfinished = path.with_suffix(".tmp")
        with open(not_linked_out(unfinished), "wb") as file:
            np.save(file, table)
        unfinished.replace(path)

    def load(self, part: Part) -> Table | None:
        """A part that was kept; None if it was not. Raises SweepError if its file is damaged."""
        path = self._path(part)
        if not path.exists():
            return None
        try:
            table: Table = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise SweepError(
                f"{path}: cannot be read ({error}): delete it, and --resume runs this part again"
            ) from None
        if table.dtype != STATISTICS or table.shape != _shape(part):
            raise SweepError(f"{path}: does not belong to this sweep: delete it, and --resume runs this part again")
        return table

    def _path(self, part: Part) -> Path:
        return self._parts / f"{part.number:06d}.npy"


def _shape(part: Part) -> tuple[int, int]:
    return part.points[1] - part.points[0], part.seeds[1] - part.seeds[0]


def describe(sweep: Sweep) -> dict[str, Any]:
    """All that the numbers of a sweep depend on."""
    return {
        "version": version(),
        "params": sweep.base.to_yaml(of_all_parts=True),
        "vary": {axis.name: list(axis.values) for axis in sweep.axes},
        "first_seed": sweep.base.relay.seed,
        "seeds": sweep.seed_count,
    }


def _make(folder: Path, parts: Path, about: Path, description: dict[str, Any]) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise SweepError(f"{folder}: is not empty: name another directory, or go on with its sweep by --resume")
        parts.mkdir()
        not_linked_out(about).write_text(json.dumps(description, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise SweepError(f"{folder}: cannot be written to: {error.strerror}") from None


def _compare(about: Path, description: dict[str, Any]) -> None:
    """Raise SweepError if the sweep that is on disk is another one."""
    try:
        found = parse_json(about.read_bytes())
        if not isinstance(found, dict):
            raise ValueError("it holds no object")  # as what is not JSON
    except (OSError, ValueError) as error:
        raise SweepError(f"{about}: cannot be read: {error}") from None
    wanted = json.loads(json.dumps(description))
    for name, value in wanted.items():
        if found.get(name) != value:
            raise SweepError(
                f"{about}: holds another sweep, its {name} is {_short(found.get(name))}, not {_short(value)}: "
                "name another directory for this one"
            )


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
