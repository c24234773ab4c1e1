"""The inverse: given a service, does a loop hold on it, and what is the most that it may do there?"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from agv_analysis.requirements.corridor_survival import deviation_after
from agv_analysis.scenario import SCHEMAS, Scenario
from agv_analysis.stability import floquet, joint_spectral_radius
from agv_analysis.stability.derived_loop import is_kanayamas_law, linear_loop
from agv_analysis.stability.error_dynamics import NoNominalMotionError
from agv_analysis.stability.gains import best_for_bursts
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.scenario_loop import lap_of, loop_on_lap
from agv_plant.radio.delay import whole_slots
from agv_ros.parameters import ParameterError

_FASTEST = 50.0
"""Largest speed that is asked [m/s]."""

_INTERVALS = 48
"""Sampling periods that are tried, from an eighth to 32 times that of the scenario."""

_BISECTIONS = 20

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


@dataclass(frozen=True)
class OnService:
    """What a loop does on such a service."""

    holds: bool
    why: str
    speed_max: float | None
    """Largest speed along a straight track [m/s]; None: no bound up to 50 m/s, 0: none."""
    interval_max: float | None
    """Largest sampling period that survives the same time [s], straight track, top speed; None: none does."""
    kx_max: float | None
    """Largest gain K_x [1/s] along a straight track, of Kanayama's law; None for another."""
    deviation: float
    """Largest distance from the reference [m] after one outage of the survival time, from anywhere on the lap; inf: the
    loop diverges."""
    kx_best: float | None
    """The gain that makes the worst repeated outage die out fastest."""

    def to_json(self) -> dict[str, Any]:
        """The figures by name; SI units."""
        return {
            "holds": self.holds,
            "holds_reason": self.why,
            "speed_max_mps": self.speed_max,
            "transfer_interval_max_s": self.interval_max,
            "corridor_m": self.deviation if math.isfinite(self.deviation) else None,
            "kx_max": self.kx_max,
            "kx_best": self.kx_best,
        }


def on_service(scenario: Scenario, offered: OfferedService) -> OnService:
    """What a scenario's loop does on an offered service, by stability.

    Raises ParameterError for a transfer interval that the scenario cannot have, TrackFileError for its track's file.
    """
    ts = scenario.plant.ts if offered.transfer_interval is None else offered.transfer_interval
    found = with_sampling_period(scenario, ts)
    n = slots_of(offered.survival_time, ts)
    holds, why = _holds_on_lap(found, n, offered.latency)
    top = float(np.abs(lap_of(found)[:, 3]).max())
    kx_max, kx_best = _gains(found, n)
    return OnService(
        holds=holds,
        why=why,
        speed_max=_largest(lambda v: _holds_on_line(found, v, n, offered.latency), _FASTEST),
        interval_max=_largest_interval(found, max(top, 1e-3), offered),
        deviation=deviation_after(found, n),
        kx_max=kx_max,
        kx_best=kx_best,
    )


def slots_of(survival_time: float, ts: float) -> int:
    """Slots of `ts` [s] that a survival time has: outages that are no longer than it."""
    return math.floor(survival_time / ts + _ROUNDING)


def with_sampling_period(scenario: Scenario, ts: float) -> Scenario:
    """A scenario with another sampling period on all nodes. Raises ParameterError."""
    if ts == scenario.plant.ts:
        return scenario
    return scenario.with_values({node: {"ts": ts} for node in SCHEMAS}, "the scenario with this transfer interval")


def _holds(loop: LinearLoop, n: int, latency: float) -> tuple[bool, str]:
    slots = whole_slots(latency / loop.ts)
    if slots and not loop.is_exact and not floquet.is_stable_with_delay(loop, slots):
        return False, f"a pose that is always {slots} slots late makes the error grow"
    found = joint_spectral_radius.verdict(loop, n)
    if found.verdict == joint_spectral_radius.STABLE:
        late = f", or a delay of {slots} slots" if slots else ""
        return True, f"any sequence of outages of up to {n} slots dies out{late}"
    if found.verdict == joint_spectral_radius.UNSTABLE:
        length = "1 slot" if found.worst == 1 else f"{found.worst} slots"
        what = f"outages of {length}, again and again, make the error grow"
        return False, what if found.worst else "the error does not contract even without outages"
    return False, f"that any outages of up to {n} slots die out is not proved"


def _holds_on_lap(scenario: Scenario, n: int, latency: float) -> tuple[bool, str]:
    try:
        return _holds(loop_on_lap(scenario), n, latency)
    except NoNominalMotionError as error:
        return False, str(error)


def _holds_on_line(scenario: Scenario, v: float, n: int, latency: float) -> bool:
    try:
        return _holds(linear_loop(scenario, np.array([v]), np.array([0.0])), n, latency)[0]
    except NoNominalMotionError:
        return False


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


def _largest_interval(scenario: Scenario, v: float, offered: OfferedService) -> float | None:
    """The largest sampling period at which outages of the survival time are survived; the number of slots is whole."""

    def holds(ts: float) -> bool:
        try:
            other = with_sampling_period(scenario, ts)
        except ParameterError:
            return False
        return _holds_on_line(other, v, slots_of(offered.survival_time, ts), offered.latency)

    ts = scenario.plant.ts
    tried: list[float] = np.geomspace(ts / 8.0, 32.0 * ts, _INTERVALS).tolist()
    good = [period for period in tried if holds(period)]
    if not good:
        return None
    low = max(good)
    above = [period for period in tried if period > low]
    if not above:
        return low
    high = above[0]
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def _gains(scenario: Scenario, n: int) -> tuple[float | None, float | None]:
    """(largest, best) K_x [1/s] on a straight track for outages of up to n slots; None where no closed form holds."""
    if not is_kanayamas_law(scenario) or scenario.error_detector.policy == "predict":
        return None, None
    unit = replace(scenario, controller=replace(scenario.controller, kx=1.0))
    try:
        advance = linear_loop(unit, np.array([1.0]), np.array([0.0])).along_gain
    except NoNominalMotionError:
        return None, None
    if advance is None or advance <= 0.0:
        return None, None
    return 2.0 / ((n + 1) * advance), best_for_bursts(n)[0] / advance
