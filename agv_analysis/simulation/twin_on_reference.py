"""The twin of a run: the same AGV, begun on the reference, under the same losses, ages, noise and slip."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from agv_analysis.compiled.functions import numbers
from agv_analysis.metrics.outages import Outcomes, Steps, ages
from agv_analysis.run import Floats, Run
from agv_analysis.simulation.link_loop import empty_trace, history_over_links, link_that_holds
from agv_analysis.simulation.loop import Loop, RunInputs, history
from agv_analysis.simulation.noise import normals
from agv_analysis.simulation.parts import replacements_of, run_parts
from agv_analysis.simulation.reference import reference_of
from agv_analysis.simulation.single import settings_of, start_of
from agv_plant.vehicle.motion import NOISE, SLIP
from agv_ros.errors import UserError
from agv_ros.pose import Pose

REPRODUCED = 1e-6
"""Largest difference [m, rad] between a run and its simulation, for each metre that it is away from the origin."""


class Twin(NamedTuple):
    """What the twin did at the steps of the run; NaN after it has diverged."""

    pose: Floats
    """Shape (N, 3)."""
    speed: Floats
    """The commanded one [m/s], shape (N,)."""


def twin_on_reference(run: Run) -> Twin | str:
    """The twin of a run, or why there is none: only what the simulation reproduces has one."""
    if not run.gains_known:
        return "the controller's gains are not known"
    if run.k[0] != 0:
        return "the recording begins after the run did"
    if len(run) != int(run.k[-1]) + 1:
        return "steps are missing from the recording"
    try:
        again = _driven(run, start_of(run.scenario))[0]
        apart = np.abs(again - run.pose).max()
        if not apart <= REPRODUCED * (1.0 + np.abs(run.pose).max()):
            return f"the run is not what its parameters give in the simulation: {apart:.2g} m or rad apart"
        return Twin(*_driven(run, start_of(run.scenario, at=Pose(*run.reference[0, :3].tolist()))))
    except UserError as error:
        return str(error)


def poses_without_losses(run: Run) -> Floats:
    """Where the AGV of a run that has a twin is, from the same start, if each message arrives in its slot; (N, 3)."""
    fresh, received = np.zeros_like(run.n_ul), np.zeros_like(run.lost)
    lossless = replace(run, lost=received, downlink_lost=received, n_ul=fresh, n_dl=fresh)
    return _driven(lossless, start_of(run.scenario))[0]


def _driven(run: Run, start: Loop) -> tuple[Floats, Floats]:
    """Poses, shape (N, 3), and commanded speeds, shape (N,), of the run's loop from another start."""
    scenario, steps = run.scenario, len(run)
    noise = numbers(normals(scenario.plant.seed, NOISE, steps)) if scenario.plant.is_noisy else None
    slip = numbers(normals(scenario.plant.seed, SLIP, steps)) if scenario.plant.slip_noise > 0.0 else None
    lost, downlink_lost = np.array(run.lost), np.array(run.downlink_lost)
    inputs = RunInputs(numbers(lost), numbers(downlink_lost), start, settings_of(scenario), noise, slip)
    n_dl = ages(run.k, run.downlink_lost) if run.n_dl is None else run.n_dl
    rows, reference, parts = np.full((steps, 8), math.nan), numbers(_reference(run)), replacements_of(scenario)
    if _is_direct(run.k, lost, run.n_ul) and _is_direct(run.k, downlink_lost, n_dl):
        run_parts(history, parts, reference, inputs, rows, np.empty(steps, dtype=np.int64))
    else:
        links = (link_that_holds(np.maximum(run.k - age, 0)) for age in (run.n_ul, n_dl))
        run_parts(
            history_over_links, parts, reference, inputs, *links, empty_trace(steps), empty_trace(steps), rows
        )  # fmt: skip
    return rows[:, :3], rows[:, 6]


def _is_direct(k: Steps, lost: Outcomes, age: Steps) -> bool:
    """Did each message that was not lost arrive in its own slot?"""
    return not lost[0] and bool(np.array_equal(age, ages(k, lost)))


def _reference(run: Run) -> Floats:
    """The run's reference, as far as its edge looked ahead. Raises UserError if that was not recorded."""
    ahead, steps = run.scenario.controller.steps_ahead, len(run)
    if not ahead:
        return np.ascontiguousarray(run.reference, dtype=np.float64)
    track: Floats = reference_of(run.scenario.error_detector, steps + ahead)
    if not np.allclose(track[:steps], run.reference, rtol=0.0, atol=REPRODUCED):
        raise UserError("the reference that the edge looked ahead to is not recorded")
    return np.array(track)
