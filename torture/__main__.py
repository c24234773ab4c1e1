"""Kill matrix, attacks on the wire, damaged bags: `python -m torture [--minutes M] [--seed S] [--json FILE]`."""

from __future__ import annotations

import json
import os
import random
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import click

from fuzz.campaign import run as fuzz
from torture.by_hand import faults_by_hand, run_by_hand
from torture.kills import Case, cases, faults, run
from torture.wire import attack

PARAMS = str(Path(__file__).parents[1] / "config/outages.yaml")

_SHARES = {"kills": 0.7, "wire": 0.2, "bags": 0.1}
"""Of the time."""


@click.command()
@click.option("--minutes", type=click.FloatRange(min=0.1), default=20.0, show_default=True, help="How long, at most.")
@click.option("--seed", type=int, default=1, show_default=True, help="Of the order of the kills, and of the attacks.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write the figures to this file, too.")
def main(minutes: float, seed: int, json_file: Path | None) -> None:
    """Try to break runs and recordings; exit status 1 if anything did not hold."""
    os.environ.setdefault("ROS_DOMAIN_ID", "93")
    found: dict[str, dict[str, Any]] = {}
    for name, part in (("kills", _kills), ("wire", _wire), ("bags", _bags)):
        with tempfile.TemporaryDirectory(prefix="agv_ncs_torture_") as folder:
            found[name] = part(seed, time.monotonic() + 60.0 * minutes * _SHARES[name], Path(folder))
        if json_file is not None:
            json_file.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
        click.echo(f"{name}: {found[name]['cases']} cases, {found[name]['bad']} of them not as they should be")
    raise SystemExit(any(part["bad"] for part in found.values()))


def _kills(seed: int, end: float, folder: Path) -> dict[str, Any]:
    order = list(cases())
    random.Random(seed).shuffle(order)
    bad: dict[str, list[str]] = {}
    done, longest = 0, 0.0
    for case in order:
        if time.monotonic() > end:
            break
        with tempfile.TemporaryDirectory(dir=folder) as own:
            wrong, seconds, said = _by_hand(case, Path(own)) if case.start == "hand" else _by_runner(case, Path(own))
        done += 1
        if case.number.name != "SIGSTOP":
            longest = max(longest, seconds)
        if wrong:
            bad[str(case)] = [*wrong, said.strip().rpartition("\n")[2]]
            click.echo(f"{case}: {'; '.join(bad[str(case)])}")
    return {"cases": done, "of": len(order), "bad": len(bad), "longest_s": round(longest, 2), "faults": bad}


def _by_runner(case: Case, folder: Path) -> tuple[list[str], float, str]:
    """Faults, seconds to the end, and what was said."""
    ended = run(case, folder, PARAMS)
    return faults(case, ended, folder / "bag"), ended.seconds, ended.said


def _by_hand(case: Case, folder: Path) -> tuple[list[str], float, str]:
    ended = run_by_hand(case, folder, PARAMS)
    return faults_by_hand(case, ended, folder / "bag"), max(ended.victim_seconds, ended.seconds), ended.said["plant"]


def _wire(seed: int, end: float, folder: Path) -> dict[str, Any]:
    bad: dict[str, list[str]] = {}
    kinds: Counter[str] = Counter()
    runs = 0
    while time.monotonic() < end:
        clock = ("realtime", "lockstep")[runs % 2]
        with tempfile.TemporaryDirectory(dir=folder) as own:
            found = attack(seed + runs, clock, 250, Path(own), PARAMS)
        kinds.update(found.by_kind)
        if found.faults:
            bad[f"{clock}, seed {seed + runs}"] = [*found.faults, found.said.strip().rpartition("\n")[2]]
            click.echo(f"wire, {clock}, seed {seed + runs}: {'; '.join(found.faults)}")
        runs += 1
    return {"cases": sum(kinds.values()), "runs": runs, "bad": len(bad), "kinds": dict(kinds), "faults": bad}


def _bags(seed: int, end: float, folder: Path) -> dict[str, Any]:
    cases_done = 0
    bad: Counter[str] = Counter()
    while time.monotonic() < end:
        found = fuzz(seed, range(cases_done, cases_done + 200), folder, None)
        cases_done += sum(found.cases.values())
        bad.update(found.faults)
    return {"cases": cases_done, "bad": sum(bad.values()), "faults": dict(bad)}


if __name__ == "__main__":
    main()
