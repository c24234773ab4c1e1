"""Params files and recordings of each released version, in test/data, are read as they were meant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from agv_analysis.recordings.recording import read_run
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate

DATA = Path(__file__).parent / "data"
RELEASED = sorted(folder.name for folder in DATA.iterdir())


def test_there_is_a_released_version() -> None:
    assert "0.1.0" in RELEASED


@pytest.mark.parametrize("version", RELEASED)
def test_a_run_of_a_released_version_is_what_its_params_file_gives_today(version: str) -> None:
    """10 s in lockstep at 200 Hz: the recorded poses are the simulated ones, and the same messages are lost."""
    recorded = read_run(DATA / version / "bag")
    simulated = simulate(load_scenario(DATA / version / "outages.yaml", ["plant.duration=10.0"]))
    assert (len(recorded), dict(recorded.unexplained)) == (2000, {})
    assert recorded.lost.any()
    assert np.array_equal(recorded.lost, simulated.lost)
    assert np.abs(recorded.pose - simulated.pose).max() < 1e-9
