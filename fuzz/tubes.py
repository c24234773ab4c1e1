"""Runs of the nonlinear loop against the tubes that cover it: `python -m fuzz.tubes --runs N [--seed S] [--json FILE]`.

A run begins on the loss-free motion at one of many places of the lap and meets a sequence of outages of up to n slots.
Half of the sequences are random, or repeat a few lengths; the others change the one that came nearest to its tube, so
that the search goes on where it hurts. Each step of each run is held against all bounds of the tube at that step.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from agv_analysis.compiled.functions import compiled
from agv_analysis.corridor.lap_loop import LapLoop, Outcomes
from agv_analysis.corridor.outer_tube import Tube, outer_tube
from agv_analysis.corridor.second_order import nonlinear_tube
from agv_analysis.corridor.widths import Widths
from agv_analysis.run import Floats
from agv_analysis.scenario import load_scenario
from agv_analysis.stability.scenario_loop import loop_on_lap

Lengths = NDArray[np.int64]

CONFIG = str(Path(__file__).parent.parent / "config" / "outages.yaml")
TRACKS = "line", "circle", "eight", "paper", "warehouse"
POLICIES = {
    "hold": (12, ()), "align": (12, ()), "predict": (30, ("plant.speed_scale=1.1",)),
}  # fmt: skip
"""Longest outage [slots] and further settings by policy."""

_HALF_WIDTH = 2.0
_PLACES, _SLOTS = 200, 600
_ROUNDING, _SMALL = 1e-9, 1e-6
"""What is not a departure, and bounds of which no share is taken [m, m, rad times the lever]."""


@dataclass
class Case:
    """A tube, and what was seen of it."""

    policy: str
    track: str
    n: int
    tube: float
    """Largest distance in it [m]."""
    farthest: float = 0.0
    """Largest distance that any run reached [m]."""
    nearest: float = 0.0
    """Largest share of a bound that any run used."""
    runs: int = 0
    outside: int = 0


class Search:
    """The runs of one policy on one track."""

    def __init__(self, policy: str, track: str, rng: np.random.Generator) -> None:
        n, more = POLICIES[policy]
        settings = (f"error_detector.policy={policy}", f"error_detector.track={track}", *more)
        scenario = load_scenario(CONFIG, settings)
        self._loop = LapLoop(scenario, Widths(_HALF_WIDTH, math.inf, math.inf))
        linear = loop_on_lap(scenario)
        tube = outer_tube(self._loop, linear, n)
        found = None if tube is None else nonlinear_tube(self._loop, linear, tube)
        if found is None or not found.is_proved or found.tube.n < n:
            raise click.ClickException(f"{policy} on {track}: no tube of the nonlinear loop for outages of {n} slots")
        self.tube: Tube = found.tube
        """The one that is proved for the nonlinear loop."""
        self._rng = rng
        self._best: Lengths = np.full(_SLOTS, n)
        self.case = Case(policy, track, n, self.tube.deviation)

    def go_on(self) -> None:
        """One more sequence, from all places."""
        lengths = self._changed() if self._rng.random() < 0.5 else self._drawn()
        outcomes = _outcomes(lengths)
        used, distance, outside = self._used(outcomes)
        if used > self.case.nearest:
            self.case.nearest, self._best = used, lengths
        self.case.farthest = max(self.case.farthest, distance)
        self.case.runs += _PLACES
        self.case.outside += outside

    def _drawn(self) -> Lengths:
        """Lengths of outages: any, long and short ones, or a few that repeat."""
        n, kind = self.case.n, self._rng.integers(3)
        if kind == 0:
            return self._rng.integers(0, n + 1, _SLOTS)
        if kind == 1:
            return np.asarray(self._rng.choice([0, n - 1, n], _SLOTS))
        return np.resize(self._rng.integers(0, n + 1, self._rng.integers(1, 6)), _SLOTS)

    def _changed(self) -> Lengths:
        """The best lengths so far, some of the first ones changed."""
        lengths: Lengths = np.array(self._best)
        places = self._rng.integers(0, _SLOTS // (1 + self.case.n // 2), self._rng.integers(1, 4))
        lengths[places] = self._rng.integers(0, self.case.n + 1, len(places))
        return np.asarray(lengths, dtype=np.int64)

    def _used(self, outcomes: Outcomes) -> tuple[float, float, int]:
        """Largest share of a bound, largest distance [m], and how many of the runs were outside of the tube."""
        every, tube = self._loop.steps // _PLACES, self.tube
        found, paths = self._loop.excursions(outcomes, every, kept=_SLOTS, follow=False)
        small = max(_SMALL, 1e-3 * float(tube.bounds.max()))
        share, distance, outside = compiled(_held_against)(
            paths[:_PLACES], found.steps[:_PLACES], tube.bounds, tube.nominal, tube.template.directions, small
        )
        return float(share), float(distance), int(outside)


def _held_against(
    paths: Floats, steps: Lengths, bounds: Floats, nominal: Floats, directions: Floats, small: float
) -> tuple[float, float, int]:
    """As `_used` says, of paths of errors of shape (S, slots, 3) that begin at these steps of the lap."""
    nearest, farthest, outside = 0.0, 0.0, 0
    for s in range(paths.shape[0]):
        is_outside = False
        for i in range(paths.shape[1]):
            row = (steps[s] + i) % bounds.shape[0]
            x_e, y_e, theta_e = paths[s, i, 0], paths[s, i, 1], paths[s, i, 2]
            x, y, theta = x_e - nominal[row, 0], y_e - nominal[row, 1], theta_e - nominal[row, 2]
            farthest = max(farthest, math.hypot(x_e, y_e))
            for j in range(directions.shape[0]):
                reached, bound = directions[j, 0] * x + directions[j, 1] * y + directions[j, 2] * theta, bounds[row, j]
                if not reached <= bound + _ROUNDING:
                    is_outside = True
                if bound > small:
                    nearest = max(nearest, reached / bound)
        outside += is_outside
    return nearest, farthest, outside


def _outcomes(lengths: Lengths) -> Outcomes:
    """A reception before each outage, True where lost, of _SLOTS slots."""
    return np.concatenate([np.arange(length + 1) > 0 for length in lengths.tolist()])[:_SLOTS]


def search(seed: int, runs: int) -> Iterator[list[Case]]:
    """So many runs or a few more, shared out among the cases; what is known after each sequence of all."""
    searches = [
        Search(policy, track, np.random.default_rng([seed, i]))
        for i, (policy, track) in enumerate((policy, track) for policy in POLICIES for track in TRACKS)
    ]
    while sum(one.case.runs for one in searches) < runs:
        for one in searches:
            one.go_on()
        yield [one.case for one in searches]


@click.command()
@click.option("--runs", type=click.IntRange(min=1), default=1_000_000, show_default=True, help="How many.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Of all sequences.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Keep the figures in this file meanwhile.")
def main(runs: int, seed: int, json_file: Path | None) -> None:
    """Look for a run that leaves its tube; exit status 1 if there is any."""
    cases: list[Case] = []
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("driving", total=runs)
        for cases in search(seed, runs):
            progress.update(task, completed=sum(case.runs for case in cases))
            if json_file is not None:
                figures = {"seed": seed, "cases": [asdict(case) for case in cases]}
                json_file.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    table = Table("policy", "track", "n", "runs", "outside", "farthest [m]", "tube [m]", "nearest to a bound", box=None)
    for case in cases:
        table.add_row(
            case.policy, case.track, str(case.n), str(case.runs), str(case.outside), f"{case.farthest:.4g}",
            f"{case.tube:.4g}", f"{case.nearest:.1%}",
        )  # fmt: skip
    Console(highlight=False).print(table)
    raise SystemExit(1 if any(case.outside for case in cases) else 0)


if __name__ == "__main__":
    main()
