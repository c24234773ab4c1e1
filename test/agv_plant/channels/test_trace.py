"""The measured channel: outcomes of a file, the same in the nodes and in the simulation."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_analysis.scenario import load_scenario
from agv_analysis.simulation.channel_outcomes import ChannelRealisation
from agv_analysis.simulation.single import simulate
from agv_plant.channels.trace import TraceError, load_trace, parse_json_trace, parse_trace, trace
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import Channel, losses
from agv_ros.parameters import ParameterError

if TYPE_CHECKING:
    from test.conftest import Drive, Start

REPOSITORY = Path(__file__).parents[3]
MEASURED = [False, True, True, False, True, False, False]


@pytest.fixture
def measured(tmp_path: Path) -> Path:
    path = tmp_path / "measured.csv"
    path.write_text("lost\n" + "".join(f"{int(lost)}\n" for lost in MEASURED))
    return path


def uplink(file: Path, end: str = "repeat", steps: int = 100) -> tuple[str, ...]:
    return (
        "relay.uplink.model=trace",
        f"relay.uplink.trace_file={file}",
        f"relay.uplink.trace_end={end}",
        f"plant.duration={steps * 0.005}",
    )


# -- the file ----------------------------------------------------------------------------------------------------------


@settings(deadline=None, derandomize=True)
@given(st.lists(st.booleans(), min_size=1), st.booleans(), st.booleans())
def test_what_was_written_is_read(lost: list[bool], words: bool, numbered: bool) -> None:
    column, text = ("verdict", ("delivered", "lost")) if words else ("lost", ("0", "1"))
    rows = [f"{k}, {text[value]},x" if numbered else text[value] for k, value in enumerate(lost)]
    header = f"k,{column},note" if numbered else column
    assert parse_trace([header, *rows], "file.csv") == tuple(lost)


@pytest.mark.parametrize(
    ("lines", "complaint"),
    [
        ([], "file.csv:1: one column must be called lost or verdict, found ''"),
        (["k,loss", "0,1"], "file.csv:1: one column must be called lost or verdict, found 'k,loss'"),
        (["lost,verdict", "0,lost"], "file.csv:1: one column must be called lost or verdict"),
        (["lost"], "file.csv: no rows below the header"),
        (["lost", "0", "", "1"], "file.csv:3: the row is empty"),
        (["k,lost", "0,0", " , ", "1,1"], "file.csv:3: the row is empty"),
        (["lost", "0", "2"], "file.csv:3: lost must be 0 or 1, found '2'"),
        (["verdict", "lost", "Lost", ""], "file.csv:3: verdict must be delivered or lost, found 'Lost'"),
        (["k,lost", "0,1", "1"], "file.csv:3: lost must be 0 or 1, found ''"),
        (["k,lost", "0,1", "2,1"], "file.csv:3: k must count 0, 1, 2 ..., expected 1, found '2'"),
    ],
)
def test_a_bad_line_is_named(lines: list[str], complaint: str) -> None:
    with pytest.raises(TraceError, match="^" + complaint.replace(".", r"\.")):
        parse_trace(lines, "file.csv")


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    for path in (tmp_path / "none.csv", tmp_path):
        with pytest.raises(TraceError, match=f"{path}: cannot be read"):
            Channel(ChannelParameters(model="trace", trace_file=str(path)), 1, "uplink")
    (tmp_path / "binary").write_bytes(b"lost\n\xff\n")
    with pytest.raises(TraceError, match="not UTF-8"):
        Channel(ChannelParameters(model="trace", trace_file=str(tmp_path / "binary")), 1, "uplink")


def test_a_measured_channel_needs_a_file() -> None:
    with pytest.raises(ParameterError, match="trace_file is empty"):
        ChannelParameters(model="trace")


# -- the channel -------------------------------------------------------------------------------------------------------


def test_ends() -> None:
    assert [trace(k, MEASURED, "repeat") for k in range(21)] == MEASURED * 3
    assert [trace(k, MEASURED, "hold") for k in range(21)] == MEASURED + [False] * 14
    assert [trace(k, MEASURED, "stop") for k in range(7)] == MEASURED
    with pytest.raises(TraceError, match="ends after 7 slots, and slot 7 is asked for"):
        trace(7, MEASURED, "stop")


@pytest.mark.parametrize("end", ["repeat", "hold"])
def test_the_simulation_s_outcomes_are_the_relay_s(measured: Path, end: str) -> None:
    c = ChannelParameters(model="trace", trace_file=str(measured), trace_end=end)
    expected = MEASURED * 3 if end == "repeat" else MEASURED + [False] * 14
    assert losses(c, 1, "uplink", 21).tolist() == expected
    assert ChannelRealisation(1, 21).outcomes(c, "downlink").tolist() == expected
    channel = Channel(c, 1, "uplink")
    assert [channel.lost(k) for k in reversed(range(21))] == expected[::-1]


def test_slot_0_is_never_lost(tmp_path: Path) -> None:
    (tmp_path / "all.csv").write_text("lost\n1\n1\n")
    c = ChannelParameters(model="trace", trace_file=str(tmp_path / "all.csv"))
    assert losses(c, 1, "uplink", 5).tolist() == [False, True, True, True, True]
    assert ChannelRealisation(1, 5).outcomes(c, "uplink").tolist() == [False, True, True, True, True]


# -- runs --------------------------------------------------------------------------------------------------------------


def test_a_trace_that_may_not_be_outrun_ends_the_simulation(measured: Path) -> None:
    scenario = load_scenario(str(REPOSITORY / "config/paper.yaml"), uplink(measured, "stop"))
    with pytest.raises(TraceError, match=r"measured\.csv: the trace ends after 7 slots"):
        simulate(scenario)


def test_nodes_lose_what_the_trace_lost(measured: Path, drive: Drive) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    run = drive(*uplink(measured))
    assert run.lost.tolist() == (MEASURED * 15)[: len(run)]
    simulated = simulate(run.scenario)
    assert abs(simulated.error - run.error).max() < 1e-9
    assert (simulated.n_ul == run.n_ul).all()


def test_a_trace_that_may_not_be_outrun_is_refused_before_the_nodes_run(
    measured: Path, agv_ncs: Callable[..., tuple[int, str]]
) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    options = [word for setting in uplink(measured, "stop") for word in ("--set", setting)]
    for how in ((), ("--processes",)):
        status, said = agv_ncs("run", "config/paper.yaml", *options, *how, "--bag", measured.parent / "bag")
        assert status == 1
        assert "the trace ends after 7 slots, and slot 99 is asked for" in said
        assert "Error occurred" not in said
        assert not (measured.parent / "bag").exists()


def test_a_trace_as_long_as_the_run_is_long_enough(measured: Path, drive: Drive) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    assert drive(*uplink(measured, "stop", steps=7)).lost.tolist() == MEASURED


def test_a_relay_at_the_end_of_its_trace_ends(measured: Path, start: Start) -> None:
    """It cannot know how long the run will be, so it says so when it comes to it, and exits."""
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    trace = {"uplink.model": "trace", "uplink.trace_file": measured, "uplink.trace_end": "stop"}
    options = [word for name, value in trace.items() for word in ("-p", f"relay:{name}:={value}")]
    modules = ("agv_plant.plant_node", "agv_cloud.error_detector_node", "agv_cloud.controller_node")
    connected = ("--ros-args", "-p", "wait_for_subscribers:=1")
    for module in modules:
        start(module, *connected)
    status, said = start("agv_plant.relay_node", *connected, *options).end()
    assert status == 1
    assert "the trace ends after 7 slots, and slot 7 is asked for" in said


# -- JSON, and what is not a trace -------------------------------------------------------------------------------------


@settings(deadline=None, derandomize=True)
@given(st.lists(st.booleans(), min_size=1), st.sampled_from(["flags", "numbers", "words"]))
def test_what_was_written_as_json_is_read(lost: list[bool], how: str) -> None:
    column = "verdict" if how == "words" else "lost"
    values = {"flags": lost, "numbers": [*map(int, lost)], "words": [("delivered", "lost")[one] for one in lost]}
    assert parse_json_trace(json.dumps({column: values[how], "note": "x"}), "file.json") == tuple(lost)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("{\n  oops", "file.json:2: Expecting property name"),
        ("[0, 1]", "file.json: must be an object with one list called lost or verdict"),
        ('{"loss": [0]}', "file.json: must be an object with one list called lost or verdict"),
        ('{"lost": 0}', "file.json: must be an object with one list called lost or verdict"),
        ('{"lost": [0], "verdict": ["lost"]}', "file.json: must be an object with one list called lost or verdict"),
        ('{"lost": []}', "file.json: the list lost is empty"),
        ('{"lost": [0, 2]}', "file.json: lost[1]: lost must be 0 or 1, found '2'"),
        ('{"lost": [0, null]}', "file.json: lost[1]: lost must be 0 or 1, found 'None'"),
        ('{"verdict": ["lost", "LOST"]}', "file.json: verdict[1]: verdict must be delivered or lost, found 'LOST'"),
    ],
)
def test_a_json_file_that_is_no_trace_is_refused(text: str, complaint: str) -> None:
    with pytest.raises(TraceError) as caught:
        parse_json_trace(text, "file.json")
    assert str(caught.value).startswith(complaint)


def test_the_same_trace_from_both_kinds_of_file(measured: Path, tmp_path: Path) -> None:
    path = tmp_path / "measured.json"
    path.write_text(json.dumps({"lost": MEASURED}))
    assert load_trace(str(path)) == load_trace(str(measured)) == tuple(MEASURED)


@pytest.mark.parametrize("recording", ["bags/sample", "somewhere/run_0.mcap"])
def test_a_recording_is_no_trace_and_the_error_says_how_to_make_one(recording: str) -> None:
    path = str(REPOSITORY / recording)
    with pytest.raises(TraceError, match=r"is a recording; make a trace of it with agv-ncs replay .* --outages FILE"):
        load_trace(path)
