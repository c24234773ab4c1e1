"""Figures kept in a file with the machine and the version that gave them, and what has changed since, beyond noise.

Only ratios to a peer are compared: a busier or slower machine slows both. Each is measured several times. It has
changed if the ranges of the two measurements do not overlap, and if their medians differ by more than `LEAST`.
"""

from __future__ import annotations

import json
import platform
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from statistics import median
from typing import Any

import click

from agv_analysis.doctor import machine
from agv_analysis.version import version
from benchmarks.comparison import Comparison

FORMAT = 1

LEAST = 0.05
"""Smaller changes of a median are not named, whatever the ranges are."""

NAMED = ("numpy", "numba", "zstandard", "mcap", "rosbags", "ros-jazzy-rclpy")
"""Packages on which figures depend most."""

Found = Mapping[str, Sequence[Sequence[Comparison]]]
"""Of each subject its rounds, each with the same comparisons in the same order."""


def write_record(path: Path, found: Found) -> None:
    """Write the figures of all rounds with machine and versions."""
    content = {"format": FORMAT, "machine": about_machine(), "versions": _versions()} | {
        "measured": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "subjects": {subject: _rows(rounds) for subject, rounds in found.items()},
    }
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def read_record(path: Path) -> dict[str, Any]:
    """A file of `write_record`. Raises ClickException for any other."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise click.ClickException(f"{path}: cannot be read as JSON: {error}") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT or "subjects" not in content:
        raise click.ClickException(f"{path}: no figures of `make bench JSON=FILE` in format {FORMAT}; make it anew")
    return content


def changes(before: Mapping[str, Any], found: Found) -> Iterator[str]:
    """What has changed since a record, a line each, what could not be told, and at the end how much was compared."""
    here = about_machine()
    differing = [f"{key} {before['machine'].get(key)}, now {here[key]}" for key in here
                 if key != "load" and before["machine"].get(key) != here[key]]  # fmt: skip
    if differing:
        yield f"another machine: {'; '.join(differing)}. Ratios depend on it less than speeds do, but they do."
    compared = changed = 0
    for subject, rounds in found.items():
        old = {(row["what"], row["peer_name"]): row["ratios"] for row in before["subjects"].get(subject, [])}
        for row in _rows(rounds):
            now, name = row["ratios"], f"{subject}: {row['what']} against {row['peer_name']}"
            then = old.pop((row["what"], row["peer_name"]), None)
            if then is None:
                yield f"new      {name}: {_said(now)}"
            elif min(len(then), len(now)) < 2:
                yield f"unknown  {name}: {_said(then)}, now {_said(now)}; noise needs two rounds of each"
            else:
                compared += 1
                if (word := _change(then, now)) is not None:
                    changed += 1
                    yield f"{word:8} {name}: {_said(then)}, now {_said(now)}"
        yield from (f"gone     {subject}: {what} against {peer}" for what, peer in old)
    yield f"{changed} of {compared} ratios changed beyond noise since {before['measured']}, version {_of(before)}"


def _change(then: Sequence[float], now: Sequence[float]) -> str | None:
    """`better` or `worse` if the ranges are apart and the medians differ enough; ratios are the larger the better."""
    if abs(median(now) - median(then)) < LEAST * abs(median(then)):
        return None
    if min(now) > max(then):
        return "better"
    return "worse" if max(now) < min(then) else None


def _rows(rounds: Sequence[Sequence[Comparison]]) -> list[dict[str, Any]]:
    """The comparisons of a subject, each with its figures in all rounds."""
    return [
        {"what": one.what, "peer_name": one.peer_name, "unit": one.unit, "aim": one.aim}
        | {"ours": [row.ours for row in same], "peer": [row.peer for row in same]}
        | {"ratios": [row.ratio for row in same]}
        for same in zip(*rounds, strict=True)
        for one in same[:1]
    ]


def _said(ratios: Sequence[float]) -> str:
    return f"{median(ratios):.3g} ({min(ratios):.3g} .. {max(ratios):.3g})"


def _of(record: Mapping[str, Any]) -> str:
    return str(record["versions"]["commit"] or record["versions"]["agv_ncs"])


def about_machine() -> dict[str, Any]:
    """Processor, cores, memory [B], system and load: what figures depend on."""
    model = [line for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines() if "model name" in line]
    memory = Path("/proc/meminfo").read_text(encoding="ascii").split()[1]
    cores = machine.cores()
    return {
        "processor": model[0].partition(":")[2].strip() if model else platform.machine(),
        "cores": cores["usable"],
        "memory": int(memory) * 1024,
        "load": cores["load"],
        **machine.system(),
    }


def _versions() -> dict[str, str | None]:
    """Versions of this package, of Python and of the packages that matter; None for what is not installed."""
    command = ["git", "describe", "--always", "--dirty"]
    said = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=False).stdout
    installed = {one.metadata["Name"]: one.version for one in metadata.distributions()}
    packages = {name: installed.get(name) for name in NAMED}
    return {"agv_ncs": version(), "commit": said.strip() or None, "python": platform.python_version(), **packages}
