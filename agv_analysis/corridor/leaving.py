"""How often the loop leaves its corridor under the channel of its scenario, and how long it takes to.

First whole laps are simulated, each with outcomes, noise and slip of its own: that knows every channel, delays and both
links. Where few of them leave, and the channel is a Markov chain, importance splitting says how rare it is.

A lap begins with the AGV on the loss-free motion, or where that is not the reference, with a lap that is not looked at.
Laps count as independent of each other: what an outage leaves is over long before the next lap.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from agv_analysis.compiled.functions import compiled, numbers
from agv_analysis.corridor.lap_loop import LapLoop
from agv_analysis.corridor.rare_leaving import leaving_rate, outages_of
from agv_analysis.corridor.single_outage import SingleOutage
from agv_analysis.corridor.widths import Widths, share_of
from agv_analysis.link.channel_fit import Estimate
from agv_analysis.link.markov_channel import Chain, chain_of
from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.batch import cores
from agv_analysis.simulation.channel_outcomes import ChannelRealisation
from agv_analysis.simulation.loop import Rows, RunInputs, history
from agv_analysis.simulation.parts import replacements_of, run_parts
from agv_analysis.simulation.single import settings_of, simulate
from agv_analysis.simulation.trace_windows import parts_of_traces, with_windows
from agv_cloud.tracking_error import tracking_error
from agv_plant.channels.registry import TRACE
from agv_plant.parameters import ChannelParameters
from agv_plant.vehicle.motion import NOISE, SLIP
from agv_ros.counted import counted

LAPS = 200
"""Laps that are simulated, if they are of usual length."""

_SLOTS, _FEWEST = 4_000_000, 40
"""Slots that are simulated at most, but for so many laps."""

ENOUGH = 40
"""Laps that leave, with which nothing rarer is asked."""

HOUR = 3600.0

_ON_REFERENCE = 1e-3
"""Share of the corridor up to which the loss-free motion is the reference."""


class Lap(NamedTuple):
    """What is kept of a simulated lap."""

    share: float
    """Largest share of the corridor that it used; inf if it diverged."""
    steps: int
    """Steps until the corridor was left, or all."""
    mean_square: float
    """Of the distance from the reference [m^2]."""


@dataclass(frozen=True)
class Leaving:
    """How often the corridor is left; each figure with its 95 % interval."""

    p_lap: Estimate
    """Probability that a lap leaves it."""
    p_hour: Estimate
    mean_time: Estimate | None
    """Mean time [s] until it is left; its upper end may be inf. None: it is never left."""
    method: str
    """How this is known, in words."""
    largest: Floats
    """Largest share of the corridor that each of the simulated laps used, shape (laps,); inf where one diverged."""
    mean_squares: Floats
    """Mean square of the distance from the reference in each of them [m^2], shape (laps,)."""

    @property
    def rms(self) -> float:
        """RMS deviation of the simulated laps [m]; inf where one diverged."""
        return float(np.sqrt(self.mean_squares.mean()))

    @property
    def rms_interval(self) -> Estimate:
        """The same with its 95 % interval, by the spread of the laps; of a single one, which is not random, itself."""
        if len(self.mean_squares) < 2 or not math.isfinite(self.rms):
            return Estimate(self.rms, self.rms, self.rms)
        half = _NORMAL * float(self.mean_squares.std(ddof=1)) / math.sqrt(len(self.mean_squares))
        return Estimate(self.rms, math.sqrt(max(0.0, self.rms**2 - half)), math.sqrt(self.rms**2 + half))


_NORMAL = 1.96
"""Quantile of the normal distribution for 95 %."""


def leaving(
    loop: LapLoop, single: SingleOutage | None, laps: int | None = None,
    progress: Callable[[int], None] = lambda done: None, n_proved: int | None = None,
) -> Leaving:  # fmt: skip
    """How often a scenario's loop leaves its corridor. `single`: what one outage does to it, where that is known.

    It stays inside whatever outages of up to `n_proved` slots come; None: that is not known.
    """
    scenario = with_windows(loop.scenario, loop.steps * loop.ts)
    parts = parts_of_traces(scenario)
    if not is_random(scenario) and parts == 1:
        return _certain(loop, _one_lap(loop))
    laps = laps or max(_FEWEST, min(LAPS, _SLOTS // loop.steps))
    laps = laps if is_random(scenario) else min(laps, parts)  # further ones would be the same again
    driven = list(_laps(loop, scenario, laps, progress))
    left, slots = sum(lap.share > 1.0 for lap in driven), sum(lap.steps for lap in driven)
    chain = chain_alone(loop.scenario)
    if left < ENOUGH and chain is not None and single is not None and single.n is not None and single.n >= 0:
        longer = 1.0 if n_proved is None or n_proved < 0 or left else outages_of(chain, n_proved + 1)
        if n_proved is not None and longer * HOUR / loop.ts < _NEVER:
            method = f"how rarely an outage is longer than the {counted(n_proved, 'slot')} with which it stays inside"
            return _of_rate(loop, Estimate(0.0, 0.0, longer), driven, method)
        rate = leaving_rate(loop, chain, single.n, loop.scenario.relay.seed)
        if 0.0 < rate.per_slot.value * loop.steps < _RARE:
            return _of_rate(loop, rate.per_slot, driven, f"importance splitting with {counted(rate.runs, 'run')}")
    method = f"{laps} simulated laps, {left} of which left it"
    # As if each slot inside were followed by a departure with the same probability.
    in_a_slot = Estimate.of(left, max(left, slots)) if left else None
    return _of_laps(loop, Estimate.of(left, laps), in_a_slot, slots / left if left else math.inf, driven, method)


_NEVER = 1e-15
"""Expected number of times an hour below which it is not estimated how often the corridor is left."""

_RARE = 0.2
"""Expected number of times a lap up to which they count as independent of each other."""


def _of_laps(
    loop: LapLoop, p: Estimate, in_a_slot: Estimate | None, slots: float, driven: list[Lap], method: str
) -> Leaving:  # fmt: skip
    """By the probability of a lap, that of a slot, None if none left, and the mean number of slots inside."""
    lap = loop.steps * loop.ts
    per_hour = Estimate(*(_within(value, HOUR / lap) for value in (p.value, p.low, p.high)))
    if in_a_slot is None:
        low = -lap / math.log1p(-p.high)
        return Leaving(p, per_hour, Estimate(math.inf, low, math.inf), method, *_of_each(driven))
    mean = Estimate.about(slots * loop.ts, loop.ts / in_a_slot.high, loop.ts / in_a_slot.low)
    return Leaving(p, per_hour, mean, method, *_of_each(driven))


def _within(p: float, times: float) -> float:
    """Probability that what happens with probability p in one of some equal times happens in any of them."""
    return -math.expm1(times * math.log1p(-p)) if p < 1.0 else 1.0


def _of_rate(loop: LapLoop, rate: Estimate, driven: list[Lap], method: str) -> Leaving:
    lap, hour, ends = loop.steps, HOUR / loop.ts, (rate.value, rate.low, rate.high)
    p_lap, p_hour = (Estimate(*(-math.expm1(-value * slots) for value in ends)) for slots in (lap, hour))
    times = [loop.ts / value if value > 0.0 else math.inf for value in (rate.value, rate.high, rate.low)]
    return Leaving(p_lap, p_hour, Estimate(*times), method, *_of_each(driven))


def _of_each(driven: list[Lap]) -> tuple[Floats, Floats]:
    return np.array([lap.share for lap in driven]), np.array([lap.mean_square for lap in driven])


def _certain(loop: LapLoop, lap: Lap) -> Leaving:
    """Nothing is random: one lap says it all."""
    leaves = float(lap.share > 1.0)
    p = Estimate(leaves, leaves, leaves)
    mean = Estimate(*(lap.steps * loop.ts,) * 3) if leaves else None
    return Leaving(p, p, mean, "one lap, since nothing is random", *_of_each([lap]))


def chain_alone(scenario: Scenario) -> Chain | None:
    """The uplink as a chain, where it alone loses messages, some but not all, and none comes late."""
    uplink, downlink = scenario.relay.uplink, scenario.relay.downlink
    is_alone = uplink.is_direct and downlink.is_direct and downlink.model == "perfect" and not downlink.schedule
    chain = chain_of(uplink) if is_alone else None
    return chain if chain is not None and 0.0 < chain.loss_rate < 1.0 else None


def is_random(scenario: Scenario) -> bool:
    """Do noise, slip or a link depend on the seed?"""
    plant, relay = scenario.plant, scenario.relay
    return plant.is_noisy or plant.slip_noise > 0.0 or any(map(_is_drawn, (relay.uplink, relay.downlink)))


_ROUNDING = 1e-15
"""Loss rate that is none."""


def _is_drawn(link: ChannelParameters) -> bool:
    """Are outcomes or delays of a link random?"""
    if link.is_placed or link.jitter > 0.0:
        return True
    chain = chain_of(link)
    if chain is None:
        return link.model not in (TRACE, "perfect", "burst")
    if chain.loss_rate < _ROUNDING:
        return False
    chances = np.concatenate((chain.transition.ravel(), chain.delivery))
    return bool(((chances > 0.0) & (chances < 1.0)).any())


def _laps(loop: LapLoop, scenario: Scenario, laps: int, progress: Callable[[int], None]) -> Iterator[Lap]:
    """Laps of a loop with the links of a scenario, under the seeds from relay.seed on."""
    drive, skipped = _prepared(loop)
    with ThreadPoolExecutor(cores()) as pool:
        found = pool.map(lambda i: drive(loop, scenario, scenario.relay.seed + i, skipped), range(laps))
        for done, lap in enumerate(found, start=1):
            progress(done)
            yield lap


def _one_lap(loop: LapLoop) -> Lap:
    drive, skipped = _prepared(loop)
    return drive(loop, loop.scenario, loop.scenario.relay.seed, skipped)


def _prepared(loop: LapLoop) -> tuple[Callable[[LapLoop, Scenario, int, int], Lap], int]:
    """How a lap is driven, and how many steps of it are not looked at."""
    relay = loop.scenario.relay
    loop.reference(2 * loop.steps)  # before threads ask for it
    is_direct = relay.uplink.is_direct and relay.downlink.is_direct
    return _direct_lap if is_direct else _simulated_lap, 0 if loop.loss_free_share < _ON_REFERENCE else loop.steps


def _direct_lap(loop: LapLoop, scenario: Scenario, seed: int, skipped: int) -> Lap:
    steps = skipped + loop.steps
    plant, relay, drawn = scenario.plant, scenario.relay, ChannelRealisation(seed, steps, loop.ts)
    inputs = RunInputs(
        numbers(drawn.outcomes(relay.uplink, "uplink")), numbers(drawn.outcomes(relay.downlink, "downlink")),
        loop.start(), settings_of(scenario),
        numbers(drawn.normals(NOISE)) if plant.is_noisy else None,
        numbers(drawn.normals(SLIP)) if plant.slip_noise > 0.0 else None,
    )  # fmt: skip
    rows, n_ul = np.full((steps, 8), math.nan), np.empty(steps, dtype=np.int64)
    reference = loop.reference(2 * loop.steps)
    run_parts(history, replacements_of(scenario), numbers(reference), inputs, rows, n_ul)
    return _seen(loop, rows, reference, skipped)


def _simulated_lap(loop: LapLoop, scenario: Scenario, seed: int, skipped: int) -> Lap:
    plant = replace(
        scenario.plant, seed=seed, initial_pose=scenario.error_detector.track_start,
        duration=(skipped + loop.steps) * loop.ts, clock="lockstep",
    )  # fmt: skip
    run = simulate(replace(scenario, plant=plant, relay=replace(scenario.relay, seed=seed)))
    pose = np.full((skipped + loop.steps, 3), math.nan)
    pose[: len(run)] = run.pose
    return _seen(loop, pose, loop.reference(2 * loop.steps), skipped)


def _seen(loop: LapLoop, pose: Floats, reference: Floats, skipped: int) -> Lap:
    """What is kept of poses, shape (N, 3) or with more columns, without the first `skipped`."""
    share, steps, square = compiled(largest_share)(numbers(pose), numbers(reference), skipped, loop.widths)
    return Lap(share, steps, square if math.isfinite(square) else math.inf)


def largest_share(pose: Rows, reference: Rows, skipped: int, widths: Widths) -> tuple[float, int, float]:
    """Largest share of the corridor that a path uses, steps until it is left or all, and its mean squared distance.

    Poses and reference of as many steps or more; the first `skipped` do not count.
    """
    count = len(pose) - skipped
    largest, left, square = 0.0, count, 0.0
    for k in range(count):
        at, now = pose[skipped + k], reference[skipped + k]
        along, across, _ = tracking_error(at[0], at[1], at[2], now[0], now[1], now[2])
        share = share_of(along, across, widths)
        largest = max(largest, share)
        if share > 1.0 and left == count:
            left = k
        dx, dy = at[0] - now[0], at[1] - now[1]
        square += dx * dx + dy * dy
    return largest, left, square / count
