"""How fast the explorer answers: a lap of 20 000 steps simulated again, its margins, and what the browser gets to draw.

The peer is what a person bears: an answer within 0.2 s is one to the hand that moves the slider. It is measured in the
server alone, and, where Chromium is installed, in the browser from the key that moves the slider to the frame that
shows both plots and the table anew: while a slider is moved on and on, and while the criteria for the whole lap are
computed beside it, as they are once it has rested for a moment.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from agv_analysis.explore.response import respond
from agv_analysis.explore.settings import Values, scenario_of, values_of
from agv_analysis.scenario import Scenario, load_scenario
from benchmarks.comparison import Comparison

CONFIG = str(Path(__file__).parent.parent / "config" / "outages.yaml")
AT_ONCE = 0.2
"""[s]"""


def measure() -> list[Comparison]:
    """The slowest of ten moves, with and without a pinned setting."""
    base = load_scenario(CONFIG)
    values = values_of(base)
    scenario_and_answer(base, values, None)  # compiles
    moves = [{**values, "kx": 20.0 + move} for move in range(10)]
    return [
        Comparison(
            f"a move of a slider{what}", max(scenario_and_answer(base, move, pinned) for move in moves), "at once",
            AT_ONCE, "s", 1.0, smaller_is_better=True,
        )
        for what, pinned in ((", in the server", None), (", in the server, one pinned", base))
    ] + in_the_browser()  # fmt: skip


def scenario_and_answer(base: Scenario, values: Values, pinned: Scenario | None) -> float:
    """Seconds from the values on the page to what is sent to it."""
    begun = time.perf_counter()
    found = respond(scenario_of(base, values), pinned)
    json.dumps((found.track, found.time))
    return time.perf_counter() - begun


# -- in the browser ---------------------------------------------------------------------------------------------------

WATCH = """
const plots = [...document.querySelectorAll(".js-plotly-plot")];
const summary = document.getElementById("summary");
const written = () => new Promise(seen => new MutationObserver(seen).observe(
  summary, { childList: true, subtree: true, characterData: true }));
window.moved = new Promise(done => addEventListener("keydown", () => {
  const begun = performance.now();
  Promise.all([written(), ...plots.map(plot => new Promise(drawn => plot.once("plotly_afterplot", drawn)))])
    .then(() => requestAnimationFrame(() => setTimeout(() => done(performance.now() - begun))));
}, { capture: true, once: true }));
"""
"""Promises the milliseconds from the next key to the frame after the table is written and the last plot drawn."""


def in_the_browser() -> list[Comparison]:
    """The median and the slowest of twenty moves as a person sees them; nothing where there is no Chromium."""
    browser, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if browser is None or driver is None:
        return []
    command = (sys.executable, "-m", "agv_analysis.cli", "explore", CONFIG, "--port", "0", "--no-browser")
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as served:
        assert served.stdout is not None
        try:
            moves = sorted(_moves(browser, driver, served.stdout.readline().split()[1], served.pid))
        finally:
            served.terminate()
    return [
        Comparison(f"{what} move in the browser", seconds, "at once", AT_ONCE, "s", 1.0, smaller_is_better=True)
        for what, seconds in (("median", moves[len(moves) // 2]), ("slowest", moves[-1]))
    ]


def _moves(browser: str, driver: str, address: str, served: int) -> list[float]:
    """How long twenty moves of a slider take [s] on a page of process `served`, the last ten beside its criteria."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service
    from selenium.webdriver.common.keys import Keys
    from selenium.webdriver.support.ui import WebDriverWait

    options = webdriver.ChromeOptions()
    options.binary_location = browser
    for argument in ("headless=new", "no-sandbox", "disable-dev-shm-usage", "window-size=1300,1200"):
        options.add_argument(f"--{argument}")
    chrome: Any = webdriver.Chrome(options=options, service=Service(driver))
    try:
        chrome.get(address)
        shown = "return document.querySelectorAll('#summary tr, #lap tr').length > 12"  # both: all is compiled
        WebDriverWait(chrome, 120.0).until(lambda _: chrome.execute_script(shown))
        handle, found = chrome.find_element("css selector", "#kx [role=slider]"), []
        for is_beside in (*[False] * 10, *[True] * 10):
            if is_beside:
                WebDriverWait(chrome, 120.0, 0.01).until(lambda _: is_computing_beside(served))
            chrome.execute_script(WATCH)
            handle.send_keys(Keys.ARROW_RIGHT)
            found.append(1e-3 * chrome.execute_async_script("window.moved.then(arguments[0])"))
        return found
    finally:
        chrome.quit()


def is_computing_beside(served: int) -> bool:
    """Does a process that the server has begun hold a core at this moment? By Linux' /proc."""
    try:
        begun = " ".join(thread.read_text() for thread in Path(f"/proc/{served}/task").glob("*/children")).split()
        states = [Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()[0] for child in begun]
    except OSError:  # a thread of the server went meanwhile
        return False
    return "R" in states
