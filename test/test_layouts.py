"""Layouts for other tools: every topic and field that they name is in a recording."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import yaml

from agv_analysis.bags import Bag, read_bag

REPOSITORY = Path(__file__).parents[1]
CONFIG = REPOSITORY / "config"

LATCHED = {"/edge/reference": "nav_msgs/msg/Path"}
"""Topics of a running loop that a recording does not hold."""


@pytest.fixture(scope="module")
def sample() -> Bag:
    return read_bag(REPOSITORY / "bags/sample")


def exists(bag: Bag, name: str, separator: str) -> bool:
    """Does a topic of the bag have this field? `name` is the topic, the separator, and the path of the field."""
    for topic in bag.topics:
        if name.startswith(topic + separator):
            return name.removeprefix(topic + separator).replace(separator, ".") in (bag[topic].dtype.names or ())
    return False


def of_plotjuggler() -> list[str]:
    root = ET.parse(CONFIG / "plotjuggler.xml").getroot()
    curves = [curve.attrib for curve in root.iter("curve")]
    keys = (("curve_x", "curve_y") if "curve_x" in curve else ("name",) for curve in curves)
    return [curve[key] for curve, of_curve in zip(curves, keys, strict=True) for key in of_curve]


def strings(tree: object) -> Iterator[str]:
    if isinstance(tree, str):
        yield tree
    elif isinstance(tree, dict):
        for key, value in tree.items():
            yield from (*strings(key), *strings(value))
    elif isinstance(tree, list):
        for value in tree:
            yield from strings(value)


def of_foxglove() -> list[str]:
    panels = json.loads((CONFIG / "foxglove.json").read_text())["configById"]
    return sorted({text for text in strings(panels) if text.startswith("/")})


def test_the_check_sees_what_is_not_there(sample: Bag) -> None:
    assert exists(sample, "/agv/pose/pose/position/x", "/")
    assert exists(sample, "/agv/pose.pose.position.x", ".")
    assert not exists(sample, "/agv/pose/pose/position/u", "/")
    assert not exists(sample, "/agv/poses/pose/position/x", "/")


def test_plotjuggler_finds_every_curve(sample: Bag) -> None:
    names = of_plotjuggler()
    assert len(names) >= 10
    assert [name for name in names if not exists(sample, name, "/")] == []


def test_plotjuggler_s_plots_are_not_empty(sample: Bag) -> None:
    for name in of_plotjuggler():
        topic = next(topic for topic in sample.topics if name.startswith(topic + "/"))
        column = sample[topic][name.removeprefix(topic + "/").replace("/", ".")]
        assert np.ptp(column) > 0.0, name


def test_plotjuggler_s_layout_has_the_form_that_it_reads() -> None:
    # as its own reader goes through it: PlotDocker::restoreSplitter and PlotWidget::xmlLoadState
    root = ET.parse(CONFIG / "plotjuggler.xml").getroot()
    assert [tab.tag for tab in root.find("tabbed_widget") or ()] == ["Tab", "Tab"]
    for splitter in root.iter("DockSplitter"):
        assert splitter.get("orientation") in ("|", "-")
        sizes = [float(size) for size in splitter.get("sizes", "").split(";")]
        assert len(splitter) == int(splitter.get("count", "0")) == len(sizes)
        assert sum(sizes) == pytest.approx(1.0, abs=1e-5)
    for plot in root.iter("plot"):
        assert plot.get("mode") in ("TimeSeries", "XYPlot")
        for curve in plot.iter("curve"):
            wanted = {"name", "color"} | ({"curve_x", "curve_y"} if plot.get("mode") == "XYPlot" else set())
            assert set(curve.attrib) == wanted


def test_foxglove_finds_every_path(sample: Bag) -> None:
    names = of_foxglove()
    assert len(names) >= 9
    plain = {name for name in names if "." not in name}
    assert plain - set(LATCHED) <= set(sample.topics)
    assert [name for name in names if "." in name and not exists(sample, name, ".")] == []


def test_foxglove_shows_every_panel_that_it_describes() -> None:
    layout = json.loads((CONFIG / "foxglove.json").read_text())
    shown = {text for text in strings(layout["layout"]) if re.match(r"\w+!", text)}
    assert shown == set(layout["configById"])


def test_rviz_shows_every_display() -> None:
    # a display is switched off until its configuration says otherwise
    manager = yaml.safe_load((CONFIG / "agv_ncs.rviz").read_text())["Visualization Manager"]
    assert [display["Name"] for display in manager["Displays"] if not display.get("Enabled")] == []
    assert manager["Enabled"]
    assert manager["Global Options"]["Fixed Frame"] == "map"


def test_rviz_subscribes_to_what_there_is(sample: Bag) -> None:
    kinds = {
        "rviz_default_plugins/Path": "nav_msgs/msg/Path",
        "rviz_default_plugins/Pose": "geometry_msgs/msg/PoseStamped",
    }
    displays = yaml.safe_load((CONFIG / "agv_ncs.rviz").read_text())["Visualization Manager"]["Displays"]
    there = {name: topic.type for name, topic in sample.topics.items()} | LATCHED
    of_topics = [display for display in displays if "Topic" in display]
    assert len(of_topics) == 3
    for display in of_topics:
        assert there[display["Topic"]["Value"]] == kinds[display["Class"]]
