"""The explorer: its page moved in headless Chromium as a person would, its answers against simulation and theory."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import math
import os
import re
import signal
import socket
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from http.client import HTTPException
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

import numpy as np
import pytest

from agv_analysis.corridor.corridor import NOT_ALONE
from agv_analysis.explore.background_criteria import (
    LatestOnlyWorker,
    compared_criteria_rows,
    criteria_rows,
    tube_traces,
)
from agv_analysis.explore.page_server import listener
from agv_analysis.explore.positions import from_hash, position_of, to_hash, value_of
from agv_analysis.explore.response import respond, summary_rows, with_channel_of
from agv_analysis.explore.settings import PRESETS, preset_values, scenario_of, settings_of, values_of
from agv_analysis.explore.sliders import SLIDERS, gain_slider
from agv_analysis.report.tiles import confidence_text
from agv_analysis.report.verdict_sentence import sentence
from agv_analysis.scenario import load_scenario, parse_scenario
from agv_analysis.simulation.single import simulate
from agv_analysis.stability.analysis import analyse
from agv_ros.errors import UserError
from agv_ros.parameters import Parameter, ParameterError

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

    from agv_analysis.scenario import Scenario
    from test.conftest import Start

REPOSITORY = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def base() -> Scenario:
    return load_scenario(str(REPOSITORY / "config/outages.yaml"))


def test_a_page_that_nobody_has_touched_is_the_scenario_of_the_file(base: Scenario) -> None:
    assert settings_of(base, values_of(base)) == []
    assert scenario_of(base, values_of(base)) == base


def test_what_a_slider_says_arrives_in_the_scenario(base: Scenario) -> None:
    moved = {
        "kx": 40,
        "ts": 10,
        "v_max": 6,
        "ahead": 1.5,
        "left": -0.5,
        "n": 3,
        "seed": 9,
        "track": "eight",
        "delay": 30,
    }
    found = scenario_of(base, {**values_of(base), **moved, "more": " plant.duration=50\n\nplant.integration=arc"})
    assert (found.controller.kx, found.plant.ts, found.controller.v_max) == (40.0, 0.01, 6.0)
    # the track starts northwards: ahead is y, left is -x
    np.testing.assert_allclose(found.plant.initial_pose[:2], (0.5, 1.5), atol=1e-12)
    assert (found.relay.uplink.n, found.relay.seed, found.error_detector.track) == (3, 9, "eight")
    assert found.relay.uplink.delay == 0.03
    assert (found.plant.duration, found.plant.integration) == (50.0, "arc")
    again = {key: value for key, value in values_of(found).items() if key in moved}
    assert again == pytest.approx({k: v for k, v in moved.items() if k != "track"} | {"track": "eight"})


def test_a_slider_for_a_gain_reaches_from_its_bound_to_four_times_its_default() -> None:
    def ends(default: float, low: float | None, high: float | None, above: float | None = None) -> tuple[float, ...]:
        known = Parameter("k", "double", default, "1/s", "gain", low, high, above)
        found = gain_slider("k", "controller.law.k", "k", known)
        return found.low, found.high, found.step

    assert ends(2.0, 0.0, 1e6) == (0.0, 8.0, 0.1)
    assert ends(2.0, None, None) == (0.0, 8.0, 0.1)
    assert ends(2.0, 1.0, 3.0) == (1.0, 3.0, 0.02)
    assert ends(-2.0, None, None) == (-8.0, 0.0, 0.1)
    assert ends(0.5, None, 10.0, 0.0) == (0.02, 2.0, 0.02)
    assert ends(0.0, 0.0, 1e6) == (0.0, 1.0, 0.01)
    assert ends(math.inf, None, math.inf, 0.0) == (0.2, 20.0, 0.2)
    limit = Parameter("w_max", "double", math.inf, "rad/s", "limit", None, math.inf, 0.0)
    assert gain_slider("k", "controller.law.w_max", "w_max", limit).label == "w_max [rad/s], 20: none"


def test_a_logarithmic_slider_goes_there_and_back_and_leaves_what_was_not_touched(base: Scenario) -> None:
    kx = next(slider for slider in SLIDERS if slider.key == "kx")
    assert kx.is_log
    values = [kx.value_at(position) for position in range(301)]
    assert (values[0], values[-1]) == (0.0, 400.0)
    ratios = np.array(values[2:]) / np.array(values[1:-1])
    assert 1.01 < ratios.min() < ratios.max() < 1.04
    assert [kx.value_at(kx.position_of(value)) for value in values] == values
    odd = base.with_settings(["controller.kx=25.0123"], "test")
    at_first = values_of(odd)
    untouched = {key: value_of(key, position_of(key, value), at_first) for key, value in at_first.items()}
    assert scenario_of(odd, untouched) == odd


def test_an_address_and_a_setting_say_the_same(base: Scenario) -> None:
    at_first = values_of(base)
    now = {**at_first, "kx": 40.5, "track": "eight", "more": "plant.lag=0.1\nplant.duration=9.0"}
    assert {**at_first, **from_hash(f"#{to_hash(now, at_first)}", at_first)} == now
    assert to_hash(at_first, at_first) == ""
    assert from_hash("#kx=NaN&p=true&track=[]&more=5&law=%22x%22&" + "kx=" + "[" * 9999, at_first) == {}


def test_what_is_set_for_a_law_goes_with_it(base: Scenario) -> None:
    def chosen(start: Scenario = base, **moved: Any) -> Scenario:
        return scenario_of(start, {**values_of(start), **moved})

    found = scenario_of(base, {**values_of(base), "law": "state_feedback", "state_feedback-ky": 3.5, "kx": 7})
    assert (found.controller.gains, found.controller.kx) == ((2.0, 3.5, 2.0), 7.0)
    assert found.controller.look_ahead == 0.0
    ahead = chosen(law="pure_pursuit")
    assert {node.look_ahead for node in (ahead.plant, ahead.relay, ahead.controller, ahead.error_detector)} == {0.5}
    assert chosen(law="pure_pursuit", look_ahead=200).controller.look_ahead == 0.2
    assert settings_of(ahead, values_of(ahead)) == []
    assert chosen(ahead, look_ahead=200).controller.look_ahead == 0.2
    assert chosen(ahead, law="kanayama").controller.look_ahead == 0.0
    assert chosen(vehicle="bicycle", policy="align").plant.vehicle == "bicycle"
    for key in PRESETS:
        other = ahead.with_settings(["plant.vehicle=bicycle"], "test")
        shown = scenario_of(other, preset_values(other, key))
        assert shown == scenario_of(base, preset_values(base, key))


@pytest.mark.parametrize("more", ["controller.kx=-1.0", "plant.color=red", "relay.uplink.model=trace", "nonsense"])
def test_what_is_not_allowed_is_refused_with_the_reason(base: Scenario, more: str) -> None:
    with pytest.raises(ParameterError):
        scenario_of(base, {**values_of(base), "more": more})


def test_the_pinned_setting_meets_the_same_outages(base: Scenario) -> None:
    pinned = scenario_of(base, {**values_of(base), "kx": 5, "model": "perfect", "seed": 3})
    now = scenario_of(base, {**values_of(base), "kx": 40, "seed": 8})
    runs = simulate(now), simulate(with_channel_of(pinned, now))
    np.testing.assert_array_equal(runs[0].lost, runs[1].lost)
    assert runs[0].lost.any()
    assert runs[1].scenario.controller == pinned.controller
    slower = scenario_of(base, {**values_of(base), "ts": 10})
    assert simulate(with_channel_of(slower, now)).ts == 0.01


def test_a_corridor_is_answered_at_every_move(base: Scenario) -> None:
    """From some places of the lap: on a line all of them are the same, and a v T_s n (n + 1) / 2 = 0.25 m decides."""
    with_corridor = base.with_settings(["error_detector.corridor=0.25", "error_detector.track=line"])
    found = {name: value for name, value, _ in respond(with_corridor).rows}
    assert found["One outage in the corridor"].startswith("about 27 slots")
    pinned = {name: other for name, _, other in respond(with_corridor, base).rows}
    assert pinned["One outage in the corridor"] == ""


def test_a_tube_is_drawn_along_the_track_once_it_is_known(base: Scenario) -> None:
    assert tube_traces(base) == []
    on_a_line = base.with_settings(["error_detector.corridor=0.25", "error_detector.track=line"])
    edge, tube = tube_traces(on_a_line)
    assert edge["name"] == "corridor"
    assert (
        tube["name"].replace("<br>", " ") == "tube for any outages up to 14 slots (of the linear loop)"
    )  # 15 let errors grow
    late = on_a_line.with_settings(["relay.uplink.delay=0.05"])
    names = [trace["name"] for trace in tube_traces(late)]
    assert [name.replace("<br>", " ") for name in names] == [f"corridor (no tube: {NOT_ALONE})"]
    assert max(map(len, names[0].split("<br>"))) <= 40  # of what a phone has room for


def test_both_runs_are_drawn(base: Scenario) -> None:
    found = respond(base, dataclasses.replace(base, controller=dataclasses.replace(base.controller, kx=5.0)))
    assert [trace["name"] for trace in found.track["data"]] == ["reference", "AGV", "pose lost", "pinned"]
    assert [trace["name"] for trace in found.time["data"]].count("pinned") == 3
    assert all(len(row) == 3 and row[2] for row in found.rows)
    assert all(trace["type"] == "scatter" for trace in found.time["data"])


def test_a_pinned_setting_has_margins_of_its_own_under_the_same_outages(base: Scenario) -> None:
    slow = dataclasses.replace(base, controller=dataclasses.replace(base.controller, kx=5.0))
    both = {name: (value, other) for name, value, other in compared_criteria_rows(base, slow)}
    assert both["Pose always n steps old"] == ("12 steps (60 ms)", "62 steps (310 ms)")
    assert both["Any outages up to n"] == ("14 steps (70 ms)", "78 steps (390 ms)")
    alone = criteria_rows(slow)
    assert {name: other for name, (_, other) in both.items()} == dict(alone)


def test_each_row_of_the_lap_has_a_name_of_its_own(base: Scenario) -> None:
    """By which a pinned setting's value comes beside it."""
    on_a_line = base.with_settings(["error_detector.corridor=0.25", "error_detector.track=line", "plant.duration=20.0"])
    names = [name for name, _ in criteria_rows(on_a_line)]
    assert len(names) == len(set(names))
    assert {"Outages in any order", "Any outages up to n"} <= set(names)


def test_what_diverges_has_no_metres(base: Scenario) -> None:
    late = scenario_of(base, {**preset_values(base, "missed"), "more": "error_detector.corridor=0.25"})
    rows = dict(criteria_rows(late))
    assert rows["RMS deviation"].startswith("diverges in the simulated laps")
    assert not [value for value in rows.values() if re.search(r"e\+\d+ m\b", value)]


def test_the_losses_of_a_run_are_judged_as_the_analysis_does(base: Scenario) -> None:
    found = dict(criteria_rows(base))
    analysis = analyse(simulate(base))
    assert found["Verdict"] == sentence(analysis)
    assert analysis.floquet is not None
    shrinks = f"{100.0 * (1.0 - analysis.floquet):.2g} %"
    assert found["This loss sequence (Floquet)"] == f"stable: errors shrink by {shrinks} per step"


def test_of_calls_that_wait_only_the_newest_is_made(tmp_path: Path) -> None:
    pipe, file = tmp_path / "pipe", tmp_path / "file"
    os.mkfifo(pipe)
    file.write_text("later")
    newest: LatestOnlyWorker[str] = LatestOnlyWorker(Path.read_text)
    try:
        with ThreadPoolExecutor(3) as threads:
            first = threads.submit(newest, pipe)
            with pipe.open("w") as writer:  # opens once it is read from: the first call has its turn
                others = [threads.submit(newest, file) for _ in range(2)]
                done, _ = wait(others, timeout=60.0, return_when=FIRST_COMPLETED)
                assert [call.result() for call in done] == [None]  # without waiting for the first
                writer.write("first")
            assert first.result(60.0) == "first"
            assert {call.result(60.0) for call in others} == {None, "later"}
    finally:
        newest.close()


def test_a_call_waits_whether_a_newer_one_comes(tmp_path: Path) -> None:
    newest: LatestOnlyWorker[str] = LatestOnlyWorker(Path.read_text, rest=600.0)
    with ThreadPoolExecutor(2) as threads:
        calls = [threads.submit(newest, tmp_path / "file") for _ in range(2)]  # there is no such file
        done, waits = wait(calls, timeout=60.0, return_when=FIRST_COMPLETED)
        assert [call.result() for call in done] == [None]
        newest.close()
        assert [call.result(60.0) for call in waits] == [None]


def test_the_presets_tell_the_story(base: Scenario) -> None:
    def late(key: str) -> tuple[float, str]:
        run = simulate(scenario_of(base, preset_values(base, key)))
        distance = np.hypot(*(run.reference[:, :2] - run.pose[:, :2]).T)
        return float(distance[-1]), dict(summary_rows(run))["Paper's test"]

    assert list(PRESETS) == ["paper", "missed", "predicted"]
    assert late("paper")[0] < 1e-6
    error, paper = late("missed")
    assert paper == "tolerates any number of consecutive outages"
    assert error > 1e3
    assert late("predicted")[0] < 1e-6


def test_a_preset_undoes_what_the_file_says_of_radio_and_agv(base: Scenario) -> None:
    """Whatever the page was started with, a preset shows what its text says, and the page shows what it took."""
    worse = [
        "relay.uplink.jitter=0.05", "relay.downlink.model=bernoulli", "relay.downlink.p=0.3", "plant.lag=0.2",
        "relay.uplink.schedule=10: outage=3", "relay.uplink.lifetime=0.05", "plant.speed_scale=0.8",
    ]  # fmt: skip
    spoilt = base.with_settings([*worse, "plant.duration=50.0"], "test")
    for key in PRESETS:
        values, expected = preset_values(spoilt, key), scenario_of(base, preset_values(base, key))
        assert len(values["more"].splitlines()) == len(worse)
        found = scenario_of(spoilt, values)
        assert found == dataclasses.replace(expected, plant=dataclasses.replace(expected.plant, duration=50.0))


def test_the_counterexample_is_a_pose_that_is_always_as_old(base: Scenario) -> None:
    scenario = scenario_of(base, preset_values(base, "missed"))
    run = simulate(scenario)
    assert set(run.n_ul[20:].tolist()) == {13}
    assert not run.lost.any()
    # the eigenvalues that the preset's text names, of the closed loop with a fresh pose: 1 - a, and (eq. 21) with
    # b = T_s v K_theta, c = T_s^2 v^2 K_y the roots of mu^2 - b mu + c, of which they are 1 - mu
    gains, v = scenario.controller, run.reference[-1, 3]
    b, c = 0.005 * v * gains.ktheta, (0.005 * v) ** 2 * gains.ky
    found = [1.0 - 0.005 * gains.kx, *(1.0 - np.roots([1.0, -b, c]))]
    np.testing.assert_allclose(found, [0.875, 0.995, 0.995], atol=1e-6)
    # a recursion of its own along the track: e(k+1) = e(k) - a e(k-13)
    e = [-5.0] * 14
    for _ in range(400):
        e.append(e[-1] - 0.125 * e[-14])
    assert max(map(abs, e[-60:])) > max(map(abs, e[100:160]))


# -- in the browser ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def address(base: Scenario) -> Iterator[str]:
    """The explorer, served by this process."""
    import threading

    from agv_analysis.explore.app import HOST, build
    from agv_analysis.explore.background_criteria import LatestOnlyWorker, compared_criteria_rows

    pytest.importorskip("dash", reason="needs Dash: pip install '.[explore]'")
    from werkzeug.serving import make_server

    lap = LatestOnlyWorker(compared_criteria_rows)
    server = make_server(HOST, 0, build(base, lap).server, threaded=True)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://{HOST}:{server.server_port}/"
    server.shutdown()
    thread.join()
    lap.close()
    server.server_close()


class Page:
    """The page as a person has it before them."""

    def __init__(self, chrome: Chrome) -> None:
        self.chrome = chrome

    def text(self, name: str) -> str:
        return self.chrome.find_element("id", name).text

    def until(self, condition: Callable[[], Any]) -> None:
        from selenium.common.exceptions import StaleElementReferenceException
        from selenium.webdriver.support.ui import WebDriverWait

        ignored = [StaleElementReferenceException]
        WebDriverWait(self.chrome, 300.0, 0.05, ignored_exceptions=ignored).until(lambda _: condition())

    def click(self, name: str) -> None:
        self.chrome.execute_script("arguments[0].click()", self.chrome.find_element("id", name))

    def slider(self, name: str) -> Any:
        return self.chrome.find_element("css selector", f"#{name} [role=slider]")

    def names(self, plot: str) -> list[str]:
        script = f"return document.querySelector('#plot-{plot} .js-plotly-plot').data.map(trace => trace.name)"
        found: list[str] = self.chrome.execute_script(script)
        return found


@pytest.fixture
def page(chromium: Chrome, address: str) -> Page:
    chromium.get_log("browser")  # type: ignore[no-untyped-call]
    chromium.get(address)
    page = Page(chromium)
    page.until(lambda: "Paper's test" in page.text("summary"))
    return page


def complaints(page: Page) -> list[str]:
    log = page.chrome.get_log("browser")  # type: ignore[no-untyped-call]
    return [entry["message"] for entry in log if entry["level"] == "SEVERE"]


def test_moving_a_slider_simulates_anew(page: Page) -> None:
    from selenium.webdriver.common.keys import Keys

    assert "up to 14 along" in page.text("summary")
    handle = page.slider("kx")
    handle.send_keys(Keys.PAGE_UP)  # ten steps at once
    page.until(lambda: "up to 14 along" not in page.text("summary"))
    kx = float(page.text("kx-value"))
    n = int(np.ceil(2.0 / (0.005 * kx)) - 2.0)  # T_s K_x L < 2 with L = n + 1
    assert kx > 25.0
    page.until(lambda: f"up to {n} along" in page.text("summary"))
    assert page.text("problem") == ""
    assert complaints(page) == []


def choose(page: Page, key: str, name: str) -> None:
    """Take a name out of a drop-down list."""
    page.click(key)
    option = f"//div[contains(@class, 'dash-dropdown-content')]//label[normalize-space(.)='{name}']"
    page.until(lambda: page.chrome.find_elements("xpath", option))
    page.chrome.find_element("xpath", option).click()


def test_a_law_brings_its_own_sliders(page: Page) -> None:
    from selenium.webdriver.common.keys import Keys

    def shown() -> list[str]:
        return [key for key in SHOWN_FOR_A_LAW if page.chrome.find_element("id", key).is_displayed()]

    from agv_analysis.explore.page_layout import SHOWN_FOR_A_LAW

    assert shown() == ["gains-of-kanayama"]
    choose(page, "law", "pure_pursuit")
    page.until(lambda: shown() == ["gains-of-pure_pursuit", "sliders-ahead"])
    page.slider("pure_pursuit-kx").send_keys(Keys.PAGE_UP)
    page.slider("look_ahead").send_keys(Keys.ARROW_LEFT)
    page.until(lambda: page.slider("look_ahead").get_attribute("aria-valuenow") == "490")
    page.until(lambda: page.text("pure_pursuit-kx-value") != "2")
    page.click("export")
    page.until(lambda: "law: pure_pursuit" in page.text("exported"))
    found = parse_scenario(page.text("exported").partition("\n\n")[2], "exported")
    assert found.controller.gains == (float(page.text("pure_pursuit-kx-value")), 0.1)
    assert 2.0 < found.controller.gains[0] < 3.0
    assert found.controller.look_ahead == 0.49
    assert page.text("problem") == ""
    assert "downloads" in page.text("export-said")
    choose(page, "law", "kanayama")
    page.until(lambda: shown() == ["gains-of-kanayama"])
    page.until(lambda: page.text("exported") + page.text("export-said") == "")
    page.until(lambda: "Paper's test" in page.text("summary") and page.text("problem") == "")
    assert complaints(page) == []


def test_an_answer_that_takes_long_dims_what_is_of_the_setting_before(
    page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    import threading

    from selenium.webdriver.common.keys import Keys

    from agv_analysis.explore import app

    def opacity() -> str:
        script = "return getComputedStyle(document.getElementById('badge-deviation')).opacity"
        return str(page.chrome.execute_script(script))

    released = threading.Event()

    def respond_once_released(*settings: Any) -> Any:
        released.wait(300.0)
        return respond(*settings)

    assert opacity() == "1"
    monkeypatch.setattr(app, "respond", respond_once_released)
    page.slider("kx").send_keys(Keys.PAGE_UP)
    page.until(lambda: opacity() == "0.4")
    released.set()
    page.until(lambda: opacity() == "1" and "up to 14 along" not in page.text("summary"))
    assert complaints(page) == []


def test_the_margins_of_the_lap_come_after(page: Page, base: Scenario) -> None:
    from selenium.webdriver.common.keys import Keys

    from agv_analysis.stability.margins import margins

    @functools.cache
    def expected(kx: float) -> dict[str, str]:
        changed = dataclasses.replace(base, controller=dataclasses.replace(base.controller, kx=kx))
        return dict(margins(changed).rows())

    def shown() -> dict[str, str]:
        cells = "[...row.cells].map(cell => cell.innerText)"
        rows = page.chrome.execute_script(f"return [...document.querySelectorAll('#lap tr')].map(row => {cells})")
        return dict(rows)

    before = expected(25.0)

    def is_old() -> bool:
        return bool(page.chrome.find_element("id", "lap").get_attribute("class"))

    page.until(lambda: before.items() <= shown().items() and not is_old())
    page.slider("kx").send_keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)  # three moves, the last counts
    page.until(is_old)
    page.until(lambda: not is_old() and expected(float(page.text("kx-value"))).items() <= shown().items())
    assert float(page.text("kx-value")) > 26.0
    assert complaints(page) == []


def test_a_tube_is_drawn_on_the_figure_of_its_own_setting_alone(page: Page) -> None:
    more = "error_detector.track=line\\nerror_detector.corridor=0.25\\nerror_detector.lap_time=4.0"
    page.chrome.execute_script(f"dash_clientside.set_props('more', {{ value: '{more}' }})")
    page.until(lambda: any("tube for any outages" in name for name in page.names("track")))
    late = "{ mark: 'another setting', traces: [{ x: [0, 1], y: [0, 1], name: 'late' }] }"
    drawn = f"dash_clientside.set_props('tube', {{ data: {late} }})"
    page.chrome.execute_script(drawn)
    page.chrome.execute_script(drawn.replace("'another setting'", _MARK_SHOWN).replace("'late'", "'in time'"))
    page.until(lambda: "in time" in page.names("track"))
    assert "late" not in page.names("track")
    assert complaints(page) == []


_MARK_SHOWN = "document.querySelector('#plot-track .js-plotly-plot').layout.meta"


def test_presets_and_pin_stand_beside_each_other(page: Page) -> None:
    page.click("preset-missed")
    page.until(lambda: "13 steps (65 ms)" in page.text("summary"))
    assert not page.chrome.find_element("id", "unpin").is_enabled()
    page.click("pin")
    page.until(lambda: "pinned" in page.names("track"))
    assert page.chrome.find_element("id", "unpin").is_enabled()
    page.click("preset-predicted")
    page.until(lambda: "predicted: with an exact model" in page.text("summary"))
    head, errors = page.text("summary").splitlines()[:2]
    assert head.split() == ["now", "pinned"]
    now, _, pinned = errors.removeprefix("Error in the last tenth ").partition("mm ")
    assert now == "below 0.001 "
    assert pinned == "diverges" or float(pinned.removeprefix("at most ").removesuffix(" m")) > 1e3
    assert page.names("time").count("pinned") == 3
    script = """return [...document.querySelector('#plot-time .js-plotly-plot').data]
        .map(trace => [trace.name, trace.line?.dash])"""
    assert {dash for name, dash in page.chrome.execute_script(script) if name == "pinned"} == {"dot"}
    assert page.text("pinned-name") == "Pinned, dotted: policy hold (now predict)"
    page.click("unpin")
    page.until(lambda: "pinned" not in page.names("time"))
    page.until(lambda: not page.chrome.find_element("id", "unpin").is_enabled())
    assert complaints(page) == []


def test_the_badge_says_word_deviation_and_confidence_and_nothing_moves(page: Page, base: Scenario) -> None:
    from selenium.webdriver.common.keys import Keys

    def top() -> float:
        script = "return document.getElementById('plot-track').getBoundingClientRect().top + scrollY"
        return float(page.chrome.execute_script(script))

    analysis = analyse(simulate(base))
    page.until(lambda: page.text("badge-word") == analysis.verdict.word)
    assert page.text("badge-deviation") == f"{analysis.deviation.largest:.3g} m"
    assert analysis.evidence.confidence is not None
    assert page.text("badge-sure") == confidence_text(analysis.evidence.confidence)
    assert page.text("badge-why") == f"Why: {analysis.verdict.reason}."
    before = top()
    page.click("preset-missed")
    page.until(lambda: page.text("badge-deviation") == "diverges")
    page.until(lambda: page.text("badge-word") == "unstable")
    assert top() == before
    page.click("pin")
    page.chrome.find_element("id", "more").send_keys("\nplant.color=red")
    page.until(lambda: "color" in page.text("problem"))
    assert top() == before
    # the text of a preset is there as long as its setting is
    page.click("preset-paper")
    page.until(lambda: "closes the 5 m" in page.text("story"))
    page.slider("ky").send_keys(Keys.ARROW_RIGHT)
    page.until(lambda: page.text("story") == "")


def test_what_has_no_effect_is_greyed_with_the_reason(page: Page) -> None:
    def off() -> list[str]:
        greyed = page.chrome.find_elements("css selector", "#controls .off")
        return [str(one.get_attribute("id")).removeprefix("of-") for one in greyed if one.is_displayed()]

    assert off() == ["n"]  # gilbert_elliott
    expected = {"perfect": ["policy", "p", "r", "n", "seed"], "bernoulli": ["r", "n"], "burst": ["p", "r", "seed"]}
    for model in expected:
        choose(page, "model", model)
        page.until(functools.partial(lambda name: off() == expected[name], model))
        disabled = {key for key in ("p", "r", "n") if page.slider(key).get_attribute("data-disabled") is not None}
        assert disabled == {"p", "r", "n"} & set(expected[model])
    assert page.text("why-r") == "(no effect: uplink.model is burst)"
    page.chrome.find_element("id", "more").send_keys("controller.kx=40.0\nplant.bicycle.wheelbase=2.0")
    page.until(lambda: off() == ["kx", "p", "r", "seed"])
    assert page.text("why-kx") == "(no effect: set under more)"
    assert page.text("idle-lines") == "plant.bicycle.wheelbase has no effect: vehicle is unicycle"
    assert complaints(page) == []


def test_the_address_holds_the_setting(page: Page, address: str) -> None:
    from selenium.webdriver.common.keys import Keys

    assert "#" not in page.chrome.current_url
    page.slider("kx").send_keys(Keys.PAGE_UP)
    choose(page, "track", "line")
    page.until(lambda: "track=" in page.chrome.current_url and "kx=" in page.chrome.current_url)
    kx, url, summary = page.text("kx-value"), page.chrome.current_url, page.text("summary")
    page.chrome.get("about:blank")
    page.chrome.get(url)
    page.until(lambda: page.text("kx-value") == kx and page.text("summary") == summary)
    assert page.chrome.current_url == url
    page.chrome.get("about:blank")
    page.chrome.get(f"{address}#kx=%22much%22&nonsense=1&track=%22moon%22&ts=1e9&%")
    page.until(lambda: page.text("kx-value") == "25" and "50 ms" in page.text("summary") + page.text("badge-outage"))
    assert page.text("problem") == ""


LONG_REASON = (
    "Why: only the limit on the speed bounds the error, at 0.321 m in 600 s of simulation; the mean square of the "
    "error grows: a Gilbert channel describes the outcomes, of 205 complete outages (the error dies out with a "
    "probability below 0.1 %)."
)
"""The explorer's answer to K_x = 250 and v_max = 3 on config/outages.yaml."""


def fits(page: Page, name: str, text: str) -> bool:
    """Is a text seen whole, without scrolling, where `name` stands?"""
    script = """
      const at = document.getElementById(arguments[0]), before = at.textContent;
      at.textContent = arguments[1];
      const fits = at.scrollHeight <= at.clientHeight;
      at.textContent = before;
      return fits;"""
    return bool(page.chrome.execute_script(script, name, text))


@pytest.mark.parametrize("width", [390, 1000, 1400])
def test_the_usual_reasons_are_seen_whole(page: Page, width: int) -> None:
    size = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": width < 900}
    try:
        page.chrome.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        assert fits(page, "badge-why", LONG_REASON)
        assert not fits(page, "badge-why", LONG_REASON * 5)
        page.click("preset-missed")
        page.until(lambda: page.text("badge-when") == "of the whole run, since its initial error does not settle")
        assert page.chrome.execute_script(
            "const b = document.getElementById('badge'); return b.scrollHeight <= b.clientHeight"
        )
    finally:
        page.chrome.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_on_a_phone_results_come_first_and_controls_are_in_a_drawer(page: Page) -> None:
    size = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    try:
        page.chrome.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        page.chrome.refresh()
        page.until(lambda: page.text("badge-deviation").endswith(" m"))
        page.until(lambda: not page.chrome.find_element("id", "controls").is_displayed())
        for name in ("badge", "plot-track"):
            rect = page.chrome.execute_script(f"return document.getElementById('{name}').getBoundingClientRect()")
            assert 0.0 <= rect["top"] < rect["bottom"] <= 844, name
        page.chrome.find_element("css selector", "#drawer summary").click()
        page.until(lambda: page.chrome.find_element("id", "controls").is_displayed())
        rect = page.chrome.execute_script("return document.getElementById('drawer').getBoundingClientRect()")
        assert rect["top"] > 300  # badge and track are seen beside it
        assert page.chrome.execute_script("return document.documentElement.scrollWidth") <= 390
    finally:
        page.chrome.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_a_bad_setting_says_why_and_a_good_one_takes_it_back(page: Page) -> None:
    from selenium.webdriver.common.keys import Keys

    more = page.chrome.find_element("id", "more")
    more.send_keys("controller.kx=-3.0")
    page.until(lambda: "controller.kx must be in [0, 1e+06], got -3.0" in page.text("problem"))
    more.send_keys(Keys.CONTROL, "a")
    more.send_keys("plant.duration=20.0")
    page.until(lambda: page.text("problem") == "")
    assert complaints(page) == []


def test_what_is_exported_is_what_is_shown(page: Page, base: Scenario) -> None:
    from selenium.webdriver.common.keys import Keys

    page.slider("kx").send_keys(Keys.ARROW_RIGHT)
    page.until(lambda: page.text("kx-value") != "25")
    kx = float(page.text("kx-value"))
    assert 25.0 < kx < 26.5
    page.click("export")
    page.until(lambda: "explored.yaml" in page.text("exported"))
    assert "your browser's downloads" in page.text("export-said")
    command, _, text = page.text("exported").partition("\n\n")
    assert command == "agv-ncs simulate explored.yaml --report explored.html"
    found = parse_scenario(text, "exported")
    assert found == dataclasses.replace(base, controller=dataclasses.replace(base.controller, kx=kx))


def test_it_is_dark_where_all_else_is(page: Page) -> None:
    """Paper and ink, on the page and in its plots, are as far apart as the guidelines for the web ask (4.5)."""

    def contrast(one: str, other: str) -> float:
        def luminance(colour: str) -> float:
            parts = [int(part) / 255.0 for part in re.findall(r"\d+", colour)[:3]]
            red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts)
            return 0.2126 * red + 0.7152 * green + 0.0722 * blue

        low, high = sorted((luminance(one), luminance(other)))
        return (high + 0.05) / (low + 0.05)

    def colour(selector: str, name: str) -> str:
        script = "return getComputedStyle(document.querySelector(arguments[0]))[arguments[1]]"
        return str(page.chrome.execute_script(script, selector, name))

    papers = {}
    try:
        for scheme in ("dark", "light"):
            wanted = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
            page.chrome.execute_cdp_cmd("Emulation.setEmulatedMedia", wanted)
            papers[scheme] = colour("body", "backgroundColor")
            inks = [colour("#summary", "color"), colour("label", "color"), colour("#plot-time .xtick text", "fill")]
            assert min(contrast(ink, papers[scheme]) for ink in inks) > 4.5, inks
    finally:
        page.chrome.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    assert contrast("0, 0, 0", papers["dark"]) < 2.0 < contrast("0, 0, 0", papers["light"])


# -- on the command line ----------------------------------------------------------------------------------------------


def test_the_command_says_where_the_page_is_and_ends_on_ctrl_c(start: Start) -> None:
    pytest.importorskip("dash", reason="needs Dash: pip install '.[explore]'")
    served = start("agv_analysis.cli", "explore", "config/paper.yaml", "--port", "0", "--no-browser")
    address = served.wait_for("explore:").split()[1]
    assert address.startswith("http://127.0.0.1:")
    served.process.send_signal(signal.SIGINT)
    status, said = served.end()
    assert (status, "Traceback" in said) == (0, False), said


def question(base: Scenario, output: str, changed: str, **moved: Any) -> dict[str, Any]:
    """What the page sends for a callback with these outputs, after it was moved."""
    from agv_analysis.explore.app import KEYS

    values = {**values_of(base), **moved}
    state = [{"id": key, "property": "value", "value": values[key]} for key in KEYS]
    state.append({"id": "pinned", "property": "data", "value": None})
    more = [{"id": "again", "property": "n_intervals", "value": 0}] if changed == "kx.value" else []
    inputs = [{"id": "problem", "property": "children", "value": ""}] if changed == "problem.children" else state + more
    names = output.strip(".").split("...")
    outputs = [dict(zip(("id", "property"), name.split(".", 1), strict=True)) for name in names]
    return {
        "output": output, "outputs": outputs, "inputs": inputs, "changedPropIds": [changed],
        "state": state if changed == "problem.children" else [],
    }  # fmt: skip


def output_of(address: str, source: str) -> str:
    """The outputs of the callback that a part of the page feeds first."""
    with urlopen(f"{address}_dash-dependencies") as respond:
        found: list[str] = [one["output"] for one in json.load(respond) if source in f"{one['inputs'][0]}"]
    return found[0]


def ask(address: str, content: object, **headers: str) -> tuple[int, str]:
    """Status and text of the answer to a request for an update."""
    data = content if isinstance(content, bytes) else json.dumps(content).encode()
    request = Request(f"{address}_dash-update-component", data, {"Content-Type": "application/json", **headers})
    try:
        with urlopen(request, timeout=300.0) as answer:
            return answer.status, answer.read().decode()
    except HTTPError as error:
        return error.code, error.read().decode()


def ask_for_the_lap(address: str, base: Scenario) -> tuple[int, str]:
    """What the page asks for after a move."""
    return ask(address, question(base, output_of(address, "'problem'"), "problem.children"))


def try_to_ask_for_the_lap(address: str, base: Scenario) -> None:
    """The server may go away meanwhile."""
    with contextlib.suppress(OSError, HTTPException):
        ask_for_the_lap(address, base)


def test_only_its_own_page_is_answered_and_no_file_from_elsewhere_is_read(
    start: Start, base: Scenario, tmp_path: Path
) -> None:
    pytest.importorskip("dash", reason="needs Dash: pip install '.[explore]'")
    served = start("agv_analysis.cli", "explore", "config/outages.yaml", "--port", "0", "--no-browser")
    address = served.wait_for("explore:").split()[1]
    port = urlsplit(address).port
    root = f"http://127.0.0.1:{port}/"
    output = output_of(address, "'kx'")

    def moved(**values: Any) -> dict[str, Any]:
        return question(base, output, "kx.value", **values)

    assert len(address) > len(root) + 20
    assert ask(address, moved())[0] == 200
    assert ask(address, moved(), Host="evil.example")[0] == 403
    assert ask(address, moved(), Host=f"evil.example:{port}")[0] == 403
    assert ask(address, moved(), Origin="http://evil.example")[0] == 403
    assert ask(address, moved(), Origin="null")[0] == 403
    assert ask(address, moved(), Origin=root.rstrip("/"))[0] == 200
    assert ask(root, moved())[0] in (404, 405)  # without the secret
    assert ask(address, b" " * (2**20 + 1))[0] == 413
    secret = tmp_path / "secret.csv"
    secret.write_text("root:x:0:0\n")
    for setting in ("relay.uplink.trace_file", "error_detector.track_file"):
        model = "relay.uplink.model=trace" if "relay" in setting else "error_detector.track=csv"
        status, text = ask(address, moved(more=f"{model}\n{setting}={secret}"))
        assert (status, "where the page was started" in text, "root:x" in text) == (200, True, False)
        status, text = ask(address, moved(more=f"{model}\n{setting}=README.md"))
        assert (status, "`agv-ncs simulate` says why" in text, "agv_ncs" in text) == (200, True, False)
    assert "500000 steps at most" in ask(address, moved(more="plant.duration=1e5"))[1]
    malformed = [b"{", b"[]", b"null", {"output": 5}, moved(kx="much"), moved(kx=None), moved(more=7)]
    assert [ask(address, content)[0] for content in malformed] == [400] * len(malformed)
    assert ask(address, moved())[0] == 200


def test_a_helper_that_dies_is_started_again_and_ends_with_the_server(start: Start, base: Scenario) -> None:
    pytest.importorskip("dash", reason="needs Dash: pip install '.[explore]'")
    served = start("agv_analysis.cli", "explore", "config/outages.yaml", "--port", "0", "--no-browser")
    address = served.wait_for("explore:").split()[1]

    def helpers() -> list[Path]:
        return [child for child in served.children() if b"spawn_main" in (child / "cmdline").read_bytes()]

    with ThreadPoolExecutor(1) as threads:
        asked = threads.submit(ask_for_the_lap, address, base)
        served.until(lambda: bool(helpers()))
        [first] = helpers()
        os.kill(int(first.name), signal.SIGKILL)
        status, text = asked.result(300.0)
        assert (status, "the next move starts another" in text) == (200, True)
        threads.submit(try_to_ask_for_the_lap, address, base)
        served.until(lambda: bool(helpers()))
        [second] = helpers()
        served.process.kill()
    assert second != first
    deadline = time.monotonic() + 60.0
    while second.exists() and "Z" not in (second / "stat").read_text().rpartition(")")[2]:
        assert time.monotonic() < deadline
        os.sched_yield()


def test_ctrl_c_ends_it_in_the_midst_of_the_lap_s_criteria(start: Start, base: Scenario) -> None:
    pytest.importorskip("dash", reason="needs Dash: pip install '.[explore]'")
    command = ("agv_analysis.cli", "explore", "config/outages.yaml", "--port", "0", "--no-browser")
    served = start(*command, start_new_session=True)
    address = served.wait_for("explore:").split()[1]
    with ThreadPoolExecutor(1) as threads:
        threads.submit(try_to_ask_for_the_lap, address, base)
        served.until(lambda: bool(served.children()))
        os.killpg(served.process.pid, signal.SIGINT)  # as a terminal does
        status, said = served.end()
    assert (status, "Traceback" in said) == (0, False), said[-500:]


def test_a_port_that_is_taken_is_named(agv_ncs: Callable[..., tuple[int, str]]) -> None:
    pytest.importorskip("dash", reason="needs Dash: pip install '.[explore]'")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        status, said = agv_ncs("explore", "config/paper.yaml", "--port", str(port), "--no-browser")
    assert status == 1
    assert said == f"Error: port {port} of 127.0.0.1 cannot be used: Address already in use: choose another with --port"


def test_an_address_of_another_machine_is_refused_with_the_remedy() -> None:
    with pytest.raises(UserError, match=r"Cannot assign requested address: give --host an address of this machine$"):
        listener("192.0.2.1", 0)
    with pytest.raises(UserError, match=r"give --host an address of this machine$"):
        listener("no.such.host.invalid", 0)
    with listener("127.0.0.1", 0) as bound:
        assert bound.getsockname()[1] > 0
