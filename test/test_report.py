"""The report in headless Chromium, as a person sees it, and the figures for papers."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from agv_analysis.analysis import Analysis, analyse, observe
from agv_analysis.recording import read_run
from agv_analysis.report.figures import draw_figures
from agv_analysis.report.page import render, sentence, write_report
from agv_analysis.report.panels import LINE, Line, lifted_multipliers, panels, paper_eigenvalues, thinned
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation.single import simulate
from agv_ros.errors import UserError

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

REPOSITORY = Path(__file__).parents[1]
SAMPLE = REPOSITORY / "bags/sample"

HOSTILE = "</script><script>window.harm = 1</script><img src=x onerror='window.harm = 1'>{{ 7 * 7 }}\"'&"


def scenario_of(*settings: str, config: str = "outages") -> Any:
    return load_scenario(str(REPOSITORY / f"config/{config}.yaml"), settings)


@pytest.fixture(scope="module")
def lap() -> Analysis:
    """The paper's lap with outages: 20 000 steps."""
    return analyse(simulate(scenario_of()))


@pytest.fixture(scope="module")
def page(lap: Analysis, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(lap, path)
    return path


def show(chrome: Chrome, path: Path) -> None:
    """Load a page and wait until its plots are drawn."""
    from selenium.webdriver.support.ui import WebDriverWait

    chrome.get_log("browser")  # type: ignore[no-untyped-call]
    chrome.get(path.as_uri())
    WebDriverWait(chrome, 120.0).until(lambda c: c.execute_script("return document.body.dataset.drawn"))


def complaints(chrome: Chrome) -> list[str]:
    """What the page has had to complain of; a remark of the graphics driver is no complaint."""
    log = chrome.get_log("browser")  # type: ignore[no-untyped-call]
    return [entry["message"] for entry in log if "GL Driver Message" not in entry["message"]]


def of_plot(chrome: Chrome, key: str, expression: str) -> Any:
    return chrome.execute_script(f"const plot = document.getElementById('plot-{key}'); return {expression};")


@pytest.fixture
def shown(chromium: Chrome, page: Path) -> Chrome:
    if chromium.current_url != page.as_uri():  # drawing takes seconds without a graphics card
        show(chromium, page)
    return chromium


def test_all_plots_are_drawn_and_the_console_is_silent(shown: Chrome, lap: Analysis) -> None:
    assert complaints(shown) == []
    assert shown.find_element("id", "verdict").text == sentence(lap)
    assert of_plot(shown, "time", "plot.data.length") == 3 + 3 + 2 + 1
    assert of_plot(shown, "time", "plot._fullData[0].y.length") == len(lap.run)
    for key in ("track", "time", "outages", "eigenvalues"):
        assert of_plot(shown, key, "plot.querySelectorAll('.main-svg').length") > 0
        assert of_plot(shown, key, "plot.getBoundingClientRect().height") > 300
    assert "mean-square (by mean_square)" in shown.find_element("id", "figures").text


def test_the_numbers_in_the_page_are_those_of_the_run(shown: Chrome, lap: Analysis) -> None:
    # plotly.js has them from binary: read back from it, not from what was written
    speed = of_plot(shown, "time", "Array.from(plot._fullData.find(trace => trace.name == 'v').y)")
    np.testing.assert_allclose(speed, lap.run.command[:, 0], rtol=1e-6)
    data = json.loads(shown.execute_script("return document.getElementById('data').textContent"))
    assert data["analysis"] == json.loads(json.dumps(lap.to_json()))


def test_dragging_over_one_plot_zooms_all_that_share_its_time(shown: Chrome) -> None:
    from selenium.webdriver import ActionChains

    before = of_plot(shown, "time", "plot._fullLayout.xaxis.range")
    field = shown.find_element("css selector", "#plot-time .nsewdrag[data-subplot='xy3']")
    shown.execute_script("arguments[0].scrollIntoView({block: 'center'})", field)
    width = field.rect["width"]
    ActionChains(shown).move_to_element(field).click_and_hold().move_by_offset(int(width / 4), 0).release().perform()
    low, high = of_plot(shown, "time", "plot._fullLayout.xaxis.range")
    middle, length = sum(before) / 2.0, before[1] - before[0]
    assert low == pytest.approx(middle, abs=0.02 * length)
    assert high == pytest.approx(middle + length / 4.0, abs=0.02 * length)
    axes = "[...new Set(plot._fullData.map(trace => trace.xaxis))]"
    assert of_plot(shown, "time", axes) == ["x"]  # one time axis for all
    assert complaints(shown) == []


def test_it_fits_a_phone_and_follows_dark_and_light(shown: Chrome) -> None:
    from selenium.webdriver.support.ui import WebDriverWait

    size = {"width": 360, "height": 740, "deviceScaleFactor": 1, "mobile": True}
    shown.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    colours, width = {}, "return document.documentElement.scrollWidth"
    try:
        for scheme in ("light", "dark"):
            feature = {"name": "prefers-color-scheme", "value": scheme}
            shown.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
            WebDriverWait(shown, 60.0).until(lambda c: c.execute_script(width) <= 360)
            colours[scheme] = shown.execute_script("return getComputedStyle(document.body).backgroundColor")
    finally:
        shown.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        shown.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    assert colours == {"light": "rgb(255, 255, 255)", "dark": "rgb(20, 23, 26)"}


def test_hostile_strings_of_a_recording_do_no_harm(chromium: Chrome, tmp_path: Path) -> None:
    run = read_run(SAMPLE)
    detector = dataclasses.replace(run.scenario.error_detector, track_file=HOSTILE)
    scenario = dataclasses.replace(run.scenario, error_detector=detector)
    bad = dataclasses.replace(
        run, scenario=scenario, source=HOSTILE, notes=(HOSTILE,), unexplained={f"/{HOSTILE}/agv/pose": 3}
    )
    write_report(analyse(bad), tmp_path / "bad.html")
    show(chromium, tmp_path / "bad.html")
    assert chromium.execute_script("return [typeof window.harm, document.images.length]") == ["undefined", 0]
    assert complaints(chromium) == []
    assert HOSTILE in chromium.execute_script("return document.body.textContent")
    assert "proves nothing" in chromium.find_element("id", "verdict").text


def test_the_page_asks_for_nothing_from_elsewhere(page: Path) -> None:
    html = page.read_text()
    loading = re.findall(r"<(?:script|link|img|iframe)[^>]* (?:src|href)=[\"']?([^\"'> ]*)", html)
    assert loading == ["data:,"]
    assert "default-src 'none'" in html


def test_a_run_without_known_gains_has_a_report_without_criteria() -> None:
    run = dataclasses.replace(read_run(SAMPLE), gains_known=False)
    html = render(observe(run))
    assert "cannot be said" in html
    assert 'id="plot-eigenvalues"' not in html
    assert 'id="plot-track"' in html


def test_a_run_that_diverges_has_a_report() -> None:
    settings = ("controller.kx=390.0", "relay.uplink.r=0.05", "plant.duration=30.0")
    assert "does not keep to its track" in render(analyse(simulate(scenario_of(*settings))))


def test_the_sentence_says_how_it_is(lap: Analysis) -> None:
    assert "on a radio link like this one, but not in every case" in sentence(lap)
    calm = analyse(simulate(scenario_of("plant.duration=5.0", config="paper")))
    assert sentence(calm) == "The AGV keeps to its track; no update was lost."


def test_eigenvalues_that_are_drawn_are_those_that_were_judged(lap: Analysis) -> None:
    assert np.abs(lifted_multipliers(lap)).max() == pytest.approx(lap.lifted_radius, rel=1e-9)
    assert np.abs(paper_eigenvalues(lap.run)).max() <= lap.paper.radius * (1.0 + 1e-9)


def test_a_thinned_line_keeps_its_peaks_and_ends() -> None:
    y = np.random.default_rng(1).normal(size=100_003)
    y[[0, 5, 77_777]] = np.nan, 50.0, -60.0
    line = thinned(Line("noise", np.arange(100_003.0), y, "driven", LINE), 1000)
    assert len(line.x) <= 1002
    assert (np.nanmax(line.y), np.nanmin(line.y)) == (50.0, -60.0)
    assert (line.x[0], line.x[-1]) == (0.0, 100_002.0)
    assert np.all(np.diff(line.x) > 0.0)
    np.testing.assert_array_equal(line.y, y[line.x.astype(int)])


def test_figures_are_one_column_wide_with_their_fonts(lap: Analysis, tmp_path: Path) -> None:
    drawn = draw_figures(panels(lap), tmp_path / "figures")
    assert {path.suffix for path in drawn} == {".svg", ".pdf"}
    assert {path.stem for path in drawn} == {panel.key for panel in panels(lap)}
    for path in drawn:
        content = path.read_bytes()
        if path.suffix == ".svg":
            assert b'width="252pt"' in content  # 3.5 inch
            assert b"<text" not in content
        else:
            assert b"/MediaBox [ 0 0 252" in content
            assert b"/FontFile2" in content or b"/Type /Font" not in content


def test_the_commands_write_them(agv_ncs: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    options = ("--report", tmp_path / "a.html", "--figures", tmp_path / "figures")
    status, said = agv_ncs("analyse", SAMPLE, "--picture", tmp_path / "a.png", *options)
    assert status == 0, said
    assert (tmp_path / "a.html").stat().st_size > 1e6
    assert (tmp_path / "figures/track.pdf").is_file()
    status, said = agv_ncs("simulate", "config/paper.yaml", "--set", "plant.duration=2.0", "--report", tmp_path)
    assert status == 1
    assert "cannot be written" in said
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("axes", "kind"),
    [(["controller.kx=25,500"], "scatter"), (["controller.kx=25,500", "relay.uplink.p=0.0,0.02"], "heatmap")],
)
def test_a_sweep_has_a_report(
    chromium: Chrome, agv_ncs: Callable[..., tuple[int, str]], tmp_path: Path, axes: list[str], kind: str
) -> None:
    varied = [word for axis in axes for word in ("--vary", axis)]
    options = ("--set", "plant.duration=5.0", "--seeds", 3, "--report", tmp_path / "s.html", "--figures", tmp_path)
    status, said = agv_ncs("sweep", "config/outages.yaml", *varied, *options)
    assert status == 0, said
    show(chromium, tmp_path / "s.html")
    assert complaints(chromium) == []
    points, half = 2 ** len(axes), 2 ** len(axes) // 2
    verdict = chromium.find_element("id", "verdict").text
    assert verdict == f"Of {points} points the loop is stable in every run at {half}, and in none at {half}."
    assert of_plot(chromium, "instability", "plot._fullData[0].type") == kind
    assert len(chromium.find_elements("css selector", "#points tr")) == points + 1
    assert (tmp_path / "instability.svg").is_file()


def test_a_folder_that_cannot_be_written_to_is_named(lap: Analysis, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="file: cannot be written to"):
        draw_figures(panels(lap), tmp_path / "file")
