"""Runs in real time on DDS: that a recording says which commands acted, held against the motion itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from test.conftest import Drive

pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")

from agv_analysis.run import Run
from agv_ncs import register_control_law

TS = 0.01


def laborious(x_e: float, y_e: float, theta_e: float, v_r: float, w_r: float) -> tuple[float, float]:
    """Linear feedback that takes more than a period to compute, on any machine."""
    work = sum(i & 3 for i in range(400_000))
    return v_r + 2.0 * x_e, w_r + y_e + 2.0 * theta_e + 0.0 * work


def commands_that_acted(run: Run) -> list[int | None]:
    """Age of the command of which each step has the speed and the rate of turn; None where the AGV stood or none fits.

    Exact, since the vehicle obeys at once and its steps are Euler's.
    """
    moves = np.diff(run.pose, axis=0) / run.ts
    found: list[int | None] = []
    for k, (dx, dy, w) in enumerate(moves.tolist()):
        fits = [
            age for age in range(k + 1)
            if abs(run.command[k - age, 1] - w) < 1e-8 and abs(abs(run.command[k - age, 0]) - np.hypot(dx, dy)) < 1e-8
        ]  # fmt: skip
        found.append(fits[0] if fits and (dx or dy or w) else None)
    return found


def test_a_controller_that_takes_too_long_shows_in_the_ages(drive: Drive) -> None:
    """All nodes share a thread, so the plant misses the deadlines that fall into the controller's work."""
    register_control_law("laborious", laborious)
    run = drive(
        "plant.clock=realtime", f"plant.ts={TS}", "plant.duration=2.0", "controller.law=laborious",
        "plant.cmd_vel_timeout=10.0", "plant.initial_pose=[0.0, 1.0, 1.5]",
    )  # fmt: skip
    timing = run.timing
    assert timing is not None
    assert not run.lost.any()
    assert run.n_ul.max() == 0, "the slots know nothing of it"
    assert timing.missed_deadlines is not None
    assert timing.deadlines == 200
    assert 0 < timing.missed_deadlines <= 200
    assert timing.longest_overdue is not None
    assert timing.longest_overdue > TS
    assert any(note.startswith(f"{timing.missed_deadlines} of 200 deadlines missed") for note in run.notes)
    assert run.is_late
    assert run.n_dl_received is not None
    truth = commands_that_acted(run)
    known = [k for k, age in enumerate(truth) if age is not None]
    assert len(known) > 20
    assert all(run.n_dl_received[k] >= (truth[k] or 0) for k in known), "no age is smaller than the one that acted"
    assert max(truth[k] or 0 for k in known) > 2
