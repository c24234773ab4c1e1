"""A fleet: several loops that share one uplink, derived from one scenario, and the result of each.

All share the uplink's resource blocks and their schedule, which each relay computes from the same seed. Each vehicle
has its own random numbers for downlink, delays, noise and slip, and its own track, beside the first vehicle's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from agv_analysis.corridor.outages_seen import recorded_outages
from agv_analysis.corridor.widths import widths_of
from agv_analysis.metrics.confidence import CONFIDENCE, clopper_pearson
from agv_analysis.recordings.recording import read_run
from agv_analysis.run import Run
from agv_analysis.scenario import Scenario
from agv_analysis.simulation import simulate
from agv_analysis.simulation.batch import TWIN_OFFSET
from agv_analysis.stability.analysis import Analysis, analyse
from agv_analysis.stability.empirical import distances, is_unstable, left_without_losses
from agv_analysis.stability.repeated_run import settles_without_losses
from agv_plant.channels.registry import SHARED
from agv_plant.parameters import ChannelParameters
from agv_ros.errors import UserError
from agv_ros.parameters import ParameterError

_SEEDS = 2**62
"""Seeds are below this."""

_SEEDS_APART = 2**32
"""Distance of two vehicles' seeds: fleets with neighbouring seeds have no vehicle's in common."""


def vehicle_names(count: int) -> list[str]:
    """Names of a fleet's vehicles, which are their namespaces: agv_01, agv_02, ..."""
    digits = max(2, len(str(count)))
    return [f"agv_{number:0{digits}}" for number in range(1, count + 1)]


def vehicle_scenarios(scenario: Scenario, count: int, pitch: float) -> list[Scenario]:
    """Scenario of each of `count` vehicles that share an uplink, each `pitch` [m] to the left of the one before.

    Raises ParameterError for an uplink that is not shared and says more than how many of the poses sent are lost.
    """
    uplink = _shared(scenario.relay.uplink)
    if scenario.relay.downlink.correlation > 0.0:
        raise ParameterError(
            f"relay.downlink.correlation is {scenario.relay.downlink.correlation}, but a fleet's uplink loses poses "
            "because others are sent: set it to 0.0"
        )
    return [
        _vehicle(scenario, replace(uplink, vehicles=count, vehicle=i), i, pitch, name)
        for i, name in enumerate(vehicle_names(count))
    ]


def _shared(uplink: ChannelParameters) -> ChannelParameters:
    """The uplink of a fleet: one without memory becomes a shared one that loses as many of the poses sent."""
    if uplink.model == "perfect":
        return replace(uplink, model=SHARED, p=0.0)
    if uplink.model in ("bernoulli", SHARED):
        return replace(uplink, model=SHARED)
    raise ParameterError(
        f"relay.uplink.model is {uplink.model}, but the vehicles of a fleet share one uplink, in which a pose that is "
        "sent is lost with probability p: --set relay.uplink.model=shared, and p, blocks and scheduler as wanted"
    )


def _vehicle(scenario: Scenario, uplink: ChannelParameters, i: int, pitch: float, name: str) -> Scenario:
    plant, relay, edge = scenario.plant, scenario.relay, scenario.error_detector
    theta, aside = edge.track_start[2], i * pitch
    shift = (-aside * math.sin(theta), aside * math.cos(theta)) if i else (0.0, 0.0)
    prefix = f"{name}/{plant.frame_prefix}"
    downlink = replace(relay.downlink, vehicles=uplink.vehicles, vehicle=i)
    seed = (plant.seed + i * _SEEDS_APART) % _SEEDS
    return Scenario(
        plant=replace(plant, initial_pose=_moved(plant.initial_pose, shift), seed=seed, frame_prefix=prefix),
        relay=replace(relay, uplink=uplink, downlink=downlink, frame_prefix=prefix),
        error_detector=replace(edge, track_start=_moved(edge.track_start, shift), frame_prefix=prefix),
        controller=replace(scenario.controller, frame_prefix=prefix),
    )


def _moved(pose: tuple[float, float, float], shift: tuple[float, float]) -> tuple[float, float, float]:
    return pose[0] + shift[0], pose[1] + shift[1], pose[2]


# -- results -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Vehicle:
    """The result of one vehicle of a fleet; figures are None where they are unknown, as without a recording."""

    vehicle: str
    steps: int
    failure: str
    """Why its run, its recording or its analysis is not whole, empty if all are."""
    bag: str | None = None
    loss_rate: float | None = None
    longest_outage: int | None = None
    """[slots]"""
    settle_1cm_steps: int | None = None
    final_error: float | None = None
    """[m]"""
    deviation: Mapping[str, Any] | None = None
    """How far it strayed, as the JSON of `analyse` has it: `max`, `p99`, `rms` [m], `worst`, and so on."""
    speed: Mapping[str, Any] | None = None
    """The same of what its controller asked for: `max` [m/s], `turn_rate_max` [rad/s]."""
    corridor_share: float | None = None
    """Largest share of its corridor that it used, above 1 outside; None without a corridor, as are the next two."""
    outages_outside: int | None = None
    """Outages after which it was outside, and with 95 % confidence the share of all outages that lead there at most."""
    p_outage_at_most: float | None = None
    verdict: str | None = None
    verdict_criterion: str | None = None
    verdict_reason: str | None = None
    contraction: float | None = None
    """Distance of twins under its loss sequence at the end, as a multiple of that at the beginning; see `twins`."""
    unstable: bool | None = None
    """Did its twins not come closer to each other, did it diverge, or does its loop not settle even without losses?"""


def judge(name: str, steps: int, failure: str, bag: Path) -> Vehicle:
    """A vehicle as its recording shows it, with the words of `analyse`; unstable is what the sweeps call so."""
    try:
        found = analyse(read_run(bag))
    except UserError as error:
        return Vehicle(name, steps, "; ".join(filter(None, (failure, str(error)))), str(bag))
    figures, contraction = found.to_json(), twins(found.run)
    return Vehicle(
        vehicle=name,
        steps=steps,
        failure=failure,
        bag=str(bag),
        loss_rate=figures["loss_rate"],
        longest_outage=found.outages.uplink.longest,
        settle_1cm_steps=figures["settle_1cm_steps"],
        final_error=figures["final_error"],
        deviation=figures["deviation"],
        speed=figures["speed"],
        **_corridor(found),
        verdict=figures["verdict"],
        verdict_criterion=figures["verdict_criterion"],
        verdict_reason=figures["verdict_reason"],
        contraction=contraction if contraction is not None and math.isfinite(contraction) else None,
        unstable=_is_unstable(found.run, contraction),
    )


def _corridor(found: Analysis) -> dict[str, Any]:
    """What the recording shows of its corridor, if it has one."""
    widths, first = widths_of(found.run.scenario.error_detector), found.convergence.initial
    if widths is None:
        return {}
    settled = 0 if first.has_nothing_to_settle else first.settle_1cm_steps
    seen = recorded_outages(found.run, widths, None, settled)
    return {
        "corridor_share": seen.largest if math.isfinite(seen.largest) else None,
        "outages_outside": seen.left,
        "p_outage_at_most": seen.at_most,
    }


def _is_unstable(run: Run, contraction: float | None) -> bool | None:
    """As a sweep counts it; None where that is not known, or the run is too short to say."""
    if not settles_without_losses(run.scenario):
        return True
    if contraction is None:
        return None
    plant = replace(run.scenario.plant, duration=len(run) * run.ts)
    return is_unstable(contraction, left_without_losses(replace(run.scenario, plant=plant)))


def twins(run: Run) -> float | None:
    """Distance in (x, y, theta) of two AGVs at the end of a run, as a multiple of that at its beginning.

    They are simulated, begin a micrometre apart and meet the losses of the run; inf if one diverges. None if the losses
    depend on the place, or are not those that the run's parameters give.
    """
    one, other = _simulated(run, 0.0), _simulated(run, TWIN_OFFSET)
    if min(len(one), len(other)) < len(run):
        return math.inf
    if not (_same_losses(one, run) and _same_losses(one, other)):
        return None
    apart = distances(one, other)
    return float(apart[-1] / apart[0])


def _simulated(run: Run, offset: float) -> Run:
    """The steps of a run, by simulation, with an AGV that begins elsewhere."""
    plant = run.scenario.plant
    x, y, theta = plant.initial_pose
    begun = x + offset, y + offset, theta + offset
    return simulate(replace(run.scenario, plant=replace(plant, initial_pose=begun, duration=len(run) * run.ts)))


def _same_losses(one: Run, other: Run) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ("lost", "downlink_lost"))


@dataclass(frozen=True)
class Instability:
    """How many of the vehicles that could be judged were unstable."""

    unstable: int
    judged: int
    low: float
    """The interval that holds the probability of it with `confidence`, as if vehicles were independent."""
    high: float
    confidence: float = CONFIDENCE

    @property
    def fraction(self) -> float:
        """Of the judged vehicles, NaN without any."""
        return self.unstable / self.judged if self.judged else math.nan


def instability(fleet: Sequence[Vehicle]) -> Instability:
    """The share of unstable vehicles with its confidence interval."""
    judged = [vehicle.unstable for vehicle in fleet if vehicle.unstable is not None]
    hits = sum(judged)
    return Instability(hits, len(judged), *(clopper_pearson(hits, len(judged)) if judged else (0.0, 1.0)))


def to_json(fleet: Sequence[Vehicle]) -> dict[str, Any]:
    """All vehicles, and how many of them were unstable, as plain values."""
    found = instability(fleet)
    share = found.fraction if found.judged else None
    return {"vehicles": [asdict(vehicle) for vehicle in fleet], **asdict(found), "fraction": share}
