"""The inverse: given a service, does a loop hold on it, and what is the most that it may do there?

A service promises that outages last for its survival time at most while it is available; with an availability and a
mean time between failures it says how often, and for how long, they do not. A loop holds on it if any sequence of
outages of up to the survival time dies out, and the mean square of its error dies out on the channel of these figures
(`service_channel`), failures among them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from agv_analysis.json_values import finite
from agv_analysis.link.markov_channel import Chain
from agv_analysis.requirements.corridor_survival import deviation_after, deviation_of_any
from agv_analysis.requirements.loop_requirements import PLACES
from agv_analysis.requirements.service_channel import ServiceChannel, channel_of_service
from agv_analysis.scenario import SCHEMAS, Scenario
from agv_analysis.stability import floquet, joint_spectral_radius, mean_square
from agv_analysis.stability.derived_loop import is_kanayamas_law, linear_loop
from agv_analysis.stability.error_dynamics import NoNominalMotionError
from agv_analysis.stability.gains import best_for_bursts, best_in_mean_square
from agv_analysis.stability.linear_loop import MARGINAL, LinearLoop
from agv_analysis.stability.scenario_loop import lap_of, loop_on_lap
from agv_plant.radio.delay import whole_slots
from agv_ros.counted import counted
from agv_ros.parameters import ParameterError

_FASTEST = 50.0
"""Largest speed that is asked [m/s]."""

_INTERVALS = 48
"""Sampling periods that are tried, from an eighth to 32 times that of the scenario."""

_BISECTIONS = 14

_ROUNDING = 1e-9


@dataclass(frozen=True)
class OfferedService:
    """What a network promises: outages up to the survival time while it is available, a delay, a transfer interval."""

    survival_time: float
    """[s]"""
    latency: float = 0.0
    """Constant delay [s]; on a loop that is delayed outages are not judged, so either is judged alone."""
    transfer_interval: float | None = None
    """[s]; None: the sampling period of the scenario."""
    availability: float | None = None
    """Share of the time in which outages are no longer; None: not promised."""
    mtbf: float | None = None
    """Mean time between longer ones [s]; None: not promised."""
    loss_rate: float | None = None
    """Share of messages lost or too late; counts where it is all that is promised of losses."""

    def channel(self, ts: float) -> ServiceChannel:
        """The channel of its figures, for messages every `ts` [s]."""
        n = slots_of(self.survival_time, ts)
        return channel_of_service(self.availability, self.mtbf, n, ts, self.loss_rate)


@dataclass(frozen=True)
class OnService:
    """What a loop does on such a service."""

    offered: OfferedService
    slots: int
    """n, outages of up to so many slots come while the service is available."""
    holds: bool
    why: str
    channel: ServiceChannel
    """The channel of the service's availability and mean time between failures."""
    mean_square: bool | None
    """Does the mean square of the error die out on that channel? None: there is none."""
    speed_max: float | None
    """Largest speed along a straight track [m/s]; None: no bound up to 50 m/s, 0: none."""
    interval_max: float | None
    """Largest sampling period that survives the same time [s], straight track, top speed; None: none does."""
    interval_best: float | None
    """Of the sampling periods that do [s] that at which the worst repeated outage dies out fastest, in seconds."""
    kx_max: float | None
    """Largest gain K_x [1/s] along a straight track, of Kanayama's law; None for another."""
    deviation: float
    """Largest distance from the reference [m] after one outage of the survival time, from anywhere on the lap; inf: the
    loop diverges."""
    deviation_any: float
    """The largest that was found after any sequence of such outages [m]."""
    deviation_in_failure: float | None
    """That after one outage that is a failure of mean length [m]; None: how long failures last is not known."""
    kx_best: float | None
    """The gain that makes the worst repeated outage die out fastest."""
    kx_best_mean_square: float | None
    """The gain that makes the mean square die out fastest on the channel; None without one."""

    def to_json(self) -> dict[str, Any]:
        """The figures by name; SI units."""
        chain = self.channel.chain
        return {
            "survival_time_s": self.offered.survival_time,
            "survival_slots": self.slots,
            "latency_s": self.offered.latency,
            "availability": self.offered.availability,
            "mtbf_s": self.offered.mtbf,
            "holds": self.holds,
            "holds_reason": self.why,
            "channel": {
                "loss_rate": None if chain is None else chain.loss_rate,
                "mean_burst": None if chain is None else chain.mean_burst,
                "why": self.channel.why,
            },
            "failure_s": None if self.channel.failure is None else finite(self.channel.failure),
            "mean_square": self.mean_square,
            "speed_max_mps": self.speed_max,
            "transfer_interval_max_s": self.interval_max,
            "transfer_interval_best_s": self.interval_best,
            "corridor_m": finite(self.deviation),
            "corridor_any_m": finite(self.deviation_any),
            "corridor_in_failure_m": finite(self.deviation_in_failure),
            "kx_max": self.kx_max,
            "kx_best": self.kx_best,
            "kx_best_mean_square": self.kx_best_mean_square,
        }


def on_service(scenario: Scenario, offered: OfferedService) -> OnService:
    """What a scenario's loop does on an offered service.

    Raises ParameterError for a transfer interval that the scenario cannot have, TrackFileError for its track's file.
    """
    ts = scenario.plant.ts if offered.transfer_interval is None else offered.transfer_interval
    found = with_sampling_period(scenario, ts)
    n = slots_of(offered.survival_time, ts)
    channel = offered.channel(ts)
    answer = _holds_on_lap(found, offered)
    top = float(np.abs(lap_of(found)[:, 3]).max())
    kx_max, kx_best, kx_best_mean_square = _gains(found, n, channel.chain)
    interval_max, interval_best = _intervals(found, max(top, 1e-3), offered)
    failure = channel.failure
    lasting = None if failure is None or not math.isfinite(failure) else n + max(1, round(failure / ts))
    return OnService(
        offered=offered,
        slots=n,
        holds=answer.holds,
        why=answer.why,
        channel=channel,
        mean_square=answer.mean_square,
        speed_max=_largest(lambda v: _holds_on_line(found, v, offered).holds, _FASTEST),
        interval_max=interval_max,
        interval_best=interval_best,
        deviation=deviation_after(found, n),
        deviation_any=deviation_of_any(found, n),
        deviation_in_failure=None if lasting is None else deviation_after(found, lasting),
        kx_max=kx_max,
        kx_best=kx_best,
        kx_best_mean_square=kx_best_mean_square,
    )


def slots_of(survival_time: float, ts: float) -> int:
    """Slots of `ts` [s] that a survival time has: outages that are no longer than it."""
    return math.floor(survival_time / ts + _ROUNDING)


def with_sampling_period(scenario: Scenario, ts: float) -> Scenario:
    """A scenario with another sampling period on all nodes. Raises ParameterError."""
    if ts == scenario.plant.ts:
        return scenario
    return scenario.with_values({node: {"ts": ts} for node in SCHEMAS}, "the scenario with this transfer interval")


class _Answer(NamedTuple):
    """Does a loop hold on a service?"""

    holds: bool
    why: str
    mean_square: bool | None = None
    """Does its mean square die out on the channel of the service? None: there is none."""
    growth: float = math.inf
    """Growth (logarithm, per second) of the worst repeated outage."""


def _holds(loop: LinearLoop, offered: OfferedService) -> _Answer:
    n, slots = slots_of(offered.survival_time, loop.ts), whole_slots(offered.latency / loop.ts)
    channel = offered.channel(loop.ts)
    square = None if channel.chain is None else _dies_out(loop, channel.chain)
    if slots and not loop.is_exact and not floquet.is_stable_with_delay(loop, slots):
        return _Answer(False, f"a pose that is always {counted(slots, 'slot')} late makes the error grow", square)
    found = joint_spectral_radius.verdict(loop, n)
    growth = math.log(found.lower) / loop.ts if found.lower > 0.0 else -math.inf
    if found.verdict == joint_spectral_radius.UNSTABLE:
        length = counted(found.worst, "slot")
        what = f"outages of {length}, again and again, make the error grow"
        return _Answer(
            False, what if found.worst else "the error does not contract even without outages", square, growth
        )
    if found.verdict != joint_spectral_radius.STABLE:
        return _Answer(False, f"that any outages of up to {counted(n, 'slot')} die out is not proved", square, growth)
    if square is False:
        why = f"its failures, as of {channel.why}, make the mean square of the error grow"
        return _Answer(False, why, square, growth)
    late = f", or a delay of {counted(slots, 'slot')}" if slots else ""
    often = "" if square is None else ", and the mean square of the error with the failures"
    return _Answer(True, f"any sequence of outages of up to {counted(n, 'slot')} dies out{late}{often}", square, growth)


def _dies_out(loop: LinearLoop, chain: Chain) -> bool:
    part = loop.thinned(PLACES)
    return mean_square.lap_growth(part, chain) < MARGINAL * part.steps


def _holds_on_lap(scenario: Scenario, offered: OfferedService) -> _Answer:
    try:
        return _holds(loop_on_lap(scenario), offered)
    except NoNominalMotionError as error:
        return _Answer(False, str(error))


def _on_line(scenario: Scenario, v: float) -> LinearLoop | None:
    """The loop on a straight track at a speed [m/s]; None if it does not settle there."""
    try:
        return linear_loop(scenario, np.array([v]), np.array([0.0]))
    except NoNominalMotionError:
        return None


def _holds_on_line(scenario: Scenario, v: float, offered: OfferedService) -> _Answer:
    loop = _on_line(scenario, v)
    return _Answer(False, "the loop does not settle") if loop is None else _holds(loop, offered)


def _largest(holds: Callable[[float], bool], end: float) -> float | None:
    """The largest value up to which a property holds from below, None if up to the end, 0 if not at once."""
    grid: list[float] = np.geomspace(end / 2**12, end, 25).tolist()
    if not holds(grid[0]):
        return 0.0
    low = grid[0]
    for high in grid[1:]:
        if not holds(high):
            break
        low = high
    else:
        return None
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def _intervals(scenario: Scenario, v: float, offered: OfferedService) -> tuple[float | None, float | None]:
    """(Largest, best) sampling period [s] at which the loop holds; the number of slots is whole."""

    def answer(ts: float) -> _Answer:
        try:
            return _holds_on_line(with_sampling_period(scenario, ts), v, offered)
        except ParameterError as error:
            return _Answer(False, str(error))

    ts = scenario.plant.ts
    tried = {period: answer(period) for period in (*np.geomspace(ts / 8.0, 32.0 * ts, _INTERVALS).tolist(), ts)}
    good = {period: found.growth for period, found in tried.items() if found.holds}
    if not good:
        return None, None
    low, best = max(good), min(good, key=lambda period: good[period])
    above = [period for period in tried if period > low]
    if not above:
        return low, best
    high = min(above)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if answer(middle).holds else (low, middle)
    return low, best


def _gains(scenario: Scenario, n: int, chain: Chain | None) -> tuple[float | None, float | None, float | None]:
    """(Largest, best for outages of up to n slots, best in the mean square on a channel) K_x [1/s], straight track.

    None where no closed form holds, or there is no channel.
    """
    nothing = None, None, None
    if not is_kanayamas_law(scenario) or scenario.error_detector.policy == "predict":
        return nothing
    unit = replace(scenario, controller=replace(scenario.controller, kx=1.0))
    loop = _on_line(unit, 1.0)
    advance = None if loop is None else loop.along_gain
    if advance is None or advance <= 0.0:
        return nothing
    in_mean_square = None if chain is None else best_in_mean_square(chain)[0] / advance
    return 2.0 / ((n + 1) * advance), best_for_bursts(n)[0] / advance, in_mean_square
