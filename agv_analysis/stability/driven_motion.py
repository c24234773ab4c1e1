"""How a displacement of a whole run grows about the motion that was driven, which may be far from the reference.

The pose of the next step is differentiated by the pose of now and by the pose that the edge held, in the frame of the
map, with the very functions that the nodes call.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats, Run
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.loop import Settings, period
from agv_analysis.simulation.parts import replacements_of
from agv_analysis.simulation.single import settings_of
from agv_analysis.stability.derivatives import jacobian
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.products import growths
from agv_analysis.stability.reception_maps import reception_maps
from agv_cloud.control.command import command
from agv_cloud.control.registry import CONTROL_LAWS
from agv_cloud.tracking_error import tracking_error
from agv_plant.vehicle.motion import Motion
from agv_plant.vehicle.registry import VEHICLES
from agv_ros.substitution import replaced


def applies_to(scenario: Scenario) -> bool:
    """Does the next pose depend on the pose of now and on the one that is held alone?

    Not where the edge predicts, which takes all commands since the pose, nor where drive, vehicle or law remember.
    """
    plant = scenario.plant
    remembers = plant.lag > 0.0 or not np.isinf(plant.a_max) or not np.isinf(plant.j_max)
    parts = VEHICLES.find(plant.vehicle).states or CONTROL_LAWS.find(scenario.controller.law).memory
    return scenario.error_detector.policy in ("hold", "align") and not remembers and not parts


def growth(run: Run, first: int) -> float | None:
    """Largest growth (logarithm) of a displacement [m, m, rad] from step `first`, a reception, to the end of a run.

    None where `applies_to` says so.
    """
    if not applies_to(run.scenario):
        return None
    found = displacement_growths(run.scenario, run.pose[first:], run.reference[first:], run.lost[first:], 1)
    return float(found[0])


def displacement_growths(
    scenario: Scenario, pose: Floats, reference: Floats, lost: NDArray[np.bool_], count: int | None = None
) -> Floats:
    """Growths (logarithms) of displacements of a whole run, largest first, shape (3,), or only the largest.

    X_c(k) of shape (N, 3), X_r(k) and its speeds of shape (N, 5), frame `map`; `lost` of shape (N,) says which updates
    were lost, the first was received.
    """
    steps = np.arange(len(lost))
    age = steps - np.maximum.accumulate(np.where(lost, 0, steps))
    seen = reference[np.minimum(steps + scenario.controller.steps_ahead, len(steps) - 1)]
    target = seen[steps - age, :3] if scenario.error_detector.policy == "align" else seen[:, :3]
    now, held = pose_derivatives(scenario, pose, pose[steps - age], target, seen[:, 3:])
    nothing = np.zeros((len(lost), 3, 2))
    loop = LinearLoop(
        scenario.plant.ts, reference[:, 3], reference[:, 4], A=now, B=nothing, D=held, L_h=nothing.swapaxes(1, 2),
        L_z=nothing.swapaxes(1, 2),
    )  # fmt: skip
    return growths(reception_maps(loop, np.flatnonzero(age == 0), len(lost)), count)


def next_pose(
    x: float, y: float, theta: float, x_held: float, y_held: float, theta_held: float, x_r: float, y_r: float,
    theta_r: float, v_r: float, w_r: float, settings: Settings,
) -> tuple[float, float, float]:  # fmt: skip
    """X_c(k+1) from X_c(k), the pose that the edge holds, and the pose and speeds of the reference."""
    x_e, y_e, theta_e = tracking_error(x_r, y_r, theta_r, x_held, y_held, theta_held)
    v, w, _ = command(x_e, y_e, theta_e, v_r, w_r, (), settings.gains, settings.ts, settings.look_ahead, settings.v_max)
    moved = period(Motion(x, y, theta), v, w, 0, 0.0, 0.0, settings.vehicle, settings)
    return moved.x, moved.y, moved.theta


def pose_derivatives(
    scenario: Scenario, pose: Floats, held: Floats, target: Floats, speeds: Floats
) -> tuple[Floats, Floats]:
    """Derivatives of X_c(k+1) by X_c(k) and by the pose that is held; each of shape (N, 3, 3).

    Poses of shape (N, 3) in frame `map`, speeds v_r [m/s], w_r [rad/s] of shape (N, 2). Where a limit is active the
    command does not answer to the error.
    """
    columns = [np.ascontiguousarray(column) for rows in (pose, held, target, speeds) for column in rows.T]
    found = jacobian(
        replaced(next_pose, replacements_of(scenario)), [*columns, settings_of(scenario)], range(6)
    ).derivative  # fmt: skip
    return np.ascontiguousarray(found[:, :, :3]), np.ascontiguousarray(found[:, :, 3:])
