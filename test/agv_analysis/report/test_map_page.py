"""The page of a map of margins in headless Chromium: what it says of a point is what the margins say."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from test.agv_analysis.report.test_report import complaints, of_plot, show

if TYPE_CHECKING:
    from selenium.webdriver import Chrome


def test_a_map_has_a_page_with_points_to_click(
    chromium: Chrome, agv_ncs: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    page = tmp_path / "map.html"
    options = ("--csv", tmp_path / "map.csv", "--picture", tmp_path / "map.png", "--report", page)
    status, said = agv_ncs("stability", "config/paper.yaml", "--map", "kx,ts", "--points", "21", *options)
    assert status == 0, said
    show(chromium, page)
    assert complaints(chromium) == []
    sentence = chromium.find_element("id", "verdict").text
    assert sentence.startswith("At K_x = 25 1/s, T_s = 0.005 s: ")
    assert "longest outage that may repeat: 14 slots" in sentence
    titles = of_plot(chromium, "n_bursts", "[plot._fullLayout.xaxis.title.text, plot._fullLayout.yaxis.title.text]")
    assert titles == ["sampling period T_s [s]", "gain K_x of the error along the track [1/s]"]
    data: Any = json.loads(chromium.execute_script("return document.getElementById('data').textContent"))
    own = min(data["points"], key=lambda point: abs(point["kx"] - 25.0) + abs(point["ts"] - 0.005))
    least = min(own["n_bursts"], own["n_lifted"])
    assert f"{least} slots" in chromium.find_element("id", "word").text
    stable = sum(point["ts"] * point["kx"] < 2.0 for point in data["points"])
    assert f"{stable} of 441 points" in chromium.find_element("id", "stable").text
    assert "--corridor" in chromium.find_element("id", "deviation").text
    for at in (100, 230, 440):  # row by row: 21 values of T_s for each K_x
        point = data["points"][at]
        chosen = f"{{x: {point['ts']!r}, y: {point['kx']!r}}}"
        of_plot(chromium, "n_bursts", f"(plot.emit('plotly_click', {{points: [{chosen}]}}), 1)")
        # T_s K_x (n + 1) < 2
        product, shown = point["ts"] * point["kx"], point["n_bursts"]
        assert shown == -1 if product >= 2.0 else (shown + 1) * product < 2.0 <= (shown + 2) * product
        settings = f"params.yaml --set controller.kx={point['kx']} --set plant.ts={point['ts']}"
        commands = [f"agv-ncs stability {settings}", f"agv-ncs simulate {settings} --report lap.html"]
        assert chromium.find_element("id", "point-command").text.splitlines() == commands
        cells = [cell.text for cell in chromium.find_elements("css selector", "#point-values td")]
        assert ("unstable even without outages" if shown == -1 else f"{shown} slots") in cells


@pytest.mark.parametrize("axes", ["kx,curvature", "v,kx"])
def test_the_command_of_a_point_gives_its_margins(
    chromium: Chrome, agv_ncs: Callable[..., tuple[int, str]], tmp_path: Path, axes: str
) -> None:
    """Speed and curvature of a point are those of a line, or of a circle."""
    options = ("--csv", tmp_path / "map.csv", "--picture", tmp_path / "map.png", "--report", tmp_path / "map.html")
    status, said = agv_ncs("stability", "config/outages.yaml", "--map", axes, "--points", "6", *options)
    assert status == 0, said
    show(chromium, tmp_path / "map.html")
    data: Any = json.loads(chromium.execute_script("return document.getElementById('data').textContent"))
    up, across = axes.split(",")
    point = data["points"][26]
    of_plot(
        chromium,
        "n_bursts",
        f"(plot.emit('plotly_click', {{points: [{{x: {point[across]!r}, y: {point[up]!r}}}]}}), 1)",
    )
    stability, simulate = (line.split()[1:] for line in chromium.find_element("id", "point-command").text.splitlines())
    (tmp_path / "params.yaml").write_text(data["parameters"])
    for words in (stability, simulate):
        words[1] = str(tmp_path / "params.yaml")
    simulate[-1] = str(tmp_path / "lap.html")
    status, said = agv_ncs(*stability, "--json", tmp_path / "margins.json")
    assert status == 0, said
    found = json.loads((tmp_path / "margins.json").read_text())
    assert (found["n_max"]["bursts"], found["n_max"]["lifted"]) == (point["n_bursts"], point["n_lifted"])
    status, said = agv_ncs(*simulate)
    assert status == 0, said
    assert (tmp_path / "lap.html").exists()


def test_a_map_says_no_probability_that_floats_round_to_certainty(
    chromium: Chrome, agv_ncs: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    """Some 500 outages an hour lead outside at K_x = 25: that one does is not certain, only 1 to sixteen digits."""
    page = tmp_path / "map.html"
    options = ("--csv", tmp_path / "map.csv", "--picture", tmp_path / "map.png", "--report", page)
    status, said = agv_ncs(
        "stability", "config/outages.yaml", "--corridor", "0.25", "--map", "kx,ts", "--points", "5", *options
    )
    assert status == 0, said
    assert "in an hour with a probability below 1e-12" in " ".join(said.split())
    show(chromium, page)
    data: Any = json.loads(chromium.execute_script("return document.getElementById('data').textContent"))
    own = next(i for i, point in enumerate(data["points"]) if (point["kx"], point["ts"]) == (25.0, 0.005))
    assert data["points"][own]["p_hour"] == 1.0
    rarely = min(range(len(data["points"])), key=lambda i: data["points"][i]["p_hour"])
    outside = next(i for i, point in enumerate(data["points"]) if point["n_any"] == -1)

    def words(at: int) -> str:
        point = data["points"][at]
        of_plot(
            chromium, "p_hour", f"(plot.emit('plotly_click', {{points: [{{x: {point['ts']}, y: {point['kx']}}}]}}), 1)"
        )
        return chromium.find_elements("css selector", "#point-values td")[-1].text

    assert chromium.find_element("id", "verdict").text.endswith(
        "probability to leave the corridor in an hour: above 99.9 %."
    )
    assert words(own) == "above 99.9 %"
    assert words(rarely) == "below 1e-12"
    assert words(outside) == "1: it is outside even without outages"


def test_a_page_without_a_map_is_refused(agv_ncs: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    status, said = agv_ncs("stability", "config/paper.yaml", "--report", tmp_path / "map.html")
    assert status == 2
    assert "--report needs --map" in said
    with pytest.raises(FileNotFoundError):
        (tmp_path / "map.html").read_text()
