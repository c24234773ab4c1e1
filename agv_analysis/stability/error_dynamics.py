"""The loop without losses in terms of its error, and the motion to which it settles.

With eps = T_e(theta_c) [X_r - X_c] the loop does not depend on where it is: AGV and reference each move on in the AGV's
own frame, by the functions that the nodes call. Its state z is the tracking error, what the drive did last (speeds and
acceleration), further states of the vehicle, and the memory of the control law. A law that looks ahead has the error to
the reference of later, so for it the whole reference is that of later.

The nominal motion is the one that the loop without losses repeats lap after lap, at constant speeds a fixed point. With
an exact drive it is zero error; with a wrong speed, a lag, a limit or slip it is another one. It is found by Newton's
method on the map of a lap, whose derivative is the product of the steps' derivatives.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import compiled
from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.loop import Numbers, Settings, period
from agv_analysis.simulation.parts import memory_functions, replacements_of
from agv_analysis.simulation.single import settings_of
from agv_analysis.stability.derivatives import Jacobian, jacobian
from agv_analysis.stability.products import ordered_product
from agv_cloud.control.command import command
from agv_cloud.control.registry import CONTROL_LAWS
from agv_cloud.tracking_error import tracking_error
from agv_plant.vehicle.motion import Motion
from agv_plant.vehicle.registry import VEHICLES
from agv_plant.vehicle.unicycle import euler_step
from agv_ros.errors import UserError
from agv_ros.parts import PartError
from agv_ros.substitution import Function, Replacements, replaced

ERRORS, DRIVE = 3, 3
"""Numbers of the state: x_e, y_e, theta_e; v, w, a of the drive. Those of vehicle and law follow."""

_ITERATIONS = 15
_CLOSED = 1e-11
"""Up to this a lap ends where it began [m, rad, m/s]."""

_SETTLING_LAPS, _SETTLING_STEPS = 3, 4000
"""Laps, and steps, at least that are driven where Newton's method does not arrive from zero error."""

_SETTLING_SECONDS, _TIMES_LONGER = 600.0, 8
"""A loop that has not settled by then is driven so many times longer, until it has or this time [s] is over."""


class NoNominalMotionError(UserError):
    """The loop does not settle even without losses; the text says how it moves instead."""


class ErrorState(NamedTuple):
    """z at a step."""

    x_e: float
    y_e: float
    theta_e: float
    v: float
    """Speeds of the drive in the step before [m/s, rad/s]."""
    w: float
    a: float
    """Its acceleration [m/s^2]."""
    states: Numbers
    """Further states of the vehicle."""
    memory: Numbers
    """What the control law remembers."""


def plant_error_step(
    x_e: float, y_e: float, theta_e: float, v_driven: float, w_driven: float, a_driven: float, states: Numbers,
    v: float, w: float, v_r: float, w_r: float, settings: Settings,
) -> tuple[float, float, float, float, float, float, Numbers]:  # fmt: skip
    """The state without the law's memory, a period later under the command (v, w), with the reference's speeds."""
    moved = period(
        Motion(0.0, 0.0, 0.0, v_driven, w_driven, a_driven, states), v, w, 0, 0.0, 0.0, settings.vehicle, settings
    )
    x_r, y_r, theta_r = euler_step(x_e, y_e, theta_e, v_r, w_r, settings.ts)
    x_e, y_e, theta_e = tracking_error(x_r, y_r, theta_r, moved.x, moved.y, moved.theta)
    return x_e, y_e, theta_e, moved.v, moved.w, moved.a, moved.states


def error_step(z: ErrorState, v_r: float, w_r: float, settings: Settings) -> ErrorState:
    """The state after a step without losses."""
    v, w, memory = command(
        z.x_e, z.y_e, z.theta_e, v_r, w_r, z.memory, settings.gains, settings.ts, settings.look_ahead, settings.v_max
    )
    x_e, y_e, theta_e, v, w, a, states = plant_error_step(
        z.x_e, z.y_e, z.theta_e, z.v, z.w, z.a, z.states, v, w, v_r, w_r, settings
    )
    return ErrorState(x_e, y_e, theta_e, v, w, a, states, memory)


def store_states(row: NDArray[np.float64], states: Numbers) -> None:
    """Further states of a vehicle as a row; as it stands here one without any. See `LoopModel`."""


def store_law_memory(row: NDArray[np.float64], memory: Numbers) -> None:
    """The memory of a control law as a row; as it stands here one without any. See `LoopModel`."""


def drive_errors(z: ErrorState, v_r: Floats, w_r: Floats, settings: Settings, rows: Floats) -> None:
    """z(0) = `z`, z(1), ... into `rows`, shape (N + 1, states), with the reference's speeds of shape (N,)."""
    states_from, memory_from = 6, 6 + len(z.states)
    for k in range(len(v_r) + 1):
        row = rows[k]
        row[0], row[1], row[2], row[3], row[4], row[5] = z.x_e, z.y_e, z.theta_e, z.v, z.w, z.a
        store_states(row[states_from:], z.states)
        store_law_memory(row[memory_from:], z.memory)
        if k < len(v_r):
            z = error_step(z, v_r[k], w_r[k], settings)


@dataclass(frozen=True)
class StepDerivatives:
    """Derivatives of one step at each of N points; s states but for the memory, m numbers of memory."""

    plant_of_state: Floats
    """Of the s states after the step by those before, shape (N, s, s)."""
    plant_of_command: Floats
    """Of them by the command (v, w), shape (N, s, 2)."""
    command_of_error: Floats
    """Of the command by the error that the law is given, shape (N, 2, 3)."""
    command_of_memory: Floats
    """shape (N, 2, m)."""
    memory_of_error: Floats
    """shape (N, m, 3)."""
    memory_of_memory: Floats
    """shape (N, m, m)."""
    command: Floats
    """The command itself, shape (N, 2)."""
    following: Floats
    """The s states after the step, shape (N, s)."""
    not_differentiable: tuple[str, ...]
    """Where a step has no derivative: the place in the code, with the first step of the lap concerned."""


def derivatives_of_part(
    part: str, function: Function, arguments: Sequence[object], with_respect_to: Sequence[int]
) -> Jacobian:
    """As `jacobian`, of a function that calls a part. Raises PartError with the part's name where that has none."""
    try:
        return jacobian(function, arguments, with_respect_to)
    except UserError:
        raise
    except Exception as error:
        raise PartError(f"{part} cannot be differentiated: {' '.join(str(error).split())}") from error


class LoopModel:
    """The functions of a scenario's loop in error coordinates."""

    def __init__(self, scenario: Scenario) -> None:
        self.settings = settings_of(scenario)
        self.parts: Replacements = replacements_of(scenario)
        self.law, self.vehicle = scenario.controller.law, scenario.plant.vehicle
        law, vehicle = CONTROL_LAWS.find(self.law), VEHICLES.find(self.vehicle)
        self.states, self.memory = len(vehicle.states), law.memory
        stores: dict[Function, Function] = {}
        for placeholder, size in ((store_states, self.states), (store_law_memory, len(self.memory))):
            if size:
                stores[placeholder] = memory_functions(size)[1]
        self._stores = stores
        self._command = replaced(command, self.parts)
        self._plant = replaced(plant_error_step, self.parts)

    @property
    def size(self) -> int:
        """Numbers of the state."""
        return ERRORS + DRIVE + self.states + len(self.memory)

    @property
    def weights(self) -> Floats:
        """What makes the numbers of two states comparable, shape (size,)."""
        weights = np.ones(self.size)
        weights[ERRORS + 2] = self.settings.ts  # an acceleration is a difference over T_s, and so is its rounding
        return weights

    def state_of(self, row: Floats) -> ErrorState:
        """The state from its numbers, shape (size,)."""
        values = row.tolist()
        fixed = ERRORS + DRIVE
        x_e, y_e, theta_e, v, w, a = values[:fixed]
        states, memory = tuple(values[fixed : fixed + self.states]), tuple(values[fixed + self.states :])
        return ErrorState(x_e, y_e, theta_e, v, w, a, states, memory)

    def drive(self, row: Floats, v_r: Floats, w_r: Floats) -> Floats:
        """The states of a lap that begins with `row`, and the one after it: shape (N + 1, size)."""
        rows = np.empty((len(v_r) + 1, self.size))
        parts = {**self.parts, **self._stores}
        drive = compiled(drive_errors, parts)
        with np.errstate(all="ignore"):
            try:
                drive(self.state_of(row), np.ascontiguousarray(v_r), np.ascontiguousarray(w_r), self.settings, rows)
            except Exception:
                if not parts:
                    raise
                # Another package's part may be more than numba compiles.
                replaced(drive_errors, parts)(self.state_of(row), v_r, w_r, self.settings, rows)
        return rows

    def derivatives(self, rows: Floats, v_r: Floats, w_r: Floats) -> StepDerivatives:
        """Of the steps that begin with `rows`, shape (N, size)."""
        fixed, memory_from = ERRORS + DRIVE, ERRORS + DRIVE + self.states
        columns = list(np.ascontiguousarray(rows.T))
        memory, states = tuple(columns[memory_from:]), tuple(columns[fixed:memory_from])
        s, m, now = self.settings, len(memory), columns[:ERRORS]
        law = derivatives_of_part(
            f"control law {self.law}",
            self._command,
            [*now, v_r, w_r, memory, s.gains, s.ts, s.look_ahead, s.v_max],
            [0, 1, 2, *range(5, 5 + m)],
        )
        plant = derivatives_of_part(
            f"vehicle {self.vehicle}",
            self._plant,
            [*columns[:fixed], states, law.value[:, 0], law.value[:, 1], v_r, w_r, s],
            list(range(memory_from + 2)),
        )
        kinks = [*law.not_differentiable, *plant.not_differentiable]
        return StepDerivatives(
            plant_of_state=plant.derivative[:, :, :memory_from],
            plant_of_command=plant.derivative[:, :, memory_from:],
            command_of_error=law.derivative[:, :2, :3],
            command_of_memory=law.derivative[:, :2, 3:],
            memory_of_error=law.derivative[:, 2:, :3],
            memory_of_memory=law.derivative[:, 2:, 3:],
            command=law.value[:, :2],
            following=plant.value,
            not_differentiable=tuple(f"{kink.where}, first at step {int(kink.rows[0])}" for kink in kinks),
        )

    def closed_loop(self, found: StepDerivatives) -> Floats:
        """Derivatives of the state after a step without losses by the one before, shape (N, size, size)."""
        plant, memory = found.plant_of_state.shape[1], len(self.memory)
        whole = np.zeros((len(found.command), plant + memory, plant + memory))
        whole[:, :plant, :plant] = found.plant_of_state
        whole[:, :plant, :ERRORS] += found.plant_of_command @ found.command_of_error
        whole[:, :plant, plant:] = found.plant_of_command @ found.command_of_memory
        whole[:, plant:, :ERRORS] = found.memory_of_error
        whole[:, plant:, plant:] = found.memory_of_memory
        return whole

    def start(self, v_r: Floats, w_r: Floats) -> Floats:
        """Zero error, with a drive that follows the lap's last speeds, shape (size,)."""
        row = np.zeros(self.size)
        row[ERRORS : ERRORS + 2] = v_r[-1], w_r[-1]
        row[self.size - len(self.memory) :] = self.memory
        return row


def nominal_motion(model: LoopModel, v_r: Floats, w_r: Floats) -> Floats:
    """The states of the lap that the loop without losses repeats, shape (N, size), at speeds of shape (N,).

    One row may stand for a loop whose speeds never change. Raises NoNominalMotionError if there is no such lap.
    """
    start = model.start(v_r, w_r)
    found = _newton(model, start, v_r, w_r)
    if found is not None and np.array_equal(found[0], start):
        return found
    laps = max(_SETTLING_LAPS, math.ceil(_SETTLING_STEPS / len(v_r)))
    longest = _SETTLING_SECONDS / (2 * len(v_r) * model.settings.ts)
    while True:
        driven = model.drive(start, np.tile(v_r, 2 * laps), np.tile(w_r, 2 * laps))
        is_finite = bool(np.isfinite(driven).all())
        if found is not None and _is_reached(model, found, driven, v_r, w_r):
            return found
        if is_finite:  # from where the loop goes by itself
            other = _newton(model, driven[laps * len(v_r)], v_r, w_r)
            if other is not None and _is_reached(model, other, driven, v_r, w_r):
                return other
        if laps >= longest or not is_finite:
            break
        laps = math.ceil(min(_TIMES_LONGER * laps, longest))
    if found is None or _is_stable(_lap_of_errors(model, found, v_r, w_r)):
        raise NoNominalMotionError(_what_it_does_instead(model, v_r, w_r))
    return found  # and to be called unstable


def _lap_of_errors(model: LoopModel, found: Floats, v_r: Floats, w_r: Floats) -> Floats:
    return _lap_matrix(model.closed_loop(model.derivatives(found, v_r, w_r)))


def _is_stable(lap: Floats) -> bool:
    return bool(np.isfinite(lap).all()) and float(np.abs(np.linalg.eigvals(lap)).max()) < 1.0 + 1e-6


def _is_reached(model: LoopModel, found: Floats, driven: Floats, v_r: Floats, w_r: Floats) -> bool:
    """Does the loop, begun at zero error, come nearer to a stable lap that repeats itself?

    `driven` are the states of an even number of laps. Newton's method may also find an unstable lap, or a stable one to
    which the loop never comes: far behind the reference, say, where a limit holds all the time. A loop comes nearer if
    it is nearer in the second half than in the first, or if it moves there as the derivatives say, however slowly that
    dies out.
    """
    lap = _lap_of_errors(model, found, v_r, w_r)
    if not (_is_stable(lap) and np.isfinite(driven).all()):
        return False
    laps, weights = (len(driven) - 1) // len(found), model.weights
    away = np.abs(weights * (driven[:-1] - np.tile(found, (laps, 1)))).max(axis=1)
    quarter = len(away) // 4
    before, after = float(away[quarter : 2 * quarter].max()), float(away[3 * quarter :].max())
    if after <= max(0.99 * before, 1e-6):
        return True
    halfway, end = (weights * (driven[k] - found[0]) for k in ((laps // 2) * len(found), -1))
    predicted = weights * (np.linalg.matrix_power(lap, laps // 2) @ (halfway / weights))
    return float(np.abs(end - predicted).max()) <= 0.05 * float(np.abs(halfway).max())


def _newton(model: LoopModel, row: Floats, v_r: Floats, w_r: Floats) -> Floats | None:
    """Newton's method on the map of a lap, from the state `row`; None where it does not arrive."""
    weights = model.weights
    for _ in range(_ITERATIONS):
        rows = model.drive(row, v_r, w_r)
        missing = rows[-1] - row
        if not np.isfinite(missing).all():
            return None
        if np.abs(weights * missing).max() <= _CLOSED * max(1.0, float(np.abs(row).max())):
            return rows[:-1]
        lap = _lap_matrix(model.closed_loop(model.derivatives(rows[:-1], v_r, w_r)))
        if not np.isfinite(lap).all():
            return None
        step, *_ = np.linalg.lstsq(np.eye(model.size) - lap, missing, rcond=1e-12)
        row = row + step
    return None


def _lap_matrix(steps: Floats) -> Floats:
    """The product of the steps' derivatives; inf where it leaves the range of a double."""
    with np.errstate(over="ignore", invalid="ignore"):
        product, log_scale = ordered_product(steps)
        return np.asarray(product * math.exp(min(log_scale, 700.0)))


_WATCHED = 20_000
"""Steps, at least, that a loop is watched that does not settle."""


def _what_it_does_instead(model: LoopModel, v_r: Floats, w_r: Floats) -> str:
    """In words: it falls behind, it leaves all bounds, or it oscillates."""
    laps = max(2, math.ceil(2 * _WATCHED / len(v_r)))
    rows = model.drive(model.start(v_r, w_r), np.tile(v_r, laps), np.tile(w_r, laps))
    errors = rows[:, :ERRORS]
    ts = model.settings.ts
    if not np.isfinite(errors).all():
        return "without any loss the loop diverges: the error is no longer finite"
    half = len(errors) // 2
    distance = np.hypot(errors[:, 0], errors[:, 1])
    drift = float(distance[-1] - distance[half]) / ((len(errors) - half) * ts)
    if drift * (len(errors) - half) * ts > 0.4 * float(distance[half:].max()):  # of a steady drift it is half
        return f"without any loss the AGV falls behind its reference by {drift:.3g} m/s forever"
    spread = np.ptp(errors[half:], axis=0)
    return (
        "without any loss the loop does not settle: it oscillates by "
        f"{spread[0]:.3g} m along, {spread[1]:.3g} m across the track and {spread[2]:.3g} rad"
    )


@functools.lru_cache(maxsize=8)
def model_of(scenario: Scenario) -> LoopModel:
    """The model of a scenario; kept, since each criterion asks for it."""
    return LoopModel(scenario)
