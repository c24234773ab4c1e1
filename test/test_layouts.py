"""Layouts for other tools: every topic and field that they name is in a recording."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from agv_analysis.bags import Bag, read_bag

REPOSITORY = Path(__file__).parents[1]
CONFIG = REPOSITORY / "config"
FOXGLOVE: dict[str, Any] = json.loads((CONFIG / "foxglove.json").read_text())
PLOTJUGGLER = ET.parse(CONFIG / "plotjuggler.xml").getroot()

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
    curves = [curve.attrib for curve in PLOTJUGGLER.iter("curve")]
    keys = (("curve_x", "curve_y") if "curve_x" in curve else ("name",) for curve in curves)
    return [curve[key] for curve, of_curve in zip(curves, keys, strict=True) for key in of_curve]


def series(bag: Bag, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What PlotJuggler draws under this name: seconds since the first message, and values."""
    topic = next(topic for topic in bag.topics if name.startswith(topic + "/"))
    first = min(int(bag[topic]["log_time_ns"][0]) for topic in bag.topics)
    values = bag[topic][name.removeprefix(topic + "/").replace("/", ".")]
    return (bag[topic]["log_time_ns"] - first) * 1e-9, values.astype(np.float64)


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
    return sorted({recorded(text) for text in strings(FOXGLOVE["configById"]) if text.startswith("/")})


def recorded(path: str) -> str:
    """The path of the recorded field behind a path of Foxglove's: a script of the layout passes some on."""
    for script in FOXGLOVE["userNodes"].values():
        source = script["sourceCode"]
        (output,) = re.findall(r'^export const output = "(.+)";$', source, re.MULTILINE)
        (topic,) = re.findall(r'^export const inputs = \["(.+)"\];$', source, re.MULTILINE)
        for name, field in re.findall(r"(\w+): event\.message\.([\w.]+)", source):
            if path == f"{output}.{name}":
                return f"{topic}.{field}"
    return path


def topic_of(path: str) -> str:
    return path.partition(".")[0]


def plots_of_foxglove() -> list[dict[str, Any]]:
    return [panel for name, panel in FOXGLOVE["configById"].items() if name.startswith("Plot!")]


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
        _, values = series(sample, name)
        assert np.ptp(values) > 0.0, name


def test_plotjuggler_s_limits_leave_out_the_start_alone(sample: Bag) -> None:
    # metres from its reference, the AGV is told to drive at more than 100 m/s: beside that nothing else would be seen
    limited = [plot for plot in PLOTJUGGLER.iter("plot") if plot.find("limitY[@min]") is not None]
    assert len(limited) == 2
    for plot in limited:
        limits = plot.find("limitY")
        assert limits is not None
        low, high = float(limits.get("min", "nan")), float(limits.get("max", "nan"))
        outside: list[float] = []
        for curve in plot.iter("curve"):
            times, values = series(sample, curve.attrib["name"])
            outside += times[(values < low) | (values > high)].tolist()
        assert outside
        assert max(outside) < 1.0


def test_plotjuggler_draws_commands_as_held() -> None:
    # "Step (post)" in its menu; "Steps" is "Steps (pre)", which draws a command before it was given
    plots = [
        plot for plot in PLOTJUGGLER.iter("plot") if any("/cmd_vel/" in c.attrib["name"] for c in plot.iter("curve"))
    ]
    assert [plot.get("style") for plot in plots] == ["StepsInv", "StepsInv"]


def test_plotjuggler_s_track_shows_which_poses_were_lost() -> None:
    # dots, for a line would bridge an outage; those that arrived over those that were sent
    (track,) = PLOTJUGGLER.iterfind(".//plot[@mode='XYPlot']")
    assert track.get("style") == "Dots"
    assert [curve.attrib["curve_x"].split("/pose")[0] for curve in track.iter("curve")] == ["/agv", "/edge"]


def test_plotjuggler_counts_time_from_the_start(sample: Bag) -> None:
    offset = PLOTJUGGLER.find("use_relative_time_offset")
    assert offset is not None
    assert offset.get("enabled") == "1"
    # either choice of its dialog, publish time or log time, is the loop's time
    for topic in sample.topics:
        assert np.array_equal(sample[topic]["publish_time_ns"], sample[topic]["log_time_ns"]), topic


def test_plotjuggler_s_layout_has_the_form_that_it_reads() -> None:
    # as its own reader goes through it: PlotDocker::restoreSplitter and PlotWidget::xmlLoadState
    assert [tab.tag for tab in PLOTJUGGLER.find("tabbed_widget") or ()] == ["Tab", "Tab"]
    for splitter in PLOTJUGGLER.iter("DockSplitter"):
        assert splitter.get("orientation") in ("|", "-")
        sizes = [float(size) for size in splitter.get("sizes", "").split(";")]
        assert len(splitter) == int(splitter.get("count", "0")) == len(sizes)
        assert sum(sizes) == pytest.approx(1.0, abs=1e-5)
    for plot in PLOTJUGGLER.iter("plot"):
        assert plot.get("mode") in ("TimeSeries", "XYPlot")
        assert plot.get("style") in ("Lines", "Dots", "LinesAndDots", "Sticks", "Steps", "StepsInv")
        for curve in plot.iter("curve"):
            wanted = {"name", "color"} | ({"curve_x", "curve_y"} if plot.get("mode") == "XYPlot" else set())
            assert set(curve.attrib) == wanted


def test_foxglove_finds_every_path(sample: Bag) -> None:
    names = of_foxglove()
    assert len(names) >= 11
    plain = {name for name in names if "." not in name}
    assert plain - set(LATCHED) <= set(sample.topics)
    assert [name for name in names if "." in name and not exists(sample, name, ".")] == []


def test_foxglove_shows_every_panel_that_it_describes() -> None:
    shown = {text for text in strings(FOXGLOVE["layout"]) if re.match(r"\w+!", text)}
    assert shown == set(FOXGLOVE["configById"])


def test_foxglove_s_panels_have_titles_where_both_programs_look() -> None:
    titles = [(panel["foxglovePanelTitle"], panel["lichtblickPanelTitle"]) for panel in FOXGLOVE["configById"].values()]
    assert all(title and title == same for title, same in titles)
    assert len(set(titles)) == len(titles)


def test_foxglove_s_track_pairs_x_and_y_of_the_same_pose() -> None:
    # They are paired by their places in two rows, so both must be of one recorded topic. Yet the layout
    # must name two topics: Lichtblick's CustomDatasetsBuilder.handleMessageRange takes a batch of messages for x
    # or for y, not for both.
    (track,) = (plot for plot in plots_of_foxglove() if plot["xAxisVal"] == "custom")
    (y,), x = (path["value"] for path in track["paths"]), track["xAxisPath"]["value"]
    assert topic_of(x) != topic_of(y)
    assert (recorded(x), recorded(y)) == ("/agv/pose.pose.position.x", "/agv/pose.pose.position.y")


def test_foxglove_s_axes_leave_out_the_start_only(sample: Bag) -> None:
    limited = [plot for plot in plots_of_foxglove() if "minYValue" in plot]
    assert len(limited) == 2
    for plot in limited:
        curves = [series(sample, path["value"].replace(".", "/")) for path in plot["paths"]]
        outside = [times[(values < plot["minYValue"]) | (values > plot["maxYValue"])] for times, values in curves]
        assert 0.0 < np.concatenate(outside).max() < 0.2, plot["foxglovePanelTitle"]


def test_foxglove_s_scene_is_in_the_frame_of_the_poses(sample: Bag) -> None:
    scene = FOXGLOVE["configById"]["3D!scene"]
    for topic in set(scene["topics"]) - set(LATCHED):
        assert set(sample[topic]["header.frame_id"]) == {scene["fixedFrame"].encode()}


def test_rviz_shows_every_display() -> None:
    # a display is switched off until its configuration says otherwise
    manager = yaml.safe_load((CONFIG / "agv_ncs.rviz").read_text())["Visualization Manager"]
    assert [display["Name"] for display in manager["Displays"] if not display.get("Enabled")] == []
    assert manager["Enabled"]
    assert manager["Global Options"]["Fixed Frame"] == "map"


def test_rviz_leaves_room_for_the_view() -> None:
    # without a size the window is small, and a wide panel such as Time leaves nothing of the view beside it
    layout = yaml.safe_load((CONFIG / "agv_ncs.rviz").read_text())
    assert [panel["Class"] for panel in layout["Panels"]] == ["rviz_common/Displays"]
    window = layout["Window Geometry"]
    assert window["Width"] >= 1000
    assert window["Height"] >= 700
    assert window["Hide Right Dock"]


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
