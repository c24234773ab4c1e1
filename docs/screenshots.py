"""Draw docs/images of the pages in headless Chromium: `make images`.

Each page at the size of a screen and of a phone, light and dark: what is seen first, without scrolling.
"""

from __future__ import annotations

import io
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).parents[1]
IMAGES = REPOSITORY / "docs/images"

SIZES = ((1400, 900), (390, 844))
SCHEMES = ("light", "dark")

SLOW = ("plant.ts=0.02", "plant.duration=600.0", "controller.kx=10.0", "relay.uplink.r=0.5", "controller.v_max=3.0")
"""A loop in real time whose deadlines are met beside a browser that draws without a graphics card."""

DRAWN = "return document.body.dataset.drawn"
WATCHED = "return window.now && now.k > 1100 && document.querySelector('#tile-word.good')"
EXPLORED = """return performance.now() > 5000 && document.querySelectorAll('#lap:not(.old) tr').length > 3
  && document.querySelector('#badge-word.mean-square:not(.old)') && document.querySelector('#plot-time .main-svg')
  && [...document.querySelectorAll('.legendtext')].some(name => name.textContent.startsWith('tube'))"""
"""A page that was loaded is drawn anew some times, its verdict is grey until it is computed, its tube comes last."""

PAGES = {
    "report": ("simulate", "config/outages.yaml", "--corridor", "0.25", "--laps", "50"),
    "sweep": (
        "sweep", "config/outages.yaml", "--vary", "controller.kx=5:400:14", "--vary", "relay.uplink.p=0.002:0.06:10",
        "--seeds", "10", "--set", "plant.duration=50.0",
    ),
    "map": ("stability", "config/outages.yaml", "--corridor", "0.25", "--map", "kx,ts", "--points", "41"),
}  # fmt: skip
"""Commands whose --report is drawn."""


def main() -> None:
    """Make the pages and draw them."""
    IMAGES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, browser() as chrome:
        for name, command in PAGES.items():
            page = Path(folder) / f"{name}.html"
            files = ("--csv", f"{folder}/map.csv", "--picture", f"{folder}/map.png") if name == "map" else ()
            subprocess.run([*agv_ncs(*command), *files, "--report", str(page)], cwd=REPOSITORY, check=True)
            draw(chrome, page.as_uri(), name, DRAWN)
        with explorer("config/outages.yaml", "--corridor", "0.25") as address:
            draw(chrome, address, "explorer", EXPLORED)
        slow = [word for setting in SLOW for word in ("--set", setting)]
        with watched("config/outages.yaml", "--corridor", "0.25", "--clock", "realtime", *slow) as address:
            draw(chrome, address, "watch", WATCHED)


def agv_ncs(*arguments: str) -> list[str]:
    """A command of agv-ncs."""
    return [sys.executable, "-m", "agv_analysis.cli", *arguments]


@contextmanager
def explorer(*arguments: str) -> Iterator[str]:
    """Address of an explorer that is served meanwhile."""
    command = agv_ncs("explore", *arguments, "--port", "0", "--no-browser")
    with subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.PIPE, text=True) as served:
        assert served.stdout is not None
        try:
            yield served.stdout.readline().split()[1]
        finally:
            served.terminate()


@contextmanager
def watched(*arguments: str) -> Iterator[str]:
    """Address of the page beside a run that goes on meanwhile."""
    command = agv_ncs("run", *arguments, "--live", "--port", "0")
    with subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as run:
        assert run.stdout is not None
        try:
            yield next(line.split()[1] for line in run.stdout if line.startswith("live: "))
        finally:
            run.send_signal(signal.SIGINT)


@contextmanager
def browser() -> Iterator[Any]:
    """Headless Chromium."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or "chromium"
    for argument in ("headless=new", "no-sandbox", "disable-dev-shm-usage", "hide-scrollbars"):
        options.add_argument(f"--{argument}")
    chrome = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
    try:
        yield chrome
    finally:
        chrome.quit()


def draw(chrome: Any, address: str, name: str, is_ready: str, folder: Path = IMAGES) -> list[Path]:
    """Draw a page in all sizes and schemes to `folder`/NAME-WIDTHxHEIGHT-SCHEME.png."""
    from selenium.webdriver.support.ui import WebDriverWait

    drawn = []
    for width, height in SIZES:
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        chrome.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        for scheme in SCHEMES:
            feature = {"name": "prefers-color-scheme", "value": scheme}
            chrome.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
            chrome.get("about:blank")
            chrome.get(address)
            WebDriverWait(chrome, 300.0).until(lambda _: chrome.execute_script(is_ready))
            drawn.append(folder / f"{name}-{width}x{height}-{scheme}.png")
            drawn[-1].write_bytes(smaller(chrome.get_screenshot_as_png()))
    return drawn


def smaller(png: bytes) -> bytes:
    """A picture in 256 colours, spread over all that occur: a border that is a thin line keeps its own."""
    from PIL import Image

    image, out = Image.open(io.BytesIO(png)).convert("RGB"), io.BytesIO()
    image.quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(out, "png", optimize=True)
    return out.getvalue()


if __name__ == "__main__":
    main()
