"""One run of a scenario, with its full history."""

from __future__ import annotations

import functools
import math
from pathlib import Path

import numpy as np

from agv_analysis.compiled import compiled, numbers
from agv_analysis.run import Floats, Run
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.loop import Case, Settings, at_rest, history
from agv_cloud.parameters import ErrorDetectorParameters
from agv_cloud.reference import Reference
from agv_cloud.staleness import POLICIES
from agv_plant.downlink_policy import DOWNLINK_POLICIES
from agv_plant.parameters import PlantParameters
from agv_plant.radio import losses
from agv_ros.errors import UserError

_PAPERS_PLANT = {
    name: getattr(PlantParameters(), name) for name in ("downlink_policy", "speed_scale", "w_max", "a_max", "lag")
}


def simulate(scenario: Scenario) -> Run:
    """The run of a scenario in lockstep, as a recording of the nodes would give it.

    Raises UserError if the run has no end, TrackFileError for a bad track file. A loop that leaves the range of numbers
    ends there, and its run says so in its notes.
    """
    steps, relay = steps_of(scenario), scenario.relay
    reference = reference_of(scenario.error_detector, steps).copy()
    lost = losses(relay.uplink, relay.seed, "uplink", steps)
    downlink_lost = losses(relay.downlink, relay.seed, "downlink", steps)
    rows, n_ul = np.empty((steps, 8)), np.empty(steps, dtype=np.int64)
    start, settings = at_rest(*scenario.plant.initial_pose), settings_of(scenario)
    done = compiled(history)(
        numbers(reference), Case(numbers(lost), numbers(downlink_lost), start, settings), rows, n_ul
    )
    return Run(
        scenario=scenario,
        k=np.arange(done),
        pose=rows[:done, 0:3],
        reference=reference[:done],
        error=rows[:done, 3:6],
        command=rows[:done, 6:8],
        n_ul=n_ul[:done],
        lost=lost[:done],
        downlink_lost=downlink_lost[:done],
        notes=tuple(_notes(scenario, done, steps, rows[:done, 6:8])),
    )


def reference_of(detector: ErrorDetectorParameters, steps: int) -> Floats:
    """A reference track's first steps, shape (steps, 5); kept, since many runs ask for the same. Not to be written to.

    Raises TrackFileError for a bad track file.
    """
    return _reference(detector, steps, _edition(detector.track_file))


@functools.lru_cache(maxsize=8)
def _reference(detector: ErrorDetectorParameters, steps: int, edition: object) -> Floats:
    return Reference(detector).first(steps)


def _edition(path: str) -> object:
    """What changes when a file does; None if there is no such file."""
    try:
        found = Path(path).stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


def steps_of(scenario: Scenario) -> int:
    """Number of steps of a scenario's run. Raises UserError if it has no end."""
    plant = scenario.plant
    if math.isinf(plant.duration):
        raise UserError(
            "plant.duration is inf, but a simulation needs an end: set it, as in --set plant.duration=100.0"
        )
    return max(1, round(plant.duration / plant.ts))


def settings_of(scenario: Scenario) -> Settings:
    """What a slot of the loop needs to know of a scenario."""
    gains, plant, edge = scenario.controller, scenario.plant, scenario.error_detector
    return Settings(
        kx=gains.kx, ky=gains.ky, ktheta=gains.ktheta, v_max=gains.v_max, ts=plant.ts,
        arc=plant.integration == "arc",
        policy=POLICIES.index(edge.policy),
        model_arc=edge.integration == "arc",
        plain=all(getattr(plant, name) == value for name, value in _PAPERS_PLANT.items()),
        downlink_policy=DOWNLINK_POLICIES.index(plant.downlink_policy),
        ramp_steps=plant.ramp_time / plant.ts,
        speed_scale=plant.speed_scale, w_max=plant.w_max, a_max=plant.a_max, lag=plant.lag,
    )  # fmt: skip


def _notes(scenario: Scenario, done: int, steps: int, command: Floats) -> list[str]:
    notes = []
    refused = np.flatnonzero(np.isinf(command).any(axis=1))
    if len(refused):
        notes.append(
            f"{len(refused)} commands were beyond the range of numbers and refused, the first at step {refused[0]}"
        )
    if done < steps:
        notes.append(f"the loop diverged: after step {done - 1} of {steps} the AGV left the range of numbers")
    if scenario.plant.clock != "lockstep":
        notes.append(
            f"plant.clock is {scenario.plant.clock}, but a simulation runs in lockstep: no jitter, no time-out"
        )
    return notes
