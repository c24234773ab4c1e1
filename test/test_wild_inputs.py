"""Files, numbers and names that no one means: one line each, and bounded memory."""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from agv_analysis.scenario import load_scenario
from agv_analysis.simulation.single import MOST_STEPS, simulate
from agv_cloud.reference import track_file
from agv_cloud.reference.track_file import TrackFileError, load_track, parse_track
from agv_plant.channels.timed_trace import read_trace
from agv_plant.channels.trace import TraceError, parse_json_trace
from agv_ros.errors import UserError
from agv_ros.json_text import parse_json

CONFIG = str(Path(__file__).parents[1] / "config/outages.yaml")
DEEP, LONG = "[" * 200_000, '{"lost": ' + "9" * 5000 + "}"


@pytest.mark.parametrize("text", [DEEP, LONG, "{", b"\xff\xfe\xfd"])
def test_json_that_cannot_be_is_an_error_of_one_kind(text: str | bytes) -> None:
    with pytest.raises(json.JSONDecodeError):
        parse_json(text)


@pytest.mark.parametrize("text", [DEEP, LONG])
def test_a_trace_in_such_json_is_refused_in_a_line(tmp_path: Path, text: str) -> None:
    with pytest.raises(TraceError) as refused:
        parse_json_trace(text, "trace.json")
    assert "\n" not in str(refused.value)
    (tmp_path / "trace.json").write_text(text)
    with pytest.raises(TraceError):
        read_trace(str(tmp_path / "trace.json"), "uplink")


@pytest.mark.parametrize("schedule", ["1e308: p=0.1", "1e10: p=0.1", "1: outage=1e308", "1: outage=1 every 1e308"])
def test_a_schedule_beyond_all_time_is_refused(schedule: str) -> None:
    with pytest.raises(UserError, match=r"in \[0, 1e\+09\] s"):
        simulate(load_scenario(CONFIG, [f"relay.uplink.schedule={schedule}"]))


def test_a_run_that_does_not_go_into_memory_is_not_begun() -> None:
    with pytest.raises(UserError, match=f"more than {MOST_STEPS} does not go into memory"):
        simulate(load_scenario(CONFIG, ["plant.duration=1e300"]))


def test_a_run_beyond_the_end_of_stamps_is_not_begun() -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    from agv_analysis.runtime.run_setup import scenario_that_waits

    for duration in ("1e300", "2147483647.0"):
        with pytest.raises(UserError, match="a stamp of ROS ends at 2147483648 s"):
            scenario_that_waits(load_scenario(CONFIG, [f"plant.duration={duration}"]), recorded=False)
    scenario_that_waits(load_scenario(CONFIG, ["plant.duration=.inf"]), recorded=False)


def test_a_track_of_too_many_lines_is_refused_before_it_is_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(track_file, "MOST_ROWS", 1000)
    lines = (f"{i},1.0,0.0\n" if i >= 0 else "t,v,w\n" for i in itertools.count(-1))  # without end
    with pytest.raises(TrackFileError, match="more than 1000 rows"):
        parse_track(lines, "long.csv")


@pytest.mark.parametrize("name", ["a" * 300, "nul\0byte", "surrogate\ud800"])
def test_a_name_that_no_file_can_have_is_refused_in_a_line(name: str) -> None:
    with pytest.raises(TrackFileError) as refused:
        load_track(name)
    assert "\n" not in str(refused.value)


def test_a_pipe_is_no_track(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (str(tmp_path / "pipe"), "/dev/zero"):
        with pytest.raises(TrackFileError, match="is a pipe or a device"):
            load_track(path)


def test_a_path_of_more_than_255_characters_is_one_line(agv_ncs: Callable[..., tuple[int, str]]) -> None:
    status, said = agv_ncs("analyse", "b" * 300)
    assert (status, "Traceback" in said, "File name too long" in said) == (1, False, True)
