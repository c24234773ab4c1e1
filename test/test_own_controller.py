"""The page about controllers of one's own: its node drives the loop, and is not judged as another law."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")

REPOSITORY = Path(__file__).parents[1]


def test_the_node_of_the_page_drives_the_loop_and_is_not_judged(
    page_block: Callable[[str, str], str], tmp_path: Path, agv_ncs: Callable[..., tuple[int, str]]
) -> None:
    from agv_analysis.recordings.recording import read_run
    from agv_analysis.runtime.one_process import OneProcess
    from agv_analysis.runtime.recorder_node import RecorderNode
    from agv_analysis.runtime.run_setup import AS_USUAL, params_file, recording_of, scenario_that_waits
    from agv_analysis.runtime.runner import NODES, Loop, run_loops
    from agv_analysis.scenario import load_scenario
    from agv_ros.executor import EXECUTORS
    from agv_ros.stopping import stop_on_signals

    names: dict[str, Any] = {"__name__": "page"}
    exec(compile(page_block("own_controller.md", "node"), "own_controller.md", "exec"), names)
    bag = tmp_path / "bag"
    scenario = load_scenario(str(REPOSITORY / "config/outages.yaml"), ["plant.duration=3.0"])
    waiting = scenario_that_waits(scenario, recorded=True)
    with stop_on_signals() as stop, OneProcess() as process, params_file(scenario) as params:
        nodes = [process.add(NODES[name], getattr(waiting, name)) for name in ("plant", "relay", "error_detector")]
        recorder = process.add_recorder(recording_of(scenario, bag, params, AS_USUAL), RecorderNode)
        executor = EXECUTORS["events"](context=process.context)
        own = names["MyController"](context=process.context, use_global_arguments=False)
        executor.add_node(own)
        outcome = run_loops(executor, [Loop(nodes[0], nodes, recorder)], stop, lambda _: None)[0]
        own.destroy_node()
    assert (outcome.failure, outcome.recording_failure) == ("", "")
    run = read_run(bag)
    assert (len(run), dict(run.unexplained), run.gains_known) == (600, {}, False)
    assert abs(run.pose[-1, 1] - run.reference[-1, 1]) < 0.1  # it has found the track, 5 m away
    assert sum("/my_controller gave the commands" in note for note in run.notes) == 1
    status, said = agv_ncs("analyse", bag)
    assert status == 0
    assert "not judged" in said
    assert "Mean square" not in said
