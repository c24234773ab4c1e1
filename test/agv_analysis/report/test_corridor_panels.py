"""The corridor as the report draws it."""

from __future__ import annotations

import numpy as np
import pytest

from agv_analysis.corridor.corridor_of_run import corridor_of_run
from agv_analysis.report.page import all_panels, render
from agv_analysis.simulation import simulate
from agv_analysis.stability.analysis import analyse
from test.agv_analysis.corridor.test_single_outage import on_a_line, scenario


def test_the_report_shows_corridor_and_tube() -> None:
    chosen = scenario("error_detector.track=line", "plant.duration=4.0", "error_detector.corridor=0.1", lap=4.0)
    analysis = analyse(simulate(chosen))
    found = corridor_of_run(analysis, chosen, is_known=True, laps=3)
    assert found is not None
    drawn = {panel.key: panel for panel in all_panels(analysis, found)}
    over_lap = {line.name: line.y for line in drawn["corridor"].lines}
    assert over_lap["corridor"] == pytest.approx(0.1)
    single, tube = (y for name, y in over_lap.items() if "outage" in name)
    assert single == pytest.approx(on_a_line(17), abs=1e-9)
    assert tube.max() == pytest.approx(on_a_line(14), rel=1e-4)
    edges = next(line for line in drawn["track"].lines if line.name == "corridor")
    assert np.abs(edges.x[np.isfinite(edges.x)]) == pytest.approx(0.1)  # the line goes along y
    page = render(analysis, found)
    assert "Longest single outage" in page
    assert "Within the corridor" in page
    assert "corridor" not in {panel.key for panel in all_panels(analysis)}
