"""What the nodes said of their parameters: recorded on real DDS, and read from bags of other recorders."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")

from mcap.reader import make_reader
from mcap.writer import Writer
from rclpy.parameter import Parameter
from rosbags.typesys import Stores, get_typestore

from agv_analysis.bags import read_bag
from agv_analysis.bags.message_definitions import schema_of
from agv_analysis.bags.writer import NODES_NAME
from agv_analysis.recordings.recording import read_run
from agv_analysis.run import ParameterChange
from agv_analysis.runtime.one_process import OneProcess
from agv_analysis.runtime.recorder_node import RecorderNode
from agv_analysis.runtime.runner import loop_of, run_fleet, run_loops
from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.stability.driven_commands import driven_commands
from agv_cloud.controller_node import ControllerNode
from agv_ros.executor import EXECUTORS, spin_for
from agv_ros.params_file import parse_sections
from agv_ros.stopping import stop_on_signals

if TYPE_CHECKING:
    from test.conftest import Drive

REPOSITORY = Path(__file__).parents[3]
SAMPLE = REPOSITORY / "bags/sample"


def outages(*settings: str) -> Scenario:
    return load_scenario(str(REPOSITORY / "config/outages.yaml"), settings)


def drive_and_set(scenario: Scenario, bag: Path, node: str, **values: Any) -> int:
    """A run over DDS in which a node's parameters change once 500 steps are done; the number of steps done by then."""
    changed: list[int] = []
    with stop_on_signals() as stop, OneProcess() as process:
        loop = loop_of(process, scenario, bag)
        target = next(other for other in loop.nodes if other.get_name() == node)

        def look(k: int) -> None:
            if k >= 500 and not changed:
                changed.append(k)
                done = target.set_parameters([Parameter(name, value=value) for name, value in values.items()])
                assert all(result.successful for result in done)

        (outcome,) = run_loops(EXECUTORS["events"](context=process.context), [loop], stop, look)
    assert (outcome.failure, outcome.recording_failure) == ("", "")
    return changed[0]


def test_nodes_say_their_parameters_and_the_bag_keeps_them(drive: Drive, tmp_path: Path) -> None:
    drive("plant.duration=0.5", "controller.kx=50.0", config="outages")
    bag = read_bag(tmp_path / "bag", topics=())
    said = bag.metadata[NODES_NAME]
    assert {node: said[node] for node in ("plant", "relay", "error_detector", "controller")} == {
        "plant": "/plant", "relay": "/relay", "error_detector": "/error_detector", "controller": "/controller",
    }  # fmt: skip
    sections = parse_sections(said["params"], "said")
    assert (sections["controller"]["kx"], sections["relay"]["uplink.model"]) == (50.0, "gilbert_elliott")
    assert sections["plant"]["initial_pose"] == [0.0, 5.0, pytest.approx(1.5707963)]
    assert "/parameter_events" not in bag.topics  # nothing changed


def test_what_a_node_said_counts_more_than_a_file(drive: Drive, tmp_path: Path) -> None:
    """The bag of kx = 50 with a params file of kx = 25, and with the wrong sampling period in it."""
    drive("plant.duration=0.5", "controller.kx=50.0", config="outages")
    config = tmp_path / "told.yaml"
    config.write_text(outages("plant.ts=0.02").to_yaml())
    run = read_run(tmp_path / "bag", config)
    assert (run.scenario.controller.kx, run.ts, run.parameter_changes) == (50.0, 0.005, ())
    assert f"controller.kx is 25.0 in {config}, but the node said 50.0, which counts" in run.notes
    assert sum(f".ts is 0.02 in {config}, but the node said 0.005, which counts" in note for note in run.notes) == 1
    assert not driven_commands(run).differs


def test_a_live_change_is_part_of_the_run(tmp_path: Path) -> None:
    k = drive_and_set(outages("plant.duration=5.0"), tmp_path / "bag", "controller", kx=50.0, v_max=3.0)
    run = read_run(tmp_path / "bag")
    assert run.scenario.controller.kx == 25.0
    assert {(change.node, change.name, change.old, change.new) for change in run.parameter_changes} == {
        ("controller", "kx", 25.0, 50.0), ("controller", "v_max", float("inf"), 3.0),
    }  # fmt: skip
    # The controller has answered k - 1 or k, whether or not the plant has heard of it.
    assert {change.k for change in run.parameter_changes} <= {k, k + 1}
    assert any(note.startswith("controller.kx was changed while the loop ran: 25.0 before step") for note in run.notes)
    assert not driven_commands(run).differs
    events = read_bag(tmp_path / "bag", topics=("/parameter_events",))
    assert not events.problems
    # Logged at its place in the loop's time, not behind all of it.
    step = (events["/parameter_events"]["log_time_ns"] - 1_000_000_000) // 5_000_000
    assert set(step.tolist()) <= set(range(k - 2, k + 3))


def test_a_change_at_the_relay_is_told(tmp_path: Path) -> None:
    drive_and_set(outages("plant.duration=4.0"), tmp_path / "bag", "relay", **{"uplink.p": 0.5})
    (change,) = read_run(tmp_path / "bag").parameter_changes
    assert (change.node, change.name, change.new) == ("relay", "uplink.p", 0.5)


def test_each_recorder_of_a_fleet_asks_its_own_vehicle(tmp_path: Path) -> None:
    fleet = {
        name: outages("plant.duration=0.3", f"controller.kx={kx}") for name, kx in (("agv_01", 20.0), ("agv_02", 30.0))
    }
    for outcome in run_fleet(fleet, tmp_path / "bags", lambda _: None):
        assert (outcome.failure, outcome.recording_failure) == ("", "")
    for name, kx in (("agv_01", 20.0), ("agv_02", 30.0)):
        said = read_bag(tmp_path / "bags" / name, topics=()).metadata[NODES_NAME]
        assert said["controller"] == f"/{name}/controller"
        assert parse_sections(said["params"], "said")["controller"]["kx"] == kx


# -- bags of other recorders -------------------------------------------------------------------------------------------


def event(node: str, **fields: dict[str, float]) -> bytes:
    """A message of /parameter_events, as another library writes it."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = {
        name: store.types[f"rcl_interfaces/msg/{name}"] for name in ("Parameter", "ParameterValue", "ParameterEvent")
    }

    def value(number: float) -> Any:
        nothing: Any = np.empty(0, np.uint8), np.empty(0, bool), np.empty(0, np.int64), np.empty(0), []
        return types["ParameterValue"](3, False, 0, number, "", *nothing)

    known = {
        field: [types["Parameter"](name, value(number)) for name, number in values.items()]
        for field, values in fields.items()
    }
    stamp = store.types["builtin_interfaces/msg/Time"](1, 0)
    empty: dict[str, list[Any]] = {"new_parameters": [], "changed_parameters": [], "deleted_parameters": []}
    message = types["ParameterEvent"](stamp=stamp, node=node, **(empty | known))
    return bytes(store.serialize_cdr(message, "rcl_interfaces/msg/ParameterEvent"))


def sample_with(path: Path, events: list[tuple[int, bytes]], said: dict[str, str] | None = None) -> Path:
    """The sample bag, which was recorded before nodes were asked, with messages of /parameter_events by log time.

    And with what nodes `said`, if anything.
    """
    with next(SAMPLE.glob("*.mcap")).open("rb") as source, path.open("wb") as file:
        reader, writer = make_reader(source), Writer(file)
        writer.start(profile="ros2")
        channels: dict[str, int] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.topic not in channels:
                known = writer.register_schema(schema.name, "ros2msg", schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", known)
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
        kind = "rcl_interfaces/msg/ParameterEvent"
        own = writer.register_channel(
            "/parameter_events", "cdr", writer.register_schema(kind, "ros2msg", schema_of(kind).encode())
        )
        for log_time_ns, data in events:
            writer.add_message(own, log_time_ns, data, log_time_ns)
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        if said is not None:
            writer.add_metadata(NODES_NAME, said)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def at(k: int) -> int:
    """Log time [ns] just before step k."""
    return 1_000_000_000 + k * 5_000_000 - 1


def test_a_bag_from_before_nodes_were_asked_is_read_as_ever() -> None:
    run = read_run(SAMPLE)
    assert run.parameter_changes == ()
    assert not [note for note in run.notes if "said" in note or "changed" in note]


def test_events_of_a_node_without_diagnostics_of_changes(tmp_path: Path) -> None:
    """A controller of somebody else, which only does what every ROS 2 node does."""
    declared = event("/controller", new_parameters={"kx": 20.0, "its_own": 1.0})
    changed = event("/controller", changed_parameters={"kx": 30.0})
    again = event("/controller", changed_parameters={"kx": 25.0, "its_own": 2.0})
    others = event("/agv_02/controller", changed_parameters={"kx": 1.0})
    run = read_run(
        sample_with(tmp_path / "bag.mcap", [(at(0), declared), (at(700), changed), (at(800), others), (at(900), again)])
    )
    assert run.scenario.controller.kx == 20.0
    assert run.parameter_changes == (
        ParameterChange(700, "controller", "kx", 20.0, 30.0), ParameterChange(900, "controller", "kx", 30.0, 25.0),
    )  # fmt: skip
    # The sample was driven with 25: what the controller says does not make it true, and its commands tell.
    found = driven_commands(run)
    assert found.first == 0
    assert found.pieces[0].driven == {"kx": pytest.approx(25.0, abs=1e-6)}


def test_a_value_that_a_node_says_and_no_schema_allows_is_left_out(tmp_path: Path) -> None:
    refused = event("/controller", new_parameters={"kx": -3.0, "v_max": 0.0})
    run = read_run(sample_with(tmp_path / "bag.mcap", [(at(0), refused)]))
    assert run.scenario == read_run(SAMPLE).scenario


def test_a_node_that_was_started_again_says_its_parameters_again(tmp_path: Path) -> None:
    """A controller ends after step 499 and is started with another gain; the recorder asks both."""
    context = rclpy.Context()
    rclpy.init(context=context)
    options: dict[str, Any] = {"context": context, "use_global_arguments": False}
    executor = EXECUTORS["single"](context=context)
    where = tmp_path / "bag"
    recorder = RecorderNode(parameter_overrides=[Parameter("bag", value=str(where))], **options)
    executor.add_node(recorder)
    grid, client = outages().grid, recorder._parameters_of["controller"]

    def until(is_done: Callable[[], bool]) -> None:
        assert spin_for(executor, is_done, 60.0)

    def one_process(kx: float, k: int, has_answered: Callable[[], bool]) -> None:
        """A controller that reports at step k, and ends after it has been asked."""
        controller = ControllerNode(parameter_overrides=[Parameter("kx", value=kx)], **options)
        executor.add_node(controller)
        until(lambda: all(output._publisher.get_subscription_count() for output in controller.outputs))
        controller.report_every_second(grid.stamp(k))
        controller.report(grid.stamp(k))
        until(has_answered)
        controller.close()
        until(lambda: not recorder._running)
        executor.remove_node(controller)
        controller.destroy_node()

    one_process(25.0, 499, lambda: client.values is not None and bool(recorder._running))
    one_process(50.0, 600, lambda: 1 in client.again)
    recorder.close()
    recorder.destroy_node()
    context.try_shutdown()
    said = read_bag(where, topics=()).metadata[NODES_NAME]
    assert parse_sections(said["params"], "said")["controller"]["kx"] == 25.0
    assert parse_sections(said["restart_1_params"], "said")["controller"]["kx"] == 50.0
    run = read_run(sample_with(tmp_path / "sample.mcap", [], dict(said)))
    assert run.scenario.controller.kx == 25.0
    assert [(c.k, c.node, c.name, c.old, c.new) for c in run.parameter_changes if c.name == "kx"] == [
        (500, "controller", "kx", 25.0, 50.0)
    ]
