"""A loop in real time whose edge steps by its own clock: it answers from poses of the age that it records."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from test.conftest import Drive

pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")

from agv_analysis.runtime.runner import run_in_process
from agv_analysis.scenario import load_scenario
from agv_ros.errors import UserError

OWN_CLOCK = ("error_detector.trigger=timer", "plant.ts=0.02", "controller.kx=5.0")


def test_the_recorded_ages_are_those_of_the_poses_behind_the_errors(drive: Drive) -> None:
    run = drive(
        *OWN_CLOCK, "plant.clock=realtime", "plant.duration=3.0", "relay.uplink.model=bernoulli", "relay.uplink.p=0.3"
    )
    assert len(run) == 150
    assert not [note for note in run.notes if "do not fit" in note]
    answered = np.isfinite(run.error[:, 0])
    assert answered.sum() > 1
    assert run.n_ul[answered].min() >= 0
    assert len(set(run.n_ul[answered].tolist())) > 1


def test_in_lockstep_such_an_edge_is_refused_before_the_plant_waits_for_it() -> None:
    paper = str(Path(__file__).parents[2] / "config" / "paper.yaml")
    with pytest.raises(UserError, match=r"trigger is timer, but plant\.clock is lockstep"):
        run_in_process(load_scenario(paper, OWN_CLOCK), None, lambda _: None)
