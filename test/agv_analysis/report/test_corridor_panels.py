"""The corridor as the report draws it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from agv_analysis.corridor.corridor_of_run import CorridorOfRun, corridor_of_run
from agv_analysis.report.page import all_panels, render
from agv_analysis.simulation import simulate
from agv_analysis.stability.analysis import Analysis, analyse
from test.agv_analysis.corridor.test_single_outage import on_a_line, scenario

if TYPE_CHECKING:
    from selenium.webdriver import Chrome


@pytest.fixture(scope="module")
def judged() -> tuple[Analysis, CorridorOfRun]:
    """Two laps of a line, 4 s each."""
    chosen = scenario("error_detector.track=line", "plant.duration=8.0", "error_detector.corridor=0.1", lap=4.0)
    analysis = analyse(simulate(chosen))
    found = corridor_of_run(analysis, chosen, is_known=True, laps=3)
    assert found is not None
    return analysis, found


def test_the_report_shows_corridor_and_tube(judged: tuple[Analysis, CorridorOfRun]) -> None:
    analysis, found = judged
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


def test_no_name_of_the_legend_is_cut_off(
    judged: tuple[Analysis, CorridorOfRun], chromium: Chrome, tmp_path: Path
) -> None:
    from test.agv_analysis.report.test_report import of_plot, show

    (path := tmp_path / "report.html").write_text(render(*judged), encoding="utf-8")
    size = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    try:
        chromium.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        show(chromium, path)
        names = "[...plot.querySelectorAll('.legendtext')]"
        assert "tube for any outages up to 14 slots" in of_plot(
            chromium,
            "track",
            f"{names}.map(name => [...name.querySelectorAll('tspan')].map(t => t.textContent).join(' '))",
        )
        past = of_plot(
            chromium, "track",
            f"Math.max(...{names}.map(one => one.getBoundingClientRect().right)) - plot.getBoundingClientRect().right",
        )  # fmt: skip
        assert past <= 0.0
    finally:
        chromium.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_the_cursor_goes_through_the_panel_of_the_corridor_as_well(
    judged: tuple[Analysis, CorridorOfRun], chromium: Chrome, tmp_path: Path
) -> None:
    from selenium.webdriver.support.ui import WebDriverWait

    from test.agv_analysis.report.test_report import complaints, of_plot, point_at, show

    (path := tmp_path / "report.html").write_text(render(*judged), encoding="utf-8")
    show(chromium, path)
    waiting = WebDriverWait(chromium, 60.0)
    point_at(chromium, "time", 5.0)
    waiting.until(lambda c: of_plot(c, "corridor", "Boolean(plot._hoverdata)"))
    at = of_plot(chromium, "time", "plot._hoverdata[0].x")
    assert of_plot(chromium, "corridor", "plot._hoverdata[0].x") == pytest.approx(at - 4.0, abs=0.02)
    point_at(chromium, "corridor", 3.0)
    waiting.until(lambda c: abs(of_plot(c, "time", "plot._hoverdata ? plot._hoverdata[0].x : 0") - 3.0) < 0.1)
    assert not of_plot(chromium, "track", "plot.querySelector('.cursor').hidden")
    assert complaints(chromium) == []
