"""Speed of a corridor's answers: one outage from every step of a lap, a rare event, and all of `stability --corridor`.

The peers are what a person would write instead: a simulated run for each place and length, and simulated laps until as
many of them have left as the splitting's interval is worth.
"""

from __future__ import annotations

import dataclasses
import math
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from agv_analysis.corridor.lap_loop import LapLoop, outage
from agv_analysis.corridor.rare_leaving import leaving_rate
from agv_analysis.corridor.single_outage import single_outage
from agv_analysis.corridor.widths import Widths
from agv_analysis.explore.settings import values_of
from agv_analysis.link.markov_channel import chain_of
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate
from benchmarks.comparison import Comparison
from benchmarks.explore import scenario_and_answer

CONFIG = str(Path(__file__).parent.parent / "config" / "outages.yaml")
HALF_WIDTH = 0.6
LENGTH = 35
"""Slots of the outage from every step."""
PLACES = 50
"""Places at which the peer is measured."""
AIM_S, AIM_MOVE_S = 5.0, 0.2
POLICIES: dict[str, list[str]] = {
    "hold": [],
    "align": ["error_detector.policy=align"],
    "predict, 10 % too fast": ["error_detector.policy=predict", "plant.speed_scale=1.1"],
}


def measure() -> list[Comparison]:
    """Each answer against its peer; whole answers against the time that they may take."""
    scenario = load_scenario(CONFIG, [f"error_detector.corridor={HALF_WIDTH}"])
    loop = LapLoop(scenario, Widths(HALF_WIDTH, math.inf, math.inf))
    chain = chain_of(scenario.relay.uplink)
    assert chain is not None
    of_all = loop.steps / _seconds(3, lambda: loop.excursions(outage(LENGTH)))
    plant = dataclasses.replace(scenario.plant, initial_pose=scenario.error_detector.track_start)

    def one_run(step: int) -> None:
        """A run up to the outage's end."""
        uplink = dataclasses.replace(scenario.relay.uplink, model="burst", n=LENGTH, start_step=step + 1)
        short = dataclasses.replace(plant, duration=(step + LENGTH + 2) * plant.ts)
        simulate(dataclasses.replace(scenario, plant=short, relay=dataclasses.replace(scenario.relay, uplink=uplink)))

    steps = range(0, loop.steps, loop.steps // PLACES)
    begun = time.perf_counter()
    for step in steps:
        one_run(step)
    one_by_one = PLACES / (time.perf_counter() - begun)
    n = single_outage(loop).n
    assert n is not None
    split = _seconds(3, lambda: leaving_rate(loop, chain, n, 1))
    rate = leaving_rate(loop, chain, n, 1).per_slot
    # Laps of which so many leave that the interval is as narrow: 1.96 / sqrt(hits) is its half in logarithms.
    hits = (1.96 / (0.5 * math.log(rate.high / rate.low))) ** 2
    lap = _seconds(1, lambda: [simulate(dataclasses.replace(scenario, plant=plant)) for _ in range(5)]) / 5
    laps = hits / (rate.value * loop.steps) * lap
    return [
        Comparison(f"an outage of {LENGTH} slots from each step", of_all, "a run each", one_by_one, "places/s"),
        Comparison(
            "rate of leaving 0.6 m, with its interval", split, "simulated laps", laps, "s", smaller_is_better=True
        ),
        *(
            Comparison(
                f"stability --corridor, {policy}", _seconds(2, lambda options=options: _command(options)),  # type: ignore[misc]
                "what it may take", AIM_S, "s", 1.0, smaller_is_better=True,
            )
            for policy, options in POLICIES.items()
        ),
        *(
            Comparison(
                f"a move in the explorer with a corridor, {policy}", _move(options), "at once", AIM_MOVE_S, "s", 1.0,
                smaller_is_better=True,
            )
            for policy, options in POLICIES.items()
        ),
    ]  # fmt: skip


def _command(options: list[str]) -> None:
    """The whole command, with start of Python, margins and twins."""
    settings = [word for option in options for word in ("--set", option)]
    words = sys.executable, "-m", "agv_analysis.cli", "stability", CONFIG, "--corridor", str(HALF_WIDTH), *settings
    subprocess.run(words, check=True, capture_output=True)


def _move(options: list[str]) -> float:
    """Seconds of the slowest of five moves, in the server."""
    base = load_scenario(CONFIG, [f"error_detector.corridor={HALF_WIDTH}", *options])
    values = values_of(base)
    scenario_and_answer(base, values, None)  # compiles
    return max(scenario_and_answer(base, {**values, "kx": 20.0 + move}, None) for move in range(5))


def _seconds(tries: int, work: Callable[[], object]) -> float:
    """Duration of the best of some tries."""
    best = math.inf
    for _ in range(tries):
        begun = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - begun)
    return best
