"""The edge of today against a recording."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from agv_analysis.run import Run
from agv_analysis.runtime.edge_comparison import compare, with_settings
from agv_analysis.scenario import SCHEMAS
from agv_ros.errors import UserError

if TYPE_CHECKING:
    from test.conftest import Drive

REPOSITORY = Path(__file__).parents[3]
SAMPLE = REPOSITORY / "bags/sample"
QOS = REPOSITORY / "config/rosbag2_qos.yaml"
AgvNcs = Callable[..., tuple[int, str]]


def without(run: Run, *rows: int) -> Run:
    """The run with some of its steps missing."""
    names = ("k", "pose", "reference", "error", "command", "n_ul", "lost", "downlink_lost")
    return dataclasses.replace(run, **{name: np.delete(getattr(run, name), rows, axis=0) for name in names})


def test_an_unchanged_edge_answers_as_it_did(sample: Run) -> None:
    comparison = compare(sample, sample.scenario)
    assert not comparison.differs
    assert comparison.error.compared == comparison.command.compared == comparison.steps == len(sample)
    assert max(comparison.error.largest, comparison.command.largest) < 1e-12


@pytest.mark.parametrize(
    "settings",
    [
        ("controller.kx=250.0", "controller.v_max=6.0", "relay.uplink.model=burst", "relay.uplink.n=14"),
        ("relay.uplink.model=gilbert_elliott", "relay.uplink.p=0.1", "relay.uplink.r=0.2",
         "relay.downlink.model=bernoulli", "relay.downlink.p=0.3", "error_detector.track=eight"),
        ("plant.integration=arc", "plant.initial_pose=[0.0, 0.0, 20.0]"),
    ],
)  # fmt: skip
def test_the_nodes_answers_follow_from_poses_and_slots(settings: tuple[str, ...], drive: Drive) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    run = drive("plant.duration=2.0", *settings)
    comparison = compare(run, run.scenario)
    assert not comparison.differs, comparison
    assert comparison.command.compared == len(run) == 400


def test_another_gain_differs_by_its_share_of_the_command(sample: Run) -> None:
    """v = v_r cos(theta_e) + K_x x_e is linear in K_x."""
    assert sample.scenario.controller.v_max == math.inf
    gain = sample.scenario.controller.kx
    comparison = compare(sample, with_settings(sample.scenario, [f"controller.kx={gain + 2.0}"]))
    expected = np.abs(2.0 * sample.error[:, 0])
    assert comparison.error.first is None
    assert comparison.command.first == 0
    assert comparison.command.first_size == pytest.approx(expected[0], abs=1e-12)
    assert comparison.command.largest == pytest.approx(expected.max(), abs=1e-12)
    assert comparison.command.largest_at == np.argmax(expected)


def test_another_reference_differs_in_the_error(sample: Run) -> None:
    """A reference that begins 0.25 m further on along the heading of the AGV."""
    start = sample.scenario.error_detector.track_start
    moved = [start[0], start[1] + 0.25, start[2]]
    comparison = compare(sample, with_settings(sample.scenario, [f"error_detector.track_start={moved}"]))
    assert comparison.error.first == 0
    assert comparison.error.first_size == pytest.approx(0.25, abs=1e-9)


def test_the_first_difference_is_found(sample: Run) -> None:
    command = sample.command.copy()
    command[700:, 1] += 2e-9 * np.maximum(1.0, np.abs(command[700:]).max(axis=1))
    command[300, 0] += 1e-10
    comparison = compare(dataclasses.replace(sample, command=command), sample.scenario)
    assert (comparison.error.first, comparison.command.first) == (None, 700)


def test_an_answer_that_is_no_number_differs(sample: Run) -> None:
    pose = sample.pose.copy()
    pose[~sample.lost & (sample.k == 100)] = np.nan
    comparison = compare(dataclasses.replace(sample, pose=pose), sample.scenario)
    assert comparison.differs
    assert comparison.command.first_size == math.inf
    assert json.loads(json.dumps(comparison.to_json(), allow_nan=False))["command"]["first_size"] is None


def test_steps_without_the_held_pose_are_left_out(sample: Run) -> None:
    row = int(np.flatnonzero(sample.lost)[0]) - 1  # the pose that is held during the first outage
    outage = int(np.flatnonzero(~sample.lost[row + 1 :])[0])
    comparison = compare(without(sample, row), sample.scenario)
    assert not comparison.differs
    assert (comparison.steps, comparison.error.compared) == (len(sample) - 1, len(sample) - 1 - outage)


def test_nothing_to_compare_is_said(sample: Run) -> None:
    silent = dataclasses.replace(sample, command=np.full_like(sample.command, np.nan))
    with pytest.raises(UserError, match="nothing to compare, no step has both edge/cmd_vel"):
        compare(silent, sample.scenario)


def test_the_grid_is_the_recording_s(sample: Run) -> None:
    with pytest.raises(UserError, match="ts and start_time are those of the recording"):
        with_settings(sample.scenario, [f"{node}.ts=0.01" for node in SCHEMAS])


@pytest.mark.parametrize("policy", ["align", "predict"])
def test_an_edge_with_a_staleness_policy_gives_the_same_answers_again(drive: Drive, policy: str) -> None:
    run = drive(f"error_detector.policy={policy}", "plant.duration=2.0", "plant.speed_scale=1.05", config="outages")
    assert run.n_ul.max() > 3
    found = compare(run, run.scenario)
    assert found.error.first is None
    assert found.command.first is None
