"""Fixtures of the tests of runs, recordings and replays."""

from __future__ import annotations

from pathlib import Path

import pytest

from agv_analysis.recordings.recording import read_run
from agv_analysis.run import Run

SAMPLE = Path(__file__).parents[3] / "bags/sample"


@pytest.fixture(scope="session")
def sample() -> Run:
    return read_run(SAMPLE)
