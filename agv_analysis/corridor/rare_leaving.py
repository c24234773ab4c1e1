"""How often the loop leaves its corridor where simulated laps hardly do: importance splitting on the deviation."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from agv_analysis.compiled.functions import numbers
from agv_analysis.corridor.lap_loop import LapLoop
from agv_analysis.corridor.splitting import REPLICATES, Rate, Work, advance, age_levels, rate_of
from agv_analysis.corridor.widths import Widths, deviation, share_of
from agv_analysis.link.markov_channel import Chain
from agv_analysis.simulation.loop import Loop, Rows, RunInputs, compared_reference, goes_on, reference_at, slot
from agv_analysis.simulation.parts import replacements_of
from agv_plant.random_stream import DRAWS

_BASE, _LONGEST = 200_000, 20_000
"""Slots of the run that looks for the first level, and those that others may last."""

_RUNS, _FEWEST, _MOST = 5000, 100, 1000
"""Runs of a replicate in all, and from each level at least and at most."""

_CROSSINGS = 400
"""How often the first level should be reached while it is looked for."""


class LoopProcess(NamedTuple):
    """What a slot of the loop needs, beside its state."""

    reference: Rows
    inputs: RunInputs
    """Of one slot: its outcomes, and its random numbers if there are any, are written anew each time."""
    widths: Widths


def advance_loop(loop: Loop, lost: bool, k: int, rng: Any, process: LoopProcess) -> tuple[Loop, float, bool]:
    """The loop after slot k, the share of the corridor that its deviation then uses, and whether it has got a pose."""
    inputs = process.inputs
    inputs.lost[0] = lost
    draw_normals(inputs.noise, rng)
    draw_normals(inputs.slip, rng)
    compared = compared_reference(reference_at(process.reference, k), process.reference, k, inputs.settings.ahead)
    loop, sent = slot(loop, compared, inputs, 0)
    along, across, _ = deviation(loop.motion, reference_at(process.reference, k + 1))
    share = share_of(along, across, process.widths) if goes_on(loop, sent) else np.inf
    return loop, share, not lost


def draw_normals(rows: Any, rng: Any) -> None:
    """New normal numbers for the slot, if it has any."""
    if rows is None:
        return
    for j in range(DRAWS):
        rows[0, j] = rng.standard_normal()


def leaving_rate(loop: LapLoop, chain: Chain, n: int, seed: int) -> Rate:
    """The rate, in a slot, at which the loop leaves its corridor under a channel; a single outage of n slots stays in.

    Levels are what an outage of so many slots, from the worst place of the lap, uses of the corridor.
    """
    plant, levels = loop.scenario.plant, _levels(loop, chain, n, _BASE)
    work = Work(_BASE, min(_MOST, max(_FEWEST, _RUNS // len(levels))), _LONGEST)
    reference = numbers(loop.reference(work.base + work.longest + 1))

    def process() -> LoopProcess:
        inputs = loop.inputs(np.zeros(1, dtype=np.bool_))
        noise = np.zeros((1, DRAWS)) if plant.is_noisy else None
        slip = np.zeros((1, DRAWS)) if plant.slip_noise > 0.0 else None
        return LoopProcess(reference, inputs._replace(noise=noise, slip=slip), loop.widths)

    return rate_of(
        [process() for _ in range(REPLICATES)], loop.start(), chain, levels, work, seed,
        {**replacements_of(loop.scenario), advance: advance_loop},
    )  # fmt: skip


def _levels(loop: LapLoop, chain: Chain, n: int, base: int) -> list[float]:
    """Shares of the corridor, increasing to 1."""
    first = max([1, *(length for length in range(1, n + 1) if outages_of(chain, length) * base >= _CROSSINGS)])
    shares = loop.shares_in_outage(n + 1)
    levels = [shares[age] for age in age_levels(chain, n + 1, first)[:-1]]
    return [*(float(share) for share in np.unique(levels) if share < 1.0), 1.0]


def outages_of(chain: Chain, n: int) -> float:
    """Share of the slots that are the n-th of an outage."""
    state, lost = (chain.stationary * chain.delivery) @ chain.transition, 1.0 - chain.delivery
    for _ in range(n - 1):
        state = (state * lost) @ chain.transition
    return float(state @ lost)
