"""The report in headless Chromium, as a person sees it, and the figures for papers."""

from __future__ import annotations

import base64
import csv
import dataclasses
import importlib
import json
import re
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import yaml
from rosbags.typesys import Stores, get_typestore

from agv_analysis.explore.response import beside
from agv_analysis.metrics.confidence import computed
from agv_analysis.recordings.recording import read_run
from agv_analysis.report.cannot_say import cannot_say
from agv_analysis.report.eigenvalues import lifted_multipliers, paper_eigenvalues
from agv_analysis.report.matplotlib_figures import draw_figures
from agv_analysis.report.page import render, write_report
from agv_analysis.report.panels import HALOS, LINE, RINGS, Line, distance, panels, speed, thinned, track
from agv_analysis.report.plotly import figure
from agv_analysis.report.sweep_page import sweep_figure, write_sweep_report
from agv_analysis.report.table import print_side_by_side, print_table
from agv_analysis.report.tiles import confidence_text, how_sure, tiles
from agv_analysis.report.verdict_sentence import sentence
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation.single import simulate
from agv_analysis.stability.analysis import Analysis, analyse, observe
from agv_analysis.sweep import METRICS
from agv_analysis.sweep.plan import Sweep, parse_axis
from agv_ros.errors import UserError

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

REPOSITORY = Path(__file__).parents[3]
SAMPLE = REPOSITORY / "bags/sample"
STORE = get_typestore(Stores.ROS2_JAZZY)

HOSTILE = "</script><script>window.harm = 1</script><img src=x onerror='window.harm = 1'>{{ 7 * 7 }}\"'&\u202e"


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
    """What the page has had to complain of."""
    return [entry["message"] for entry in chrome.get_log("browser")]  # type: ignore[no-untyped-call]


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
    assert of_plot(shown, "time", "plot.data.length") == 4 + 3 + 2 + 1
    assert of_plot(shown, "time", "plot._fullData[0].y.length") == len(lap.run)
    for key in ("track", "time", "outages", "eigenvalues"):
        assert of_plot(shown, key, "plot.querySelectorAll('.main-svg').length") > 0
        assert of_plot(shown, key, "plot.getBoundingClientRect().height") > 300
    assert "Decided by mean square" in shown.find_element("id", "figures").text
    # Where it strays most is marked on the track and over time, and stands in a table.
    worst = [peak.distance for peak in lap.deviation.worst]
    for key in ("track", "time"):
        rings = of_plot(shown, key, "Array.from(plot._fullData.find(trace => trace.name == 'largest deviations').y)")
        assert len(rings) == len(worst)
    np.testing.assert_allclose(rings, worst, rtol=1e-6)
    assert f"{worst[0]:.3g} m" in shown.find_element("id", "deviation").text
    assert len(shown.find_elements("css selector", "#deviations tr")) == 1 + len(worst)


def test_the_numbers_in_the_page_are_those_of_the_run(shown: Chrome, lap: Analysis) -> None:
    # plotly.js has them from binary: read back from it, not from what was written
    speed = of_plot(shown, "time", "Array.from(plot._fullData.find(trace => trace.name == 'v').y)")
    np.testing.assert_allclose(speed, lap.run.command[:, 0], rtol=1e-6)
    data = json.loads(shown.execute_script("return document.getElementById('data').textContent"))
    assert data["analysis"] == json.loads(json.dumps(lap.to_json()))


@pytest.mark.parametrize(("width", "height"), [(1400, 900), (390, 844)])
def test_the_first_screen_says_whether_how_far_how_sure_and_why(shown: Chrome, width: int, height: int) -> None:
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
    shown.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        shown.execute_script("scrollTo(0, 0)")
        for name in ("verdict", "why", "cannot-say", "word", "deviation", "corridor", "losses", "outage", "speed"):
            rect = shown.execute_script(f"return document.getElementById('{name}').getBoundingClientRect()")
            assert rect["bottom"] <= height, name
            assert rect["right"] <= width, name
        assert "stable with a probability" in shown.find_element("id", "word").text
    finally:
        shown.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def point_at(chrome: Chrome, key: str, x: float, y: float | None = None) -> None:
    """Move the pointer over a place of a plot, in the units of its first axes; y: the middle of its first panel."""
    from selenium.webdriver import ActionChains

    element = chrome.find_element("id", f"plot-{key}")
    chrome.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
    axis = "plot._fullLayout.yaxis"
    down = f"{axis}._offset + {f'{axis}.l2p({y})' if y is not None else f'{axis}._length / 2'}"
    right = f"plot._fullLayout.xaxis._offset + plot._fullLayout.xaxis.l2p({x})"
    left, top = of_plot(chrome, key, f"[{right} - plot.offsetWidth / 2, {down} - plot.offsetHeight / 2]")
    ActionChains(chrome).move_to_element(element).move_to_element_with_offset(element, left, top).perform()


def test_the_cursor_over_time_is_on_the_track_and_the_other_way_round(shown: Chrome, lap: Analysis) -> None:
    from selenium.webdriver.support.ui import WebDriverWait

    waiting = WebDriverWait(shown, 60.0)
    point_at(shown, "time", 60.0)
    waiting.until(lambda c: of_plot(c, "track", "!plot.querySelector('.cursor').hidden"))
    place = """(() => {
        const { xaxis, yaxis } = plot._fullLayout, ring = plot.querySelector(".cursor").style;
        return [xaxis.p2l(parseFloat(ring.left) - xaxis._offset), yaxis.p2l(parseFloat(ring.top) - yaxis._offset)];
    })()"""
    seconds = of_plot(shown, "time", "plot._hoverdata[0].x")
    step = int(np.abs(lap.run.time - seconds).argmin())
    np.testing.assert_allclose(of_plot(shown, "track", place), lap.run.pose[step, :2], atol=0.05)
    # one vertical line through all panels, and labels in each
    assert of_plot(shown, "time", "new Set(plot._hoverdata.map(point => point.yaxis._id)).size") == 4
    assert of_plot(shown, "time", "plot.querySelector('.hoverlayer .spikeline').getBBox().height") > 600
    x, y = lap.run.reference[4000, :2].tolist()
    point_at(shown, "track", x, y)
    waiting.until(lambda c: abs(of_plot(c, "time", "plot._hoverdata[0].x") - lap.run.time[4000]) < 1.0)
    assert complaints(shown) == []


def test_what_matters_is_shown_at_first_and_a_click_shows_the_rest(shown: Chrome, lap: Analysis) -> None:
    from selenium.webdriver.support.ui import WebDriverWait

    settled = lap.run.command[lap.run.time >= lap.deviation.since_seconds, 0]
    low, high = of_plot(shown, "time", "plot._fullLayout.yaxis3.range")
    assert low < settled.min() < settled.max() < high < 2.0 * settled.max()
    button = shown.find_element("id", "ranges")
    shown.execute_script("arguments[0].click()", button)
    waiting = WebDriverWait(shown, 60.0)
    waiting.until(lambda c: of_plot(c, "time", "plot._fullLayout.yaxis3.range[1]") > lap.run.command[:, 0].max())
    shown.execute_script("arguments[0].click()", button)
    waiting.until(lambda c: of_plot(c, "time", "plot._fullLayout.yaxis3.range") == [low, high])


def test_the_page_is_small_beside_its_library(page: Path) -> None:
    plotly: Any = importlib.import_module("plotly.offline")
    html = page.read_text()
    (library,) = re.findall(r'id="library">([^<]*)<', html)
    assert len(html) - len(library) < 2e6
    assert len(library) < 0.5 * len(plotly.get_plotlyjs())
    assert zlib.decompress(base64.b64decode(library)).decode() == plotly.get_plotlyjs()


def test_the_parameters_that_are_no_defaults_are_marked(shown: Chrome, lap: Analysis) -> None:
    assert not shown.find_element("id", "parameters").is_displayed()
    marked = shown.execute_script("return [...document.querySelectorAll('#parameters mark')].map(m => m.textContent)")
    # written down in config/outages.yaml, and other than the schema's defaults
    written = yaml.safe_load((REPOSITORY / "config/outages.yaml").read_text())
    uplink = {line.split(":")[0].strip() for line in marked if "uplink" in line}
    assert uplink == {"uplink.model", "uplink.p", "uplink.r"}
    assert "uplink" in f"{written}"
    assert f"{len(marked)} differ from the default" in shown.find_element("id", "of-parameters").text


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


def printed(chrome: Chrome, path: Path) -> Any:
    """The page as printed, an open PDF."""
    pdfium = pytest.importorskip("pypdfium2", reason="needs pypdfium2: pip install '.[test]'")
    show(chrome, path)
    a4 = {"paperWidth": 8.27, "paperHeight": 11.69, "printBackground": True}  # [inch]
    answer = chrome.execute_cdp_cmd("Page.printToPDF", a4)
    return pdfium.PdfDocument(base64.b64decode(answer["data"]))


def test_it_prints(chromium: Chrome, page: Path) -> None:
    document = printed(chromium, page)
    sheets = [sheet.render(scale=1.0).to_numpy()[..., :3].astype(int) for sheet in document]
    texts = [sheet.get_textpage().get_text_range() for sheet in document]
    assert 4 <= len(sheets) <= 11
    # white paper, with a margin on each side
    assert all((sheet == 255).all(axis=-1).mean() > 0.5 for sheet in sheets)
    inked = [(sheet < 200).any(axis=-1) for sheet in sheets]
    assert [i for i, ink in enumerate(inked) if ink[:, :30].any() or ink[:, -30:].any() or ink[:30].any()] == []
    titles = ("Track", "Errors, speed, age of information", "Outages of the uplink", "Eigenvalues")
    assert [title for title in titles if not any(title in text for text in texts)] == []
    assert any("Track" in text and "x [m]" in text for text in texts)  # its lower end, too
    # a plot that is not cut has the title of its axis in the middle of the sheet
    for title in ("time [s]", "length [slots]"):
        (sheet,) = (sheet for sheet, text in zip(document, texts, strict=True) if title in text)
        found, _ = sheet.get_textpage().search(title).get_next()
        left, _, _, _ = sheet.get_textpage().get_charbox(found)
        assert 0.45 < left / sheet.get_width() < 0.55, title


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


def rewritten(bag: Path, folder: Path) -> Path:
    """A bag as somebody with bad intentions would record it: topics, frames, texts, parameters, the file's name."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    folder.mkdir(parents=True)
    path = folder / "<img src=x onerror='window.harm = 1'>\u202e\"&.mcap"
    with next(bag.glob("*.mcap")).open("rb") as source, path.open("wb") as stream:
        reader, writer = make_reader(source), Writer(stream)
        writer.start("ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            if message.log_time >= 3_000_000_000:  # 400 steps are enough
                continue
            assert schema is not None
            if channel.id not in channels:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(f"/{HOSTILE}{channel.topic}", "cdr", known)
            data = badly_named(schema.name, message.data)
            writer.add_message(channels[channel.id], message.log_time, data, message.publish_time)
            if channel.topic == "/agv/pose" and message.log_time < 1_025_000_000:  # off the grid, as the report tells
                moved = data[:8] + (int.from_bytes(data[8:12], "little") + 1).to_bytes(4, "little") + data[12:]
                writer.add_message(channels[channel.id], message.log_time, moved, message.publish_time)
        for metadata in reader.iter_metadata():
            told = dict(metadata.metadata)
            if "params" in told:
                told["params"] = told["params"].replace("track_file: ''", f"track_file: {json.dumps(HOSTILE)}")
                assert "onerror" in told["params"]
            writer.add_metadata(metadata.name, told)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def badly_named(kind: str, data: bytes) -> bytes:
    """A message whose every string is hostile."""
    message: Any = STORE.deserialize_cdr(data, kind)
    if hasattr(message, "header"):
        message.header.frame_id = HOSTILE
    if hasattr(message, "child_frame_id"):
        message.child_frame_id = HOSTILE
    for status in getattr(message, "status", ()):
        status.name = status.message = status.hardware_id = HOSTILE
        for pair in status.values:
            pair.key = pair.value = HOSTILE
    return bytes(STORE.serialize_cdr(message, kind))


def test_a_hostile_recording_is_text_in_its_report(
    chromium: Chrome, agv_ncs: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    bad = rewritten(SAMPLE, tmp_path / "bags")
    status, said = agv_ncs("analyse", bad, "--picture", tmp_path / "a.png", "--report", tmp_path / "bad.html")
    assert status == 0, said[-500:]
    show(chromium, tmp_path / "bad.html")
    assert chromium.execute_script("return [typeof window.harm, document.images.length]") == ["undefined", 0]
    assert complaints(chromium) == []
    chromium.find_element("css selector", "#of-parameters summary").click()
    shown = chromium.execute_script("return document.body.innerText")
    # the topic's name in a note, the parameter, the file's name; nothing else of the recording is in the page
    assert f"/{HOSTILE}/agv/pose: 5 messages are not at a sampling instant" in shown
    parameters = yaml.safe_load(chromium.find_element("id", "parameters").text)
    assert parameters["error_detector"]["ros__parameters"]["track_file"] == HOSTILE
    assert bad.name in shown


def pointed_at(chrome: Chrome, at: int, step: int) -> str:
    """What the page shows beside the pointer over the place where the pose of this step was lost."""
    from selenium.webdriver.support.ui import WebDriverWait

    number = of_plot(chrome, "track", "plot._fullData.findIndex(trace => trace.name == 'pose lost')")
    of_plot(chrome, "track", f"Plotly.Fx.hover(plot, [{{curveNumber: {number}, pointNumber: {at}}}])")
    text = "plot.querySelector('.hoverlayer').textContent"  # drawn a moment later
    WebDriverWait(chrome, 60.0).until(lambda c: f"step {step}, (" in of_plot(c, "track", text))
    return str(of_plot(chrome, "track", text))


def test_a_lost_pose_says_its_step_and_why_it_was_lost(chromium: Chrome, tmp_path: Path) -> None:
    settings = ("plant.duration=20.0", "relay.uplink.schedule=5: outage=0.05; 5.1: outage=0")
    run = simulate(scenario_of(*settings))
    assert run.uplink is not None
    lost = np.flatnonzero(run.lost)
    write_report(analyse(run), tmp_path / "lost.html")
    show(chromium, tmp_path / "lost.html")
    for cause in ("gilbert_elliott", "outage"):
        at = int(np.flatnonzero(run.uplink.cause[lost] == cause)[0])
        said = pointed_at(chromium, at, run.k[lost[at]])
        assert said.endswith(f"cause: {cause}"), said
    assert complaints(chromium) == []


@pytest.mark.parametrize(
    "causes",
    [[HOSTILE], [HOSTILE, "<a href='javascript:window.harm=1'>x</a>", "%{x}<b>", "", "\x01", "a" * 5000, "&lt;"]],
    ids=["one", "several"],
)
def test_a_hostile_cause_is_text_beside_the_pointer(chromium: Chrome, tmp_path: Path, causes: list[str]) -> None:
    run = read_run(SAMPLE)
    assert run.uplink is not None
    lost, said = np.flatnonzero(run.lost), np.full(len(run), "", dtype="<U5000")
    said[lost] = np.resize(causes, len(lost))
    bad = dataclasses.replace(run, uplink=dataclasses.replace(run.uplink, cause=said))
    write_report(analyse(bad), tmp_path / "bad.html")
    show(chromium, tmp_path / "bad.html")
    for at, cause in enumerate(causes):
        shown = pointed_at(chromium, at, run.k[lost[at]])
        assert f"cause: {cause[:60] or 'not recorded'}" in shown, shown
        assert of_plot(chromium, "track", "plot.querySelectorAll('.hoverlayer a').length") == 0
    assert chromium.execute_script("return [typeof window.harm, document.images.length]") == ["undefined", 0]
    assert complaints(chromium) == []


def test_without_a_word_of_the_causes_the_steps_are_there() -> None:
    run = dataclasses.replace(read_run(SAMPLE), uplink=None)
    line = track(run).lines[-1]
    few = thinned(line, 20)
    assert few.slots is not None
    rows = np.searchsorted(run.k, few.slots.k)
    np.testing.assert_array_equal(run.pose[rows, :2], np.column_stack([few.x, few.y]))
    assert set(few.slots.cause.tolist()) == {""}


def test_what_turns_letters_round_ends_where_it_began(chromium: Chrome, tmp_path: Path) -> None:
    run = dataclasses.replace(read_run(SAMPLE), source="\u202etneconni.mcap")
    write_report(analyse(run), tmp_path / "round.html")
    show(chromium, tmp_path / "round.html")
    # of a text that runs from left to right, what comes later is further right
    places = chromium.execute_script("""
        const text = document.querySelector("#verdict + p").lastChild, range = document.createRange();
        return ["steps", " ms"].map(word => {
            range.setStart(text, text.data.indexOf(word));
            range.setEnd(text, text.data.indexOf(word) + word.length);
            return range.getBoundingClientRect().left;
        });
    """)
    assert places[0] < places[1]


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


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (("relay.downlink.p=0.3",), "on radio links like these, which lose commands as well"),
        (("relay.downlink.p=0.98",), "does not keep to its track: losses on both links, of poses and of commands, are"),
        (("relay.downlink.p=0.3", "plant.downlink_policy=ramp", "plant.ramp_time=5.0"), "downlink policy ramp"),
    ],
)
def test_the_sentence_does_not_blame_the_uplink_for_the_downlink(settings: tuple[str, ...], said: str) -> None:
    lossy = ("relay.uplink.model=perfect", "relay.downlink.model=bernoulli", "error_detector.track=line")
    assert said in sentence(analyse(simulate(scenario_of(*lossy, *settings))))


@pytest.mark.parametrize(
    ("delay", "expected"),
    [
        (0.06, "The AGV keeps to its track with poses up to 12 steps (60 ms) old."),
        (0.065, "The AGV does not keep to its track: poses up to 13 steps (65 ms) old are too much for these gains."),
    ],
)
def test_old_poses_are_no_outages(delay: float, expected: str) -> None:
    late = ("error_detector.track=line", f"relay.uplink.delay={delay}", "plant.duration=10.0")
    analysis = analyse(simulate(scenario_of(*late, config="paper")))
    assert sentence(analysis) == expected
    assert f"relay.uplink.delay is {delay}" in render(analysis)  # which the margins do not know of


def test_eigenvalues_that_are_drawn_are_those_that_were_judged(lap: Analysis) -> None:
    assert np.abs(lifted_multipliers(lap)).max() == pytest.approx(lap.lifted_radius, rel=1e-9)
    assert lap.paper is not None
    assert np.abs(paper_eigenvalues(lap.run)).max() <= lap.paper.radius * (1.0 + 1e-9)


def test_the_track_has_the_colour_of_the_deviation(lap: Analysis) -> None:
    run = lap.run
    lines = {line.name: line for line in next(iter(panels(lap))).lines}
    bounds = {"AGV within 1 mm": 1e-3, "within 1 cm": 1e-2, "within 10 cm": 0.1, "within 1 m": 1.0, "farther away": 9e9}
    assert list(bounds) == [name for name in lines if name in bounds]
    at = {(x, y): row for row, (x, y) in enumerate(run.pose[:, :2].tolist())}
    far = np.hypot(*(run.pose[:, :2] - run.reference[:, :2]).T)
    on_top: dict[int, float] = {}
    for name, most in bounds.items():
        x, y = lines[name].x, lines[name].y
        for i in np.flatnonzero(np.isfinite(x[:-1]) & np.isfinite(x[1:])):
            first, last = at[x[i], y[i]], at[x[i + 1], y[i + 1]]
            assert last - first == 2 or last == len(run) - 2  # 20 000 steps are drawn in 10 000 stretches
            on_top[first] = most
    expected = {first: min(m for m in bounds.values() if far[first : first + 2].max() < m) for first in on_top}
    assert on_top == expected
    assert len(on_top) >= len(run) // 2 - 1
    assert all(line.style != HALOS or line.name == "pose lost" for line in lines.values())


def test_a_thinned_line_keeps_its_gaps() -> None:
    y = np.sin(np.arange(50_000.0))
    y[12_345] = y[40_000] = np.nan
    line = thinned(Line("gaps", np.arange(50_000.0), y, "driven", LINE), 1000)
    assert np.isnan(line.y).sum() == 2


def test_the_eigenvalues_that_decide_are_named(lap: Analysis) -> None:
    circle = next(panel for panel in panels(lap) if panel.key == "eigenvalues")
    lifted, paper = (line for line in circle.lines if line.style == RINGS)
    assert lap.paper is not None
    assert lifted.name == f"lifted system, largest: |z| = {lap.lifted_radius:.5g}"
    assert np.hypot(lifted.x[0], lifted.y[0]) == pytest.approx(lap.lifted_radius)
    assert float(paper.name.split()[-1]) <= lap.paper.radius * (1.0 + 1e-4)


def test_what_a_run_leaves_open_is_beside_its_verdict(lap: Analysis) -> None:
    assert any("the run was simulated" in line for line in cannot_say(lap))
    sample = read_run(SAMPLE)
    unknown = list(cannot_say(observe(dataclasses.replace(sample, gains_known=False))))
    assert any("name its params file with --config" in line for line in unknown)
    assert any(line.startswith("What follows an outage of more than") for line in unknown)
    few = analyse(simulate(scenario_of("plant.duration=3.0", "relay.uplink.p=0.05")))
    open_questions = " ".join(cannot_say(few))
    if few.verdict.word == "undecided":
        assert few.verdict.reason in open_questions


def test_a_confidence_is_not_rounded_to_certainty() -> None:
    assert confidence_text(0.99996) == "stable with a probability above 99.9 %"
    assert confidence_text(0.0000001) == "stable with a probability below 0.1 %"
    assert confidence_text(1.0) == "stable with a probability of 100 %"
    assert confidence_text(0.9566) == "stable with a probability of 95.7 %"


@pytest.mark.parametrize(
    ("probability", "said"),
    [(1.0, "above 99.9 %"), (0.5, "50 %"), (2e-5, "2e-05"), (2.95e-66, "below 1e-12"), (0.0, "below 1e-12")],
)
def test_what_was_computed_is_never_certain(probability: float, said: str) -> None:
    assert computed(probability) == said


def test_an_unstable_loop_is_not_called_surely_stable() -> None:
    """No pose is lost, so that losses leave it stable, but each is 13 steps old: that is too old."""
    late = analyse(simulate(scenario_of("relay.uplink.delay=0.065", "error_detector.track=line", config="paper")))
    assert late.verdict.word == "unstable"
    assert next(tiles(late)).note == ""
    assert how_sure(analyse(simulate(scenario_of(config="paper")))) == "stable with a probability of 100 %"


def test_no_axis_goes_to_absurd_numbers() -> None:
    """At K_x = 390 the loop diverges: distances to 10^20 m and speeds say no more than that."""
    run = simulate(scenario_of("controller.kx=390.0", "plant.duration=50.0", "relay.uplink.p=0.1"))
    assert np.abs(run.command[:, 0]).max() > 1e6
    drawn = figure([distance(run), speed(run)])
    assert drawn["layout"]["yaxis"]["range"] == [-6.0, 5.0]  # logarithms of metres
    assert max(map(abs, drawn["layout"]["yaxis2"]["range"])) < 3e5
    calm = simulate(scenario_of("plant.duration=5.0"))
    assert distance(calm).y_range is None
    panel = beside(distance(calm), distance(run))
    assert panel.y_range == (1e-6, 1e5)


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
    options = ["--set", "plant.duration=5.0", "--seeds", "3", "--report", tmp_path / "s.html", "--figures", tmp_path]
    words = [] if len(axes) == 1 else ["--no-verdicts"]
    status, said = agv_ncs("sweep", "config/outages.yaml", *varied, *options, *words)
    assert status == 0, said
    show(chromium, tmp_path / "s.html")
    assert complaints(chromium) == []
    points = 2 ** len(axes)
    verdict = chromium.find_element("id", "verdict").text
    assert verdict == (
        "Stable in all runs and by the verdict for controller.kx <= 25 (1 of 2 points)."
        if len(axes) == 1
        else "Of 4 points the loop is stable in all runs at 2, and in no run at 2."
    )
    assert of_plot(chromium, "instability", "plot._fullData[0].type") == kind
    assert len(chromium.find_elements("css selector", "#points tr")) == points + 1
    assert len(chromium.find_elements("css selector", "#points th")) <= 10
    # a click on a point shows it, with its lap: here at the first value of each axis
    click = "(plot.emit('plotly_click', {points: [{x: 25, y: 0}]}), 1)"
    of_plot(chromium, "instability", click)
    assert "--set controller.kx=25.0" in chromium.find_element("id", "point-command").text
    first = chromium.find_element("css selector", "#points tr.chosen")
    values = [cell.text for cell in first.find_elements("css selector", "td")]
    assert [c.text for c in chromium.find_elements("css selector", "#point-values td")] == values
    settings = ["controller.kx=25.0", *(["relay.uplink.p=0.0"] if len(axes) == 2 else []), "plant.duration=5.0"]
    run = simulate(scenario_of(*settings))
    drawn = of_plot(chromium, "lap", "Array.from(plot.data[0].y)")
    far = np.hypot(*(run.pose[:, :2] - run.reference[:, :2]).T)
    assert (max(drawn), drawn[-1]) == pytest.approx((far.max(), max(far[-1], 1e-6)), rel=1e-5)
    saved = chromium.execute_script("window.save = (name, text) => { window.saved = text }; return 1")
    assert saved == 1
    chromium.find_element("id", "save-csv").click()
    table = list(csv.DictReader(chromium.execute_script("return window.saved").splitlines()))
    assert len(table) == points
    assert {"controller.kx", "iae_p95", "version"} <= set(table[0])
    assert (tmp_path / "instability.svg").is_file()


def swept(*axes: str) -> Sweep:
    base = scenario_of("relay.uplink.model=bernoulli", "error_detector.track=line")
    return Sweep(base, tuple(parse_axis(axis) for axis in axes), 1)


def calm(sweep: Sweep) -> list[dict[str, Any]]:
    """Rows of a sweep that nobody has run: what is stable does not matter here."""
    told: dict[str, Any] = {
        "instability": 0.0,
        "instability_low": 0.0,
        "instability_high": 1.0,
        "unstable": 0,
        "settles_without_losses": True,
        "runs": 1,
    }
    told |= {f"{metric}_{quantile}": 0.0 for metric in METRICS for quantile in ("p50", "p95")}
    names = [axis.name for axis in sweep.axes]
    return [dict(zip(names, sweep.values(i), strict=True)) | told for i in range(sweep.size)]


def test_theory_s_border_is_drawn_in_a_sweep_s_map(chromium: Chrome, tmp_path: Path) -> None:
    sweep = swept("controller.kx=50:390:3", "relay.uplink.p=0.05:0.9:3")
    write_sweep_report(sweep, calm(sweep), tmp_path / "s.html", "agv-ncs sweep")
    show(chromium, tmp_path / "s.html")
    assert complaints(chromium) == []
    names = of_plot(chromium, "instability", "plot.data.map(trace => trace.name)")
    assert names[1:] == ["border: mean square", "border: almost surely"]  # the others have none here
    # points of the line as it is drawn, back from pixels to the axes' units
    script = """(() => {
        const { xaxis, yaxis } = plot._fullLayout, path = plot.querySelector(".contourlevel path");
        return [...Array(21).keys()].map(i => path.getPointAtLength(path.getTotalLength() * i / 20))
            .map(point => [xaxis.p2d(point.x), yaxis.p2d(point.y)]);
    })()"""
    kx, p = np.array(of_plot(chromium, "instability", script)).T
    a = 0.005 * kx
    np.testing.assert_allclose(p, (2.0 - a) / (2.0 + a), atol=0.01)  # independent losses, mean square
    assert np.ptp(kx) > 200.0


def test_theory_s_border_is_drawn_in_a_sweep_s_curve() -> None:
    sweep = swept("relay.uplink.p=0.5:0.99:3")
    traces = {trace["name"]: trace for trace in sweep_figure(sweep, calm(sweep))["data"]}
    x, again, gap = traces["border: mean square"]["x"]
    a = 0.005 * 25.0
    assert (x, gap) == (again, None)
    assert x == pytest.approx((2.0 - a) / (2.0 + a), abs=0.01)


def test_margins_in_a_page_are_plain_text() -> None:
    """The terminal would take brackets for a colour; a page shows what escapes them."""
    lossy = [f"relay.{link}.{setting}" for link in ("uplink", "downlink") for setting in ("model=bernoulli", "p=0.1")]
    text = render(analyse(simulate(scenario_of(*lossy, "plant.duration=5.0"))))
    assert "E[e^2] dies out, shrinks by" in text
    assert "E\\[" not in text


def test_a_reference_that_the_parameters_do_not_name_has_no_margins_and_says_so(lap: Analysis) -> None:
    run = simulate(scenario_of("plant.duration=5.0"))
    moved = dataclasses.replace(run, reference=run.reference + np.array([0.0, 0.1, 0.0, 0.0, 0.0]))
    assert "not the track that its parameters name" in render(analyse(moved))
    assert "not the track that its parameters name" not in render(analyse(run))


def test_a_track_from_a_file_has_margins(tmp_path: Path) -> None:
    (tmp_path / "line.csv").write_text("t,v,w\n0.0,1.0,0.0\n5.0,1.0,0.0\n")
    track = ("error_detector.track=csv", f"error_detector.track_file={tmp_path / 'line.csv'}", "plant.duration=5.0")
    html = render(analyse(simulate(scenario_of(*track))))
    assert "12 steps (60 ms)" in html  # a pose that is always that old, along a line with K_x = 25


def test_a_folder_that_cannot_be_written_to_is_named(lap: Analysis, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="file: cannot be written to"):
        draw_figures(panels(lap), tmp_path / "file")


def test_a_recording_that_proves_nothing_says_so_first_and_judges_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    run = simulate(scenario_of("plant.duration=2.0"))
    judged = re.compile(r"stable|asymptotic|mean-square|bounded|Verdict|Margin|They disagree", re.IGNORECASE)
    print_table(analyse(run))
    print_side_by_side({"one": analyse(run)})
    assert judged.search(capsys.readouterr().out)
    damaged = analyse(dataclasses.replace(run, unexplained={"agv/pose": 3}))
    print_table(damaged)
    said = capsys.readouterr().out
    assert said.startswith("Invalid: 3 messages of agv/pose are missing, and no channel lost them.\n")
    assert "not judged: messages are missing that no channel lost" in " ".join(said.split())
    assert not judged.search(said)
    print_side_by_side({"one": damaged})
    said = capsys.readouterr().out
    assert said.startswith("one is invalid: 3 messages of agv/pose are missing.\n")
    assert not judged.search(said)
