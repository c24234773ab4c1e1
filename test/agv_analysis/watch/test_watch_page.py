"""The page beside a real loop on DDS, in headless Chromium: what it shows and does, against the bag of the run."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("flask", reason="needs Flask: pip install '.[explore]'")

from agv_analysis.bags import read_bag
from agv_analysis.recordings.messages_on_steps import stamps_of
from agv_analysis.recordings.recording import read_run
from agv_analysis.run import Run
from agv_analysis.runtime.run_setup import params_file
from agv_analysis.runtime.runner import run_in_process
from agv_analysis.scenario import load_scenario
from agv_analysis.watch.beside_run import watcher_beside
from agv_analysis.watch.live_loop import TOPICS
from agv_analysis.watch.live_tiles import metres
from agv_cloud.reference.reference import Reference
from test.test_loop import changed_topics

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

REPOSITORY = Path(__file__).parents[3]


@dataclass
class Watched:
    """What a page showed of a run that was ended by its button, and what came of it."""

    now: dict[str, Any]
    """The figures that the page had at the end."""
    points: list[list[float]]
    tiles: dict[str, str]
    said: dict[str, str]
    """What the page said to each button."""
    refused: dict[str, int]
    """Status of requests that nobody should make."""
    state: str
    log: list[str]
    """What the browser complained about."""
    status: int
    output: str
    bag: Path
    saved: Path

    def run(self) -> Run:
        return read_run(self.bag)


@pytest.fixture(scope="module")
def watched(chromium: Chrome, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watched]:
    from selenium.webdriver.support.ui import WebDriverWait

    folder = tmp_path_factory.mktemp("watched")
    command = [
        sys.executable, "-m", "agv_analysis.cli", "run", str(REPOSITORY / "config/outages.yaml"), "--clock", "realtime",
        "--duration", "inf", "--bag", "bag", "--live", "--port", "0", "--set", "relay.uplink.model=bernoulli",
        "--set", "relay.uplink.p=0.05", "--set", "error_detector.corridor=0.25",
    ]  # fmt: skip
    options = {"cwd": folder, "text": True, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": str(REPOSITORY)}, **options) as process:  # type: ignore[call-overload]
        lines: list[str] = []
        try:
            address = _address(process, lines)
            wait = WebDriverWait(chromium, 60.0, poll_frequency=0.05)

            def until(script: str) -> Any:
                return wait.until(lambda chrome: chrome.execute_script(f"return {script}"))

            chromium.get(address)
            until("window.now && now.k > 100 && document.querySelectorAll('#sliders input').length >= 5")
            chromium.execute_script("document.getElementById('drawer').open = true")
            said = {"lose20": _press(chromium, until, "lose20")}
            last = int(re.findall(r"slots \d+ to (\d+)", said["lose20"])[0])
            until(f"now.k > {last} + 20")
            slider = "document.querySelector('[data-target=\"controller.kx\"]')"
            chromium.execute_script(f"{slider}.value = 200; {slider}.dispatchEvent(new Event('change'))")
            said["kx"] = _said(chromium, until)
            until("setup.controls.find(control => control.target === 'controller.kx').at === 200")
            said["save"] = _press(chromium, until, "save")
            refused = dict(_refused(address))
            said["stop"] = _press(chromium, until, "stop")
            until("isGone")
            output, _ = process.communicate(timeout=60.0)
        finally:
            if process.poll() is None:
                process.terminate()
                process.communicate(timeout=60.0)
        yield Watched(
            now=chromium.execute_script("return now"), points=chromium.execute_script("return points"),
            tiles=chromium.execute_script(
                "return Object.fromEntries([...document.querySelectorAll('.tile')].map(tile => "
                "[tile.id.slice(5), tile.innerText]))"
            ),
            said=said, refused=refused, state=chromium.find_element("id", "state").text,
            log=[entry["message"] for entry in _log_of(chromium) if "ERR_" not in entry["message"]],
            status=process.returncode, output="\n".join(lines) + output, bag=folder / "bag",
            saved=folder / said["save"].partition(":")[0],
        )  # fmt: skip


def _log_of(chromium: Any) -> list[dict[str, str]]:
    found: list[dict[str, str]] = chromium.get_log("browser")
    return found


def _address(process: subprocess.Popen[str], lines: list[str]) -> str:
    assert process.stdout is not None
    for line in process.stdout:
        lines.append(line.strip())
        if line.startswith("live: "):
            return line.split()[1]
    pytest.fail("no page:\n" + "\n".join(lines))


def _press(chromium: Chrome, until: Callable[[str], Any], button: str) -> str:
    chromium.execute_script(f"document.getElementById('{button}').click()")
    return _said(chromium, until)


def _said(chromium: Chrome, until: Callable[[str], Any]) -> str:
    until("document.getElementById('said').textContent.length > 1")
    return chromium.find_element("id", "said").text


def _refused(address: str) -> Iterator[tuple[str, int]]:
    """Requests of strangers, and their status."""
    parts = urlsplit(address)
    elsewhere, data = f"{parts.scheme}://{parts.netloc}/", json.dumps({"slots": 5}).encode()
    for name, url, content, headers in (
        ("path", f"{elsewhere}guessed/", None, {}),
        ("root", elsewhere, None, {}),
        ("host", address, None, {"Host": f"evil.example:{parts.port}"}),
        ("origin", f"{address}lose", data, {"Origin": "http://evil.example", "Content-Type": "application/json"}),
        ("site", f"{address}lose", data, {"Sec-Fetch-Site": "cross-site", "Content-Type": "application/json"}),
        ("parameter", f"{address}set", json.dumps({"target": "relay.seed", "value": 2}).encode(),
         {"Content-Type": "application/json"}),
        ("value", f"{address}set", json.dumps({"target": "controller.kx", "value": -1.0}).encode(),
         {"Content-Type": "application/json"}),
        ("form", f"{address}lose", b"slots=5", {}),
        ("nothing", f"{address}lose", b"{}", {"Content-Type": "application/json"}),
    ):  # fmt: skip
        try:
            with urlopen(Request(url, content, headers)) as answer:
                yield name, answer.status
        except HTTPError as error:
            yield name, error.code


def test_the_numbers_on_the_page_are_those_in_the_bag(watched: Watched) -> None:
    run, now, bag = watched.run(), watched.now, read_bag(watched.bag)
    assert now["first"] + now["slots"] + now["skipped"] == now["k"] + 1
    # The page asks for best effort: on a busy machine it misses slots, and the bag does not.
    unseen = len(run) - now["slots"]
    assert 0 <= unseen < len(run) / 2
    assert 0 <= int(run.lost.sum()) - now["lost"] <= unseen
    k, poses = now["deviation_k"], bag["/agv/pose"]
    x, y = (float(poses[f"pose.position.{axis}"][k]) for axis in "xy")
    reference = Reference(run.scenario.error_detector)[k]
    assert now["deviation"] == pytest.approx(math.hypot(x - reference[0], y - reference[1]), abs=1e-12)
    assert (now["x"], now["y"]) == pytest.approx((x, y), abs=1e-4)
    assert watched.tiles["losses"].splitlines()[1] == f"{100.0 * now['lost'] / now['slots']:.2f} %"
    # At the gain that the slider has set, a busy machine may miss so many deadlines that the AGV leaves its track far.
    assert watched.tiles["deviation"].splitlines()[1] == metres(now["deviation"])
    assert watched.tiles["outage"].splitlines()[1] == f"{now['longest']} slots ({now['longest'] * 5} ms)"
    assert watched.log == []


def test_the_strip_is_what_the_bag_holds(watched: Watched) -> None:
    """At the points of which the watcher has missed no message, as the bag that it has saved says."""
    run, heard = watched.run(), read_bag(watched.saved)
    seen = [set(stamps_of(heard[f"/{topic}"]).tolist()) for topic in ("agv/pose", "edge/slot", "edge/cmd_vel")]
    steps = np.arange(len(run) // 10 * 10).reshape(-1, 10)
    stamps = run.scenario.grid.start_ns + run.scenario.grid.ts_ns * steps
    is_whole = np.array([set(ten) <= seen[0] & seen[1] & seen[2] for ten in stamps.tolist()])
    number = np.rint((np.array(watched.points, dtype=np.float64)[:, 0] - 0.045) / 0.05).astype(int)
    is_compared = np.isin(number, np.flatnonzero(is_whole))
    points, steps = np.array(watched.points, dtype=np.float64)[is_compared], steps[number[is_compared]]
    assert len(points) >= 10
    distance = np.hypot(*(run.pose - run.reference[:, :3])[:, :2].T)
    np.testing.assert_allclose(points[:, 3], distance[steps].max(axis=1), rtol=0.0, atol=1e-4)
    np.testing.assert_array_equal(points[:, 6], run.lost[steps].sum(axis=1))
    np.testing.assert_allclose(points[:, 5], 0.005 * run.n_ul[steps].max(axis=1), atol=1e-4)
    # Of a loop that begins late, commands may come after the point that would have shown them.
    is_known = ~np.isnan(points[:, 4])
    assert is_known.sum() >= len(points) / 2
    np.testing.assert_allclose(points[is_known, 4], run.command[steps[is_known, -1], 0], rtol=0.0, atol=1e-4)


def test_the_next_20_are_lost_and_the_bag_says_why(watched: Watched) -> None:
    run = watched.run()
    assert run.uplink is not None
    begin, end = map(int, re.findall(r"slots (\d+) to (\d+)", watched.said["lose20"])[0])
    assert end - begin == 19
    lost = run.k[run.uplink.cause == "outage"].tolist()
    assert lost == list(range(end + 1 - len(lost), end + 1))
    # On a machine that is too busy the relay may know of it too late, which the page then says.
    assert len(lost) == 20 or "only at slot" in watched.said["lose20"]
    assert watched.now["longest"] >= len(lost) - watched.now["skipped"]


def test_a_slider_sets_the_node_s_parameter(watched: Watched) -> None:
    (change,) = (change for change in watched.run().parameter_changes if change.node == "controller")
    assert (change.name, change.old) == ("kx", 25.0)
    assert watched.said["kx"] == f"controller.kx = {change.new:g}"


def test_what_is_saved_is_what_the_recorder_has(watched: Watched) -> None:
    bag, saved = read_bag(watched.bag), read_bag(watched.saved)
    for topic in (f"/{topic.strip('/')}" for topic in TOPICS):
        recorded = Counter(bag.payloads(topic))
        assert not Counter(saved.payloads(topic)) - recorded
    run = read_run(watched.saved)
    assert len(run) > 150
    assert run.scenario.relay.uplink.p == 0.05


def test_the_button_stop_ends_the_run_in_order(watched: Watched) -> None:
    assert (watched.status, "interrupted at step" in watched.output) == (1, True)
    assert "everything that was published" in watched.output
    assert watched.state == "the page's server has ended; what was seen stays here"


def test_others_are_kept_out_and_requests_are_checked(watched: Watched) -> None:
    assert watched.refused == {
        "path": 404, "root": 404, "host": 403, "origin": 403, "site": 403, "parameter": 409, "value": 409, "form": 415,
        "nothing": 409,
    }  # fmt: skip


def test_a_loop_in_lockstep_gives_the_same_bytes_beside_a_watcher(tmp_path: Path) -> None:
    scenario = load_scenario(str(REPOSITORY / "config/outages.yaml"), ["plant.duration=3.0"])
    told: list[str] = []
    run_in_process(scenario, tmp_path / "alone/bag", lambda _: None)
    with params_file(scenario) as params, watcher_beside(scenario, params, "127.0.0.1", 0, told.append):
        run_in_process(scenario, tmp_path / "watched/bag", lambda _: None, is_watched=True)
        with urlopen(f"{told[0]}events", timeout=60.0) as events:
            frames = (json.loads(line.removeprefix(b"data: ")) for line in events if line.strip())
            next(frame for frame in frames if frame["now"]["slots"] > 0)  # it did listen
    files = [tmp_path / run / "bag/bag_0.mcap" for run in ("alone", "watched")]
    assert not changed_topics(files[0].parent, files[1].parent)  # which says where they differ
    assert files[0].read_bytes() == files[1].read_bytes()
