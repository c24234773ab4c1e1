"""Which command acted, from the motion: an AGV that obeys at once moves just as one of its commands says.

Log times say when the recorder heard a command, which may be before the AGV took it. Where the motion of a step is that
of an older command, it is this one that acted.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats, Run

_SAME = 1e-7
"""Largest difference [m/s, rad/s] between a command and the speeds that follow from poses, rounded as these are."""


def obeys_at_once(run: Run) -> bool:
    """Are the speeds of each of the AGV's steps those of a command, by the parameters of the run?"""
    plant = run.scenario.plant
    is_plain = (plant.vehicle, plant.integration, plant.downlink_policy) == ("unicycle", "euler", "hold")
    is_limited = not np.isinf([plant.w_max, plant.a_max, plant.j_max]).all() or plant.lag > 0.0
    is_wrong = plant.speed_scale != 1.0 or plant.slip != 0.0 or plant.slip_noise > 0.0 or plant.skid != 0.0
    return is_plain and not (is_limited or is_wrong or plant.is_noisy)


def command_ages(run: Run) -> NDArray[np.int64]:
    """Steps since the newest command that moves the AGV as it moved in step k, shape (N,); 0 where none does.

    The speeds are those of Euler's step, v [m/s] along the heading. All are 0 if the AGV does not obey at once, or if
    steps are missing.
    """
    ages = np.zeros(len(run), dtype=np.int64)
    if not obeys_at_once(run) or len(run) < 2 or int(run.k[-1] - run.k[0]) + 1 != len(run):
        return ages
    moved = _speeds(run.pose, run.ts)
    rows = np.flatnonzero(np.isfinite(moved).all(axis=1))
    for age in range(min(len(run), round(run.scenario.plant.cmd_vel_timeout / run.ts) + 2)):
        rows = rows[rows >= age]
        fits = (np.abs(run.command[rows - age] - moved[rows]) <= _SAME * (1.0 + np.abs(moved[rows]))).all(axis=1)
        ages[rows[fits]] = age
        rows = rows[~fits]
        if not len(rows):
            break
    return ages


def _speeds(pose: Floats, ts: float) -> Floats:
    """Speed along the heading and rate of turn of each step but the last [m/s, rad/s], shape (N - 1, 2)."""
    dx, dy, turn = np.diff(pose, axis=0).T / ts
    theta = pose[:-1, 2]
    return np.column_stack([dx * np.cos(theta) + dy * np.sin(theta), turn])
