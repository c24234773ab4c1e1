"""One run of a scenario, with its full history."""

from __future__ import annotations

import math

import numpy as np

from agv_analysis.compiled import compiled, numbers
from agv_analysis.run import Floats, Run
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.link_loop import history_over_links
from agv_analysis.simulation.loop import Rows, RunInputs, Settings, at_rest, history
from agv_analysis.simulation.noise import measurements, normals
from agv_analysis.simulation.reference import reference_of
from agv_analysis.simulation.simulated_link import SimulatedLink
from agv_cloud.staleness import POLICIES
from agv_plant.downlink_policy import DOWNLINK_POLICIES
from agv_plant.parameters import PlantParameters
from agv_plant.vehicle.motion import NOISE, SLIP, body_of
from agv_ros.errors import UserError

_PAPERS_BODY = body_of(PlantParameters())


def simulate(scenario: Scenario) -> Run:
    """The run of a scenario in lockstep, as a recording of the nodes would give it.

    Raises UserError if the run has no end, TrackFileError for a bad track file. A loop that leaves the range of numbers
    ends there, and its run says so in its notes.
    """
    steps, relay, plant = steps_of(scenario), scenario.relay, scenario.plant
    reference = reference_of(scenario.error_detector, steps).copy()
    up, down = (
        SimulatedLink(channel, relay.seed, name, steps, plant.ts)
        for name, channel in (("uplink", relay.uplink), ("downlink", relay.downlink))
    )
    settings = settings_of(scenario)
    noise = numbers(normals(plant.seed, NOISE, steps)) if plant.is_noisy else None
    slip = numbers(normals(plant.seed, SLIP, steps)) if plant.slip_noise > 0.0 else None
    start, lost = at_rest(*plant.initial_pose), (numbers(up.lost), numbers(down.lost))
    rows, done = _drive(numbers(reference), RunInputs(*lost, start, settings, noise, slip), up, down)
    pose, k = rows[:done, 0:3], np.arange(done)
    return Run(
        scenario=scenario,
        k=k,
        pose=pose,
        measured=measurements(pose, noise, plant.noise_xy, plant.noise_theta) if noise is not None else None,
        reference=reference[:done],
        error=rows[:done, 3:6],
        command=rows[:done, 6:8],
        n_ul=k - up.marks.held[:done],
        lost=up.marks.lost[:done],
        downlink_lost=down.marks.lost[:done],
        n_dl=k - down.marks.held[:done],
        uplink=up.slots(done),
        downlink=down.slots(done),
        notes=tuple(_notes(scenario, done, steps, rows[:done, 6:8])),
    )


def _drive(reference: Rows, case: RunInputs, up: SimulatedLink, down: SimulatedLink) -> tuple[Floats, int]:
    """X_c, eps and u of a run's slots, shape (N, 8), and the number of slots until it ended; the links get their marks.

    Where a message that is not lost is there at once, verdicts known beforehand are all that is needed of the radio.
    """
    rows = np.empty((len(reference), 8))
    if up.is_direct and down.is_direct:
        return rows, compiled(history)(reference, case, rows, np.empty(len(rows), dtype=np.int64))
    return rows, compiled(history_over_links)(reference, case, up.way, down.way, up.marks, down.marks, rows)


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
    body = body_of(plant)
    is_paper = (
        plant.downlink_policy == "hold" and body._replace(arc=_PAPERS_BODY.arc, ts=_PAPERS_BODY.ts) == _PAPERS_BODY
    )
    return Settings(
        kx=gains.kx, ky=gains.ky, ktheta=gains.ktheta, v_max=gains.v_max, ts=plant.ts,
        arc=plant.integration == "arc",
        policy=POLICIES.index(edge.policy),
        model_arc=edge.integration == "arc",
        downlink_policy=DOWNLINK_POLICIES.index(plant.downlink_policy),
        policy_steps=plant.policy_steps,
        plan_arc=gains.integration == "arc" if plant.downlink_policy == "buffer" else None,
        body=None if is_paper else body,
        noise_xy=plant.noise_xy, noise_theta=plant.noise_theta,
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
