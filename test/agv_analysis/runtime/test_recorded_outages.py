"""Outages of a recording: as a file, and as the channel of another run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from agv_analysis.run import Run
from agv_analysis.runtime.recorded_outages import with_outages_of, write_outages
from agv_analysis.simulation.single import simulate
from agv_plant.channels.trace import load_trace
from agv_ros.errors import UserError
from test.agv_analysis.runtime.test_edge_comparison import without

if TYPE_CHECKING:
    from test.conftest import Drive

REPOSITORY = Path(__file__).parents[3]
SAMPLE = REPOSITORY / "bags/sample"
QOS = REPOSITORY / "config/rosbag2_qos.yaml"
AgvNcs = Callable[..., tuple[int, str]]


def test_outages_of_a_recording_are_read_back(sample: Run, tmp_path: Path) -> None:
    assert write_outages(tmp_path / "lost.csv", sample) == sample.lost.sum() > 0
    assert load_trace(str(tmp_path / "lost.csv")) == tuple(sample.lost.tolist())


def test_recorded_outages_drive_a_run_with_other_gains(sample: Run, tmp_path: Path, drive: Drive) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    write_outages(tmp_path / "lost.csv", sample)
    trace = ("relay.uplink.model=trace", f"relay.uplink.trace_file={tmp_path / 'lost.csv'}")
    run = drive("plant.duration=5.0", "controller.kx=5.0", *trace)
    assert (run.lost == sample.lost[: len(run)]).all()
    assert np.abs(simulate(run.scenario).pose - run.pose).max() < 1e-9


def test_the_downlink_s_outages(tmp_path: Path, drive: Drive) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    run = drive("plant.duration=0.5", "relay.downlink.model=burst", "relay.downlink.n=3")
    write_outages(tmp_path / "lost.csv", run, downlink=True)
    assert load_trace(str(tmp_path / "lost.csv")) == (False, True, True, True) * 25


def test_missing_slots_are_refused(sample: Run, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="2 slots of edge/slot are missing"):
        write_outages(tmp_path / "lost.csv", without(sample, 5, 9))
    assert not (tmp_path / "lost.csv").exists()


def test_a_path_that_cannot_be_written(sample: Run, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot be written"):
        write_outages(tmp_path, sample)


def test_the_recorded_outages_and_gains_give_the_recorded_run(sample: Run, tmp_path: Path) -> None:
    again = simulate(with_outages_of(sample, sample.scenario, tmp_path))
    assert (again.lost == sample.lost).all()
    assert np.abs(again.pose - sample.pose).max() < 1e-9


def test_a_recording_without_its_beginning_is_not_driven_again(sample: Run, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="begins with step 3"):
        with_outages_of(without(sample, 0, 1, 2), sample.scenario, tmp_path)
