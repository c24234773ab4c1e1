"""From a scenario to its linear loop: the derivatives of the functions that the nodes call, about the nominal motion.

The policy's model. After a reception the edge takes the pose h for the AGV's, by its error to the target; a step
without reception takes both on. Derived is what becomes of a small displacement of the pose that is held, seen from the
target, where the error itself is that of the nominal motion. So the bias of `hold`, which compares an outdated pose
with the reference of now, is left out: it displaces the motion, it does not change how errors grow, but for the change
of the reference's speeds over the outage.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.single import obeys_at_once
from agv_analysis.stability.derivatives import jacobian
from agv_analysis.stability.error_dynamics import (
    ERRORS,
    LoopModel,
    StepDerivatives,
    derivatives_of_part,
    model_of,
    nominal_motion,
)
from agv_analysis.stability.linear_loop import LinearLoop, kanayama_loop
from agv_analysis.stability.linearisation import command_matrices, plant_matrices
from agv_cloud.control.registry import CONTROL_LAWS, KANAYAMA
from agv_cloud.reference.point import ReferencePoint
from agv_cloud.staleness.estimate import staleness_policy
from agv_cloud.tracking_error import tracking_error
from agv_plant.vehicle.registry import VEHICLES
from agv_plant.vehicle.unicycle import euler_step
from agv_ros.parameters import ParameterError
from agv_ros.pose import Pose
from agv_ros.substitution import replaced

_ROUNDING = 1e-13


def linear_loop(scenario: Scenario, v_r: Floats, w_r: Floats) -> LinearLoop:
    """The loop of a scenario to first order over a lap with the speeds v_r [m/s], w_r [rad/s], shape (N,) each.

    A law that looks ahead is given the speeds of where it looks. Raises NoNominalMotionError where the loop does not
    settle even without losses: it has no motion about which an error could be small.
    """
    if has_closed_form(scenario, v_r, w_r):
        return kanayama_loop(
            v_r, w_r, scenario.controller, scenario.plant.ts, predicts=scenario.error_detector.policy == "predict"
        )
    return derived_loop(scenario, v_r, w_r)


def derived_loop(scenario: Scenario, v_r: Floats, w_r: Floats) -> LinearLoop:
    """As `linear_loop`, by derivatives even where a closed form is known."""
    constant = np.ptp(v_r) == 0.0 and np.ptp(w_r) == 0.0
    v, w = (v_r[:1], w_r[:1]) if constant else (v_r, w_r)
    model = model_of(scenario)
    rows = nominal_motion(model, v, w)
    found = model.derivatives(rows, v, w)
    return _assembled(scenario, model, rows, found, v_r, w_r)


def has_closed_form(scenario: Scenario, v_r: Floats, w_r: Floats) -> bool:
    """Is the nominal motion zero error, with Kanayama's law on a unicycle by Euler's step that obeys at once?

    Then the matrices have a closed form, here at the speeds v_r [m/s], w_r [rad/s], shape (N,) each. The functions that
    the nodes call may have been edited: where they are fastest, slowest and turn most, their derivatives must agree.
    """
    plant, edge = scenario.plant, scenario.error_detector
    if not (
        scenario.controller.law == KANAYAMA
        and obeys_at_once(plant)
        and plant.integration == "euler"
        and scenario.controller.steps_ahead == 0
        and (edge.policy in ("hold", "align") or (edge.policy == "predict" and edge.integration == "euler"))
        and float(np.abs(v_r).max()) < scenario.controller.v_max
    ):
        return False
    steps = np.unique([np.abs(v_r).argmax(), np.abs(v_r).argmin(), np.abs(w_r).argmax()])
    return _agrees_with_closed_form(scenario, v_r[steps], w_r[steps])


def _agrees_with_closed_form(scenario: Scenario, v: Floats, w: Floats) -> bool:
    """Is zero error kept at the speeds v [m/s], w [rad/s], shape (N,), and are the derivatives those of the theory?"""
    model = model_of(scenario)
    rows = np.repeat(model.start(v, w)[None], len(v), axis=0)
    found = model.derivatives(rows, v, w)
    A, B = plant_matrices(v, w, scenario.plant.ts)
    derived = [
        (found.plant_of_state[:, :ERRORS, :ERRORS], A),
        (found.plant_of_command[:, :ERRORS], B),
        (found.following[:, :ERRORS], np.zeros((len(v), ERRORS))),
        (found.plant_of_state[:, :ERRORS, ERRORS:], np.zeros((len(v), ERRORS, model.size - ERRORS))),
    ]
    if not _commands_as_kanayama(found, scenario, v, w):
        return False
    policy = _policy_derivatives(scenario, model, rows, found.command, v, w)
    if (policy is not None) != (scenario.error_detector.policy == "predict"):
        return False
    if policy is not None:
        derived += [(policy[0], A), (policy[1], B)]
    return all(_is_close(one, other) for one, other in derived)


def _is_close(one: Floats, other: Floats) -> bool:
    return bool(np.allclose(one, other, rtol=1e-9, atol=1e-9))


def _commands_as_kanayama(found: StepDerivatives, scenario: Scenario, v: Floats, w: Floats) -> bool:
    """Are the commands at zero error those of the reference, shape (N,), and their derivatives those of the theory?"""
    L_h = command_matrices(v, scenario.controller)
    return _is_close(found.command, np.column_stack((v, w))) and _is_close(found.command_of_error, L_h)


def is_kanayamas_law(scenario: Scenario) -> bool:
    """Does the control law answer a small error as Kanayama's does, by its name and by its derivatives?"""
    if scenario.controller.law != KANAYAMA:
        return False
    model, v = model_of(scenario), np.array([min(1.0, 0.5 * scenario.controller.v_max)])
    return _commands_as_kanayama(model.derivatives(model.start(v, v)[None], v, v), scenario, v, v)


def _assembled(
    scenario: Scenario, model: LoopModel, rows: Floats, found: StepDerivatives, v_r: Floats, w_r: Floats
) -> LinearLoop:
    plant, memory = found.plant_of_state.shape[1], len(model.memory)
    size, points = plant + memory, len(rows)
    A, B = np.zeros((points, size, size)), np.zeros((points, size, 2))
    D, L_z = np.zeros((points, size, ERRORS)), np.zeros((points, 2, size))
    A[:, :plant, :plant], B[:, :plant] = found.plant_of_state, found.plant_of_command
    A[:, plant:, plant:], D[:, plant:] = found.memory_of_memory, found.memory_of_error
    L_z[:, :, plant:] = found.command_of_memory
    P = _policy_derivatives(scenario, model, rows, found.command, v_r[:points], w_r[:points])
    keep = _that_matters(A, B, D, L_z, v_r, w_r)
    q = int(np.count_nonzero(keep < ERRORS))
    some = np.ix_(np.arange(points), keep, keep)
    return LinearLoop(
        ts=scenario.plant.ts, v_r=v_r, w_r=w_r, A=np.ascontiguousarray(A[some]), B=np.ascontiguousarray(B[:, keep]),
        D=np.ascontiguousarray(D[:, keep, :q]), L_h=np.ascontiguousarray(found.command_of_error[:, :, :q]),
        L_z=np.ascontiguousarray(L_z[:, :, keep]),
        P_h=None if P is None else np.ascontiguousarray(P[0][:, :q, :q]),
        P_u=None if P is None else np.ascontiguousarray(P[1][:, :q]),
        nominal=rows, active_limits=tuple(_active_limits(scenario, rows, v_r[:points], w_r[:points])),
        not_differentiable=found.not_differentiable,
    )  # fmt: skip


def _that_matters(A: Floats, B: Floats, D: Floats, L_z: Floats, v_r: Floats, w_r: Floats) -> NDArray[np.int64]:
    """States that have to do with the error: those that the commands reach and that act on it, directly or not.

    A parked AGV cannot move sideways or turn towards the track: what the commands cannot reach is left out.
    """
    size = A.shape[-1]
    links = np.abs(A).max(axis=0) > 0.0
    acts = np.zeros(size, dtype=bool)
    acts[:ERRORS] = True
    acts |= np.abs(L_z).max(axis=(0, 1)) > 0.0
    for _ in range(size):
        acts |= links[acts].any(axis=0)
    reached = (np.abs(B).max(axis=(0, 2)) > _ROUNDING) | (np.abs(D).max(axis=(0, 2)) > 0.0)
    for _ in range(size):
        reached |= links[:, reached].any(axis=1)
    if np.any(v_r != 0.0):
        reached[:ERRORS] = True
    else:
        reached[1:ERRORS] = False
        reached[1] = bool(np.any(w_r != 0.0))
    return np.flatnonzero(acts & reached)


# -- the policy's model of the plant ---------------------------------------------------------------------------------


def policy_step(
    dx: float, dy: float, dtheta: float, v: float, w: float, x_e: float, y_e: float, theta_e: float, v_r: float,
    w_r: float, v_next: float, w_next: float, number: int, ts: float, arc: bool, parameters: tuple[float, ...],
) -> tuple[float, float, float]:  # fmt: skip
    """Where the pose that the edge holds, displaced by (dx, dy, dtheta), is a step later without a reception.

    Frame: the pose that is held, undisplaced; the target is at (x_e, y_e, theta_e), and so is the reference.
    """
    x, y, theta = euler_step(x_e, y_e, theta_e, v_r, w_r, ts)
    held, _ = staleness_policy(
        number, Pose(dx, dy, dtheta), Pose(x_e, y_e, theta_e), ReferencePoint(x, y, theta, v_next, w_next), v, w, ts,
        arc, parameters,
    )  # fmt: skip
    return held.x, held.y, held.theta


def _policy_derivatives(
    scenario: Scenario, model: LoopModel, rows: Floats, command: Floats, v_r: Floats, w_r: Floats
) -> tuple[Floats, Floats] | None:
    """P_h, shape (N, 3, 3), and P_u, shape (N, 3, 2); None for a policy that keeps its pose."""
    s = model.settings
    if not s.is_stepwise:
        return None
    error = [np.ascontiguousarray(column) for column in rows[:, :ERRORS].T]
    later = [np.roll(column, -1) for column in error]
    zero = np.zeros(len(rows))
    moved = derivatives_of_part(
        f"staleness policy {scenario.error_detector.policy}",
        replaced(policy_step, model.parts),
        [zero, zero, zero, command[:, 0], command[:, 1], *error, v_r, w_r, np.roll(v_r, -1), np.roll(w_r, -1),
         s.policy, s.ts, s.model_arc, s.policy_parameters],
        range(5),
    )  # fmt: skip
    before = jacobian(tracking_error, [*error, zero, zero, zero], [3, 4, 5]).derivative
    held = list(np.ascontiguousarray(moved.value.T))
    target = _placed(held, later)
    after = jacobian(tracking_error, [*target, *held], [3, 4, 5]).derivative @ moved.derivative
    P_h, P_u = after[:, :, :3] @ np.linalg.inv(before), after[:, :, 3:]
    if np.abs(P_u).max() == 0.0 and np.abs(P_h - np.eye(3)).max() <= _ROUNDING:
        return None
    return P_h, P_u


def _placed(frame: list[Floats], pose: list[Floats]) -> list[Floats]:
    """Poses given in frames, as x, y, theta of shape (N,) each, in the frame that those are given in."""
    (x, y, theta), (dx, dy, dtheta) = frame, pose
    cos, sin = np.cos(theta), np.sin(theta)
    return [x + cos * dx - sin * dy, y + sin * dx + cos * dy, theta + dtheta]


# -- limits ------------------------------------------------------------------------------------------------------------


def _active_limits(scenario: Scenario, rows: Floats, v_r: Floats, w_r: Floats) -> Iterator[str]:
    """A sentence for each limit that the nominal motion runs into: there a command has no effect to first order."""
    before = _next_rows(scenario, rows, v_r, w_r)
    for name, value in _limits(scenario):
        try:
            relaxed = scenario.with_settings([f"{name}={value * _RELAXED!r}"], "limits")
        except ParameterError:
            continue  # at the end of its range
        changed = np.flatnonzero(np.abs(_next_rows(relaxed, rows, v_r, w_r) - before).max(axis=1) > 1e-9)
        if len(changed):
            where = "at every step" if len(rows) == 1 else (
                f"at {len(changed)} of {len(rows)} steps of the lap, first at step {int(changed[0])}"
            )  # fmt: skip
            yield f"the limit {name} = {value:g} is active {where}: there the command does not answer to the error"


_RELAXED = 1.5


def _limits(scenario: Scenario) -> list[tuple[str, float]]:
    """Limits that a scenario has, by their parameters' names, with their values."""
    plant, controller = scenario.plant, scenario.controller
    found = [("controller.v_max", controller.v_max)]
    found += [(f"plant.{name}", getattr(plant, name)) for name in ("w_max", "a_max", "j_max")]
    vehicle, law = VEHICLES.find(plant.vehicle), CONTROL_LAWS.find(controller.law)
    own = {parameter.name: value for parameter, value in zip(vehicle.parameters, plant.vehicle_values, strict=True)}
    found += [(f"plant.{plant.vehicle}.{name}", own[name]) for name in vehicle.limits]
    prefix = "" if controller.law == KANAYAMA else f"{controller.law}."
    gains = {parameter.name: value for parameter, value in zip(law.parameters, controller.gains, strict=True)}
    found += [(f"controller.{prefix}{name}", gains[name]) for name in law.limits]
    return [(name, value) for name, value in found if math.isfinite(value)]


def _next_rows(scenario: Scenario, rows: Floats, v_r: Floats, w_r: Floats) -> Floats:
    """Errors, driven speeds and further states a step after the nominal ones, shape (N, ...)."""
    model = model_of(scenario)
    found = model.derivatives(rows, v_r, w_r)
    return found.following
