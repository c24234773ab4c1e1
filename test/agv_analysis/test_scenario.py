"""A scenario: four nodes' parameters from one file, written out and read back, by us and by ROS."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_analysis.scenario import PART_CHOICES, SCHEMAS, Scenario, load_scenario, parse_scenario
from agv_cloud.control.registry import CONTROL_LAWS
from agv_cloud.reference.tracks import TRACKS
from agv_plant.channels.registry import MODELS
from agv_ros.parameters import Parameter, ParameterError, as_dict, build, parameters_of
from agv_ros.stamps import Grid


def defaults() -> Scenario:
    """A scenario of which a file says nothing."""
    return Scenario(**{node: schema() for node, schema in SCHEMAS.items()})


def refusal(text: str, *sets: str) -> str:
    with pytest.raises(ParameterError) as caught:
        parse_scenario(text, "f.yaml", sets)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_a_file_does_not_say_keeps_its_default() -> None:
    found = parse_scenario("controller: {ros__parameters: {kx: 5.0}}", "f.yaml")
    assert found == dataclasses.replace(defaults(), controller=dataclasses.replace(defaults().controller, kx=5.0))


def test_the_grid_is_that_of_every_node() -> None:
    found = parse_scenario("relay: {ros__parameters: {ts: 0.01, start_time: 3.0}}", "f.yaml")
    assert found.grid == Grid(3_000_000_000, 10_000_000)
    assert {getattr(found, node).ts for node in SCHEMAS} == {0.01}


def test_sections_of_other_nodes_are_theirs() -> None:
    text = """
rviz: {ros__parameters: {anything: [1, 2]}}
relay_2: {ros__parameters: {seed: 9}}
local_costmap: {local_costmap: {ros__parameters: {width: 3}}}
controller: {ros__parameters: {kx: 5.0}}
"""
    assert parse_scenario(text, "f.yaml").controller.kx == 5.0
    assert parse_scenario(text, "f.yaml").relay == defaults().relay


@pytest.mark.parametrize(
    ("title", "meant"),
    [("controler", "controller"), ("Plant", "plant"), ("relya", "relay"), ("eror_detector", "error_detector")],
)
def test_a_misspelt_section_is_not_ignored(title: str, meant: str) -> None:
    message = refusal(f"{title}: {{ros__parameters: {{}}}}")
    assert message == f"f.yaml: no node is called {title!r}: is section {meant!r} meant?"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("/**: {ros__parameters: {ts: -0.005}}", "plant.ts must be in [1e-06, 10], got -0.005"),
        ("/**: {ros__parameters: {ts: .nan}}", "plant.ts must be in [1e-06, 10], got nan"),
        ("/**: {ros__parameters: {start_time: 0.0}}", "plant.start_time must be in [0.001, 2e+09], got 0.0"),
        ("controller: {ros__parameters: {kx: .inf}}", "controller.kx must be in [0, 1e+06], got inf"),
        ("controller: {ros__parameters: {v_max: 0.0}}", "controller.v_max must be in (0, inf], got 0.0"),
        ("relay: {ros__parameters: {uplink: {p: 1.5}}}", "relay.uplink.p must be in [0, 1], got 1.5"),
        ("relay: {ros__parameters: {uplink: {model: rain}}}", "relay.uplink.model must be one of " + ", ".join(MODELS)),
        ("relay: {ros__parameters: {uplink: {n: -1}}}", "relay.uplink.n must be in [0, 1e+06], got -1"),
        ("relay: {ros__parameters: {seed: -1}}", "relay.seed must be in [0, "),
        ("error_detector: {ros__parameters: {track: moon}}", f"one of {', '.join(TRACKS)}, csv, path, got 'moon'"),
        ("error_detector: {ros__parameters: {policy: guess}}", "error_detector.policy must be one of hold"),
        ("plant: {ros__parameters: {integration: rk4}}", "plant.integration must be one of euler, arc, got 'rk4'"),
        ("plant: {ros__parameters: {initial_pose: [0.0, 5.0]}}", "plant.initial_pose must be 3 finite numbers, got 2"),
        ("error_detector: {ros__parameters: {corridor_along: 1.0}}", "but error_detector.corridor is 0: name the"),
        ("plant: {ros__parameters: {duration: 0.0}}", "plant.duration must be in (0, inf], got 0.0"),
        ("error_detector: {ros__parameters: {track: csv}}", "error_detector.track_file is empty: name a file"),
        (
            "/**: {ros__parameters: {ts: 1.0}}\nerror_detector: {ros__parameters: {lap_time: 15.9}}",
            "error_detector.lap_time must be at least 16 ts = 16 s, got 15.9",
        ),
    ],
)
def test_what_cannot_be_run_is_refused(text: str, words: str) -> None:
    message = refusal(text)
    assert message.startswith("f.yaml: ")
    assert words in message


def test_a_setting_can_complete_what_the_file_leaves_open(tmp_path: Path) -> None:
    path = tmp_path / "f.yaml"
    path.write_text("error_detector: {ros__parameters: {track: csv}}", encoding="utf-8")
    assert load_scenario(str(path), ["error_detector.track_file=a.csv"]).error_detector.track_file == "a.csv"


# -- written out and read back ---------------------------------------------------------------------------------------


def values_of(found: Parameter) -> st.SearchStrategy[Any]:
    """Values that the parameter allows."""
    if found.kind == "double":
        low = found.low if found.low is not None else found.above
        high = found.high if found.high is not None and math.isfinite(found.high) else None
        finite = st.floats(low, high, allow_nan=False, allow_infinity=False, exclude_min=found.above is not None)
        return finite | st.just(math.inf) if found.high == math.inf else finite
    if found.kind == "integer":
        assert found.low is not None
        assert found.high is not None
        return st.integers(int(found.low), int(found.high))
    if found.kind == "bool":
        return st.booleans()
    if found.kind == "double_array":
        numbers, length = st.floats(allow_nan=False, allow_infinity=False), found.length
        return st.lists(numbers, min_size=length or 1, max_size=length or 9).map(tuple)
    return st.sampled_from(found.choices) if found.choices else st.text()


ALONE = {
    "track", "wait_for_subscribers", "stop_timeout", "frame_prefix", "plan_steps", "downlink_policy", "look_ahead",
    "stamp_window", "corridor_along",
    *(f"{link}.{name}" for link in ("uplink", "downlink")
      for name in ("schedule", "hole_circles", "hole_polygons", "reliable")),
}  # fmt: skip
"""What a file may not set for one node without setting something else."""


@st.composite
def scenarios(draw: st.DrawFn) -> Scenario:
    """Any scenario that the schemas allow."""
    lines = {}
    for node, schema in SCHEMAS.items():
        known = parameters_of(schema)
        chosen = draw(st.sets(st.sampled_from(sorted(set(known) - {"ts", "start_time", "lap_time"})), max_size=4))
        lines[node] = {name: draw(values_of(known[name])) for name in chosen - ALONE}
    for link in ("uplink", "downlink"):
        if lines["relay"].get(f"{link}.model") == "trace":
            lines["relay"][f"{link}.trace_file"] = "outages.csv"  # a trace needs one
        if lines["relay"].get(f"{link}.model") == "shared":
            lines["relay"][f"{link}.vehicles"] = 1000
        if lines["relay"].get(f"{link}.model") == "coverage_hole":
            lines["relay"][f"{link}.hole_circles"] = (0.0, 0.0, 1.0)
    law = lines["controller"].get("law")
    if law is not None and "look_ahead" in CONTROL_LAWS.find(law).arguments:
        for values in lines.values():
            values["look_ahead"] = 1.0
    return Scenario(**{node: build(schema, lines[node], node) for node, schema in SCHEMAS.items()})


@settings(deadline=None, derandomize=True)
@given(scenarios())
def test_a_scenario_written_out_is_the_same_scenario(scenario: Scenario) -> None:
    assert parse_scenario(scenario.to_yaml(of_all_parts=True), "f.yaml") == scenario


@settings(deadline=None, derandomize=True)
@given(scenarios())
def test_only_what_belongs_to_the_parts_chosen_is_written_out(scenario: Scenario) -> None:
    text = scenario.to_yaml()
    found = parse_scenario(text, "f.yaml")
    assert found.to_yaml() == text
    for node in SCHEMAS:
        values, read = as_dict(getattr(scenario, node)), as_dict(getattr(found, node))
        others: set[str] = set()
        if node in PART_CHOICES:
            choice = PART_CHOICES[node]
            chosen = values[choice.parameter]
            others = {name for part in choice.registry.names() if part != chosen for name in choice.names(part)}
        defaults = as_dict(SCHEMAS[node]())
        assert read == {name: defaults[name] if name in others else value for name, value in values.items()}


@pytest.mark.parametrize("track_file", ["", "1e3", "y", "no", "~", "inf", "track 1.csv", "10", "ä.csv", "a: b", "1:30"])
def test_a_scenario_written_out_is_the_same_to_ros(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, track_file: str
) -> None:
    rclpy = pytest.importorskip("rclpy", reason="ROS 2's own reader of params files comes with rclpy")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    path = tmp_path / "params.yaml"
    edge = dataclasses.replace(
        defaults().error_detector, track_file=track_file, lap_time=1e16, track_start=(1e-7, -0.0, 2.5)
    )
    path.write_text(dataclasses.replace(defaults(), error_detector=edge).to_yaml(), encoding="utf-8")
    context = rclpy.Context()
    rclpy.init(context=context, args=["--ros-args", "--params-file", str(path)], domain_id=88)
    try:
        node = rclpy.create_node("error_detector", context=context)
        for name, value in as_dict(edge).items():
            default = list(value) if isinstance(value, tuple) else value
            found = node.declare_parameter(name, type(default)(default)).value
            assert repr(tuple(found) if isinstance(value, tuple) else found) == repr(value)
        node.destroy_node()
    finally:
        context.try_shutdown()
