"""One run of a scenario, with its full history."""

from __future__ import annotations

import math

import numpy as np

from agv_analysis.compiled.functions import numbers
from agv_analysis.run import Floats, Run
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.link_loop import history_over_links
from agv_analysis.simulation.loop import Loop, Rows, RunInputs, Settings, at_rest, history
from agv_analysis.simulation.noise import measurements, normals
from agv_analysis.simulation.parts import replacements_of, run_parts
from agv_analysis.simulation.reference import reference_of
from agv_analysis.simulation.simulated_link import SimulatedLink
from agv_cloud.control.registry import CONTROL_LAWS
from agv_cloud.staleness.estimate import is_stepwise
from agv_cloud.staleness.registry import number_of
from agv_plant.downlink_policy import DOWNLINK_POLICIES
from agv_plant.parameters import PlantParameters
from agv_plant.vehicle.motion import NOISE, SLIP, vehicle_parameters
from agv_plant.vehicle.registry import UNICYCLE, VEHICLES
from agv_ros.counted import counted
from agv_ros.errors import UserError
from agv_ros.parts import PartError
from agv_ros.pose import Pose
from agv_ros.substitution import Replacements

_PAPERS_VEHICLE = vehicle_parameters(PlantParameters())


MOST_STEPS = 20_000_000
"""Steps of a run that is kept in memory, 300 bytes each: 28 hours at 5 ms."""


def simulate(scenario: Scenario) -> Run:
    """The run of a scenario in lockstep, as a recording of the nodes would give it.

    Raises UserError if the run has no end, TrackFileError for a bad track file, PartError if a control law, a vehicle
    or a policy raises or returns NaN. A loop that diverges ends there, and its run says so in its notes.
    """
    steps, relay, plant = steps_of(scenario), scenario.relay, scenario.plant
    if steps > MOST_STEPS:
        raise UserError(
            f"plant.duration / plant.ts is {steps:.6g} steps, and a run of more than {MOST_STEPS} does not go into "
            "memory: shorten plant.duration"
        )
    reference = reference_of(scenario.error_detector, steps + scenario.controller.steps_ahead).copy()
    up, down = (
        SimulatedLink(channel, relay.seed, name, steps, plant.ts)
        for name, channel in (("uplink", relay.uplink), ("downlink", relay.downlink))
    )
    settings = settings_of(scenario)
    noise = numbers(normals(plant.seed, NOISE, steps)) if plant.is_noisy else None
    slip = numbers(normals(plant.seed, SLIP, steps)) if plant.slip_noise > 0.0 else None
    lost = numbers(up.lost), numbers(down.lost)
    inputs = RunInputs(*lost, start_of(scenario), settings, noise, slip)
    rows, done = _drive(numbers(reference), inputs, up, down, replacements_of(scenario))
    pose, k = rows[:done, 0:3], np.arange(done)
    return Run(
        scenario=scenario,
        k=k,
        pose=pose,
        measured=measurements(pose, noise, plant.noise_xy, plant.noise_theta) if noise is not None else None,
        reference=reference[:done],
        error=rows[:done, 3:6],
        command=rows[:done, 6:8],
        n_ul=k - up.trace.held[:done],
        lost=up.trace.lost[:done],
        downlink_lost=down.trace.lost[:done],
        n_dl=k - down.trace.held[:done],
        uplink=up.slots(done),
        downlink=down.slots(done),
        notes=tuple(_notes(scenario, done, steps, rows[:done, 6:8])),
    )


def _drive(
    reference: Rows, inputs: RunInputs, up: SimulatedLink, down: SimulatedLink, parts: Replacements
) -> tuple[Floats, int]:
    """X_c, eps and u of a run's slots, shape (N, 8), and the slots until it ended; fills the traces of the links.

    Where a message that is not lost arrives in its own slot, outcomes computed in advance replace the radio.
    """
    rows = np.full((len(inputs.lost), 8), math.nan)
    try:
        if up.is_direct and down.is_direct:
            n_ul = np.empty(len(rows), dtype=np.int64)
            return rows, run_parts(history, parts, reference, inputs, rows, n_ul)
        links = up.link_inputs, down.link_inputs, up.trace, down.trace
        return rows, run_parts(history_over_links, parts, reference, inputs, *links, rows)
    except PartError as error:  # a slot's pose is in its row before its parts are called
        raise PartError(f"{error}, at step {np.count_nonzero(np.isfinite(rows[:, 0])) - 1}") from error


def start_of(scenario: Scenario, offset: float = 0.0, at: Pose | None = None) -> Loop:
    """The loop of a scenario before slot 0, its AGV `offset` [m, m, rad] away from its initial pose, or from `at`."""
    x, y, theta = (value + offset for value in (scenario.plant.initial_pose if at is None else at))
    vehicle, law = VEHICLES.find(scenario.plant.vehicle), CONTROL_LAWS.find(scenario.controller.law)
    return at_rest(x, y, theta, (0.0,) * len(vehicle.states), law.memory)


def steps_of(scenario: Scenario) -> int:
    """Number of steps of a scenario's run. Raises UserError if it has no end."""
    plant = scenario.plant
    if math.isinf(plant.duration):
        raise UserError(
            "plant.duration is inf, but a simulation needs an end: set it, as in --set plant.duration=100.0"
        )
    return max(1, round(plant.duration / plant.ts))


def obeys_at_once(plant: PlantParameters) -> bool:
    """Is the AGV a unicycle that follows each command exactly, as the paper's does?"""
    vehicle = vehicle_parameters(plant)
    usual = vehicle._replace(arc=_PAPERS_VEHICLE.arc, ts=_PAPERS_VEHICLE.ts)
    return plant.vehicle == UNICYCLE and usual == _PAPERS_VEHICLE


def settings_of(scenario: Scenario) -> Settings:
    """What a slot of the loop needs to know of a scenario."""
    controller, plant, edge = scenario.controller, scenario.plant, scenario.error_detector
    policy = number_of(edge.policy)
    return Settings(
        gains=controller.gains, v_max=controller.v_max, ts=plant.ts,
        look_ahead=controller.look_ahead, ahead=controller.steps_ahead or None,
        arc=plant.integration == "arc",
        policy=policy, policy_parameters=edge.policy_values, is_stepwise=is_stepwise(policy),
        model_arc=edge.integration == "arc",
        downlink_policy=DOWNLINK_POLICIES.index(plant.downlink_policy),
        policy_steps=plant.policy_steps,
        plan_arc=controller.integration == "arc" if plant.downlink_policy == "buffer" else None,
        vehicle=None if obeys_at_once(plant) and plant.downlink_policy == "hold" else vehicle_parameters(plant),
        noise_xy=plant.noise_xy, noise_theta=plant.noise_theta,
    )  # fmt: skip


def _notes(scenario: Scenario, done: int, steps: int, command: Floats) -> list[str]:
    notes = []
    refused = np.flatnonzero(np.isinf(command).any(axis=1))
    if len(refused):
        notes.append(
            f"{counted(len(refused), 'command was', 'commands were')} not finite and were refused, the first at "
            f"step {refused[0]}"
        )
    if done < steps:
        notes.append(f"the loop diverged: after step {done - 1} of {steps} the AGV's pose is no longer finite")
    if scenario.plant.clock != "lockstep":
        notes.append(
            f"plant.clock is {scenario.plant.clock}, but a simulation runs in lockstep: no jitter, no time-out"
        )
    return notes
