"""Recordings: what other libraries read in them, what a damaged run leaves, what cannot be recorded to."""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.reader import read_ros2_messages
from rosbags.interfaces import ConnectionExtRosbag2
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

rclpy = pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter

from agv_analysis.bags.bag import read_bag
from agv_analysis.bags.message_definitions import schema_of
from agv_analysis.bags.rosbag2_metadata import TopicInfo
from agv_analysis.bags.writer import BagWriter
from agv_analysis.recordings.recording import read_run
from agv_analysis.runtime.recorder_node import RecorderNode
from agv_analysis.scenario import load_scenario, parse_scenario
from agv_plant.plant_node import PlantNode
from agv_ros.endpoints import LOOP_QOS
from agv_ros.errors import UserError
from agv_ros.executor import EXECUTORS, spin_for

if TYPE_CHECKING:
    from test.agv_analysis.runtime.conftest import UntilSteps
    from test.conftest import Drive, Start

REPOSITORY = Path(__file__).parents[3]
AgvNcs = Callable[..., tuple[int, str]]


@pytest.fixture
def bag(drive: Drive, tmp_path: Path) -> Path:
    drive("plant.duration=1.0", config="outages")
    return tmp_path / "bag"


def test_rosbags_reads_what_was_recorded(bag: Path) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(bag) as reader:
        assert reader.message_count == sum(connection.msgcount for connection in reader.connections)
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        assert counts["/agv/pose"] == counts["/clock"] == counts["/edge/slot"] == counts["/agv/slot"] == 200
        assert (reader.start_time, reader.end_time) == (1_000_000_000, 1_000_000_000 + 199 * 5_000_000 + 1)
        for connection in reader.connections:
            assert connection.digest == store.hash_rihs01(connection.msgtype)
            assert isinstance(connection.ext, ConnectionExtRosbag2)
            assert connection.ext.offered_qos_profiles[0].reliability.name == "RELIABLE"
        first = next(message for c, _, message in reader.messages() if c.topic == "/agv/pose")
    pose: Any = store.deserialize_cdr(first, "geometry_msgs/msg/PoseStamped")
    assert (pose.header.frame_id, pose.pose.position.y) == ("map", 5.0)


def test_mcap_ros2_support_decodes_it_by_the_schemas_in_it(bag: Path) -> None:
    file = str(next(bag.glob("*.mcap")))
    frames = {m.channel.topic: m.ros_msg for m in read_ros2_messages(file, topics=["/edge/error", "/edge/cmd_vel"])}
    assert frames["/edge/error"].header.frame_id == "base_link"
    assert frames["/edge/error"].child_frame_id == "reference"
    assert frames["/edge/cmd_vel"].header.frame_id == "base_link"


def test_chunks_are_compressed_and_have_crcs_and_the_run_is_embedded(bag: Path) -> None:
    with next(bag.glob("*.mcap")).open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        assert {index.compression for index in summary.chunk_indexes} == {"zstd"}
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        embedded = {record.name: record.metadata for record in reader.iter_metadata()}
    assert embedded["agv_ncs"]["seed"] == "1"
    assert embedded["agv_ncs"]["version"]
    asked = load_scenario(str(REPOSITORY / "config/outages.yaml"), ["plant.duration=1.0"])
    assert parse_scenario(embedded["agv_ncs"]["params"], "bag") == asked
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert metadata["relative_file_paths"] == [next(bag.glob("*.mcap")).name]
    assert yaml.safe_load(embedded["rosbag2"]["serialized_metadata"]) == metadata


def test_schemas_hold_what_rosbags_knows_of_the_types() -> None:
    """The .msg files against another library's knowledge of the same types: field by field, comments aside."""

    def essence(text: str) -> list[list[str]]:
        lines = (line.split("#")[0].split() for line in text.splitlines())
        return [["".join(words[:1]).replace("std_msgs/", ""), *words[1:2]] for words in lines if words]

    store = get_typestore(Stores.ROS2_JAZZY)
    for name in ("geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/TimeReference"):
        theirs, _ = store.generate_msgdef(name, ros_version=2)
        ours, parts = schema_of(name), theirs.split("=" * 80 + "\n")
        assert len(ours.split("=" * 80 + "\n")) == len(parts)
        assert essence(ours.split("=" * 80)[0]) == [
            [kind.rsplit("/", 1)[-1] if kind.startswith(name.split("/")[0]) else kind, field]
            for kind, field in essence(parts[0])
        ]


@pytest.mark.parametrize("clock", [(), ("--clock", "realtime", "--set", "plant.ts=0.0005")])
def test_an_interrupted_run_leaves_a_readable_bag(
    start: Start, until_steps: UntilSteps, tmp_path: Path, clock: tuple[str, ...]
) -> None:
    """In real time with a period that no machine keeps up with, messages are under way whenever it is interrupted."""
    where = tmp_path / "bag"
    run = start("agv_analysis.cli", "run", "config/outages.yaml", "--bag", str(where), *clock)
    until_steps(300, "/clock")
    run.process.send_signal(signal.SIGINT)
    status, said = run.end()
    assert status == 1
    assert "interrupted at step" in said
    assert "everything that was published" in said
    recorded = read_run(where)
    assert 100 < len(recorded) < 200_000
    assert not recorded.unexplained
    said_last, counts = _published_and_recorded(where)
    assert said_last == {topic: counts[topic] for topic in said_last}
    assert counts["/edge/slot"] == counts["/agv/pose"]


def _published_and_recorded(bag: Path) -> tuple[dict[str, int], dict[str, int]]:
    """How many messages of each topic its node says last that it has published, and how many are recorded."""
    file = str(next(bag.glob("*.mcap")))
    published: dict[str, int] = {}
    for message in read_ros2_messages(file, topics=["/diagnostics"]):
        for status in message.ros_msg.status:
            facts = ((value.key, value.value) for value in status.values)
            of_topic = ((key.split()[-1], value) for key, value in facts if key.startswith("published "))
            published |= {topic: int(count) for topic, count in of_topic}
    published.pop("/diagnostics")  # which all nodes publish
    return published, {topic: len(messages) for topic, messages in read_bag(bag).arrays.items()}


@pytest.mark.parametrize("clock", [(), ("--clock", "realtime", "--set", "plant.ts=0.001")])
def test_a_run_in_processes_is_interrupted_as_cleanly(
    start: Start, until_steps: UntilSteps, tmp_path: Path, clock: tuple[str, ...]
) -> None:
    where = tmp_path / "bag"
    run = start("agv_analysis.cli", "run", "config/outages.yaml", "--processes", "--bag", str(where), *clock)
    until_steps(300, "/clock")
    run.process.send_signal(signal.SIGTERM)
    status, said = run.end()
    assert status == 1
    assert "interrupted after step" in said
    assert not read_run(where).unexplained


def test_an_interrupted_run_answers_all_that_a_node_has_missed_while_it_was_halted(
    start: Start, until_steps: UntilSteps, tmp_path: Path
) -> None:
    """Of more than a thousand steps the error detector first gets all slots, then all poses, or the other way round."""
    where, clock = tmp_path / "bag", ("--clock", "realtime")
    run = start("agv_analysis.cli", "run", "config/outages.yaml", "--processes", "--bag", str(where), *clock)
    until_steps(20, "/clock")
    detector = next(child for child in run.children() if "error_detector_node" in (child / "cmdline").read_text())
    os.kill(int(detector.name), signal.SIGSTOP)
    until_steps(1100, "/clock")
    os.kill(int(detector.name), signal.SIGCONT)
    run.process.send_signal(signal.SIGTERM)
    _, said = run.end()
    assert "everything that was published" in said
    recorded = read_run(where)
    assert len(recorded) > 1100
    assert not recorded.unexplained


def test_an_interrupted_run_waits_for_a_recorder_that_lags(
    start: Start, until_steps: UntilSteps, tmp_path: Path
) -> None:
    """The recorder's process sleeps for some hundred steps, as on a busy machine: all of them are in the bag."""
    where = tmp_path / "bag"
    run = start("agv_analysis.cli", "run", "config/outages.yaml", "--processes", "--bag", str(where))
    until_steps(20, "/clock")
    recorder = next(child for child in run.children() if "recorder_node" in (child / "cmdline").read_text())
    os.kill(int(recorder.name), signal.SIGSTOP)
    until_steps(300, "/clock")
    run.process.send_signal(signal.SIGTERM)
    os.kill(int(recorder.name), signal.SIGCONT)
    _, said = run.end()
    assert "everything that was published" in said
    assert len(read_run(where)) > 300
    assert not read_run(where).unexplained


def test_the_recorder_says_what_it_has_missed(tmp_path: Path) -> None:
    """A pose that was published before the recorder listened: the plant's own count gives it away."""
    context = rclpy.Context()
    rclpy.init(context=context)
    where, options = str(tmp_path / "bag"), {"context": context, "use_global_arguments": False}
    executor = EXECUTORS["single"](context=context)
    plant = PlantNode(**options)
    executor.add_node(plant)
    listener = rclpy.create_node("listener", **options)
    listener.create_subscription(PoseStamped, "agv/pose", lambda _: None, LOOP_QOS)
    assert spin_for(executor, lambda: plant.outputs[1].count > 0, 60.0)
    recorder = RecorderNode(parameter_overrides=[Parameter("bag", value=where)], **options)
    executor.add_node(recorder)
    assert spin_for(executor, lambda: all(output.is_heard(2) for output in plant.outputs), 60.0)
    plant.close()
    assert spin_for(executor, lambda: bool(recorder.missing()), 60.0)
    recorder.close()
    for node in (plant, recorder, listener):
        node.destroy_node()
    context.try_shutdown()
    assert recorder.failure.startswith(f"{where}: the recording is not complete, missing: ")
    assert "of /agv/pose" in recorder.failure
    assert "it began after the loop did; start the recorder first" in recorder.failure


def test_a_recorder_minds_the_nodes_of_its_own_loop_alone(tmp_path: Path) -> None:
    """Others report on the same /diagnostics; without a single pose of the own plant nothing is complete."""
    context = rclpy.Context()
    rclpy.init(context=context)
    options: dict[str, Any] = {"context": context, "use_global_arguments": False, "namespace": "agv_01"}
    executor = EXECUTORS["single"](context=context)
    recorder = RecorderNode(parameter_overrides=[Parameter("bag", value=str(tmp_path / "bag"))], **options)
    executor.add_node(recorder)
    others = [rclpy.create_node("plant", **(options | {"namespace": name})) for name in ("agv_01", "agv_02")]
    reports = others[1].create_publisher(DiagnosticArray, "/diagnostics", LOOP_QOS)
    others[0].create_publisher(PoseStamped, "agv/pose", LOOP_QOS)
    errors = others[0].create_publisher(Odometry, "edge/error", LOOP_QOS)
    assert spin_for(executor, lambda: reports.get_subscription_count() and errors.get_subscription_count(), 60.0)
    for name in ("agv_02/plant", "agv_01/plant"):
        fact = KeyValue(key="published /agv_01/edge/error", value="1")
        reports.publish(DiagnosticArray(status=[DiagnosticStatus(name=name, values=[fact])]))
    errors.publish(Odometry())
    assert spin_for(executor, lambda: "agv_01/plant" in recorder._published and not recorder.missing(), 60.0)
    assert spin_for(executor, lambda: bool(recorder._parameters_of["plant"].name), 60.0)
    assert recorder._published.keys() == {"agv_01/plant"}
    recorder.close()
    for node in (*others, recorder):
        node.destroy_node()
    context.try_shutdown()
    assert recorder.failure.startswith(
        f"{tmp_path / 'bag'}: the recording is not complete, there is not one message of"
    )
    assert "/agv_01/agv/pose" in recorder.failure


def test_an_unwritable_directory_is_named(agv_ncs: AgvNcs) -> None:
    status, said = agv_ncs("run", "config/paper.yaml", "--bag", "/proc/bag")  # where not even root may write
    assert status == 1
    assert "/proc/bag: cannot be recorded to: No such file or directory" in said


def test_a_path_below_a_file_cannot_be_recorded_to(agv_ncs: AgvNcs, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    status, said = agv_ncs("run", "config/paper.yaml", "--bag", tmp_path / "file" / "bag")
    assert (status, said.splitlines()[-1]) == (
        1,
        f"Error: {tmp_path}/file/bag: cannot be recorded to: Not a directory",
    )


@pytest.mark.parametrize("options", [[], ["--processes"]])
def test_a_bag_that_exists_is_not_touched(agv_ncs: AgvNcs, tmp_path: Path, options: list[str]) -> None:
    status, said = agv_ncs("run", "config/paper.yaml", "--bag", tmp_path, *options)
    assert status == 1
    assert f"{tmp_path}: exists already; name a new directory or remove it first" in said.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_a_type_that_is_not_installed_is_named() -> None:
    with pytest.raises(UserError, match="no_such_msgs/Thing"):
        schema_of("no_such_msgs/msg/Thing")


POSE = TopicInfo("/topic", "geometry_msgs/msg/PoseStamped", schema_of("geometry_msgs/msg/PoseStamped"), "", [])


@pytest.fixture
def writer(tmp_path: Path, request: pytest.FixtureRequest) -> BagWriter:
    return BagWriter(tmp_path / "bag", [lambda: POSE], {}, by_stamp=getattr(request, "param", True))


def random_bytes(count: int) -> Iterator[tuple[int, bytes]]:
    """Stamps [ns], and payloads that cannot be compressed."""
    generator = random.Random(1)
    for ns in range(1, count + 1):
        yield ns, generator.randbytes(120)


def write_all(writer: BagWriter, messages: Iterable[tuple[int, bytes]]) -> None:
    for ns, data in messages:
        writer.write(0, data, ns, ns)


def test_a_message_that_comes_late_is_put_in_its_place(tmp_path: Path, writer: BagWriter) -> None:
    """DDS may take seconds to bring one again; a loop in lockstep has gone on for thousands of steps by then."""
    sent = [*range(9_000), 3_000, *range(9_000, 12_000)]
    for ns in sent:
        writer.write(0, b"\0", ns, ns)
    writer.close()
    again = BagWriter(tmp_path / "again/bag", [lambda: POSE], {}, by_stamp=True)
    for ns in sorted(sent):
        again.write(0, b"\0", ns, ns)
    again.close()
    with next((tmp_path / "bag").glob("*.mcap")).open("rb") as file:
        times = [message.log_time for _, _, message in make_reader(file).iter_messages(log_time_order=False)]
    assert [pair for pair in zip(times, sorted(sent), strict=True) if pair[0] != pair[1]] == []
    assert (tmp_path / "bag/bag_0.mcap").read_bytes() == (tmp_path / "again/bag/bag_0.mcap").read_bytes()
    assert sorted(file.name for file in (tmp_path / "bag").iterdir()) == ["bag_0.mcap", "metadata.yaml"]


def test_a_copy_made_at_any_moment_lacks_few_messages(tmp_path: Path, writer: BagWriter) -> None:
    """As after a kill, or a loss of power: at most 4096 messages of a loop in lockstep, and a chunk of 256 KiB."""
    (tmp_path / "copy").mkdir()
    for ns, data in random_bytes(20_000):
        writer.write(0, data, ns, ns)
        if ns % 3333 == 0:
            shutil.copy(tmp_path / "bag/bag_0.mcap", tmp_path / "copy")
            found = read_bag(tmp_path / "copy", topics=()).topics
            count = found["/topic"].count if found else 0
            assert ns - count <= 4096 + 2**18 / 150
    writer.close()


@pytest.mark.parametrize("writer", [True, False], indirect=True)
def test_in_real_time_a_copy_has_what_was_there_at_the_last_write_but_one(tmp_path: Path, writer: BagWriter) -> None:
    (tmp_path / "copy").mkdir()
    for ns, data in random_bytes(1000):
        writer.write(0, data, ns, ns)
        if ns % 100 == 0:
            writer.write_older()
            shutil.copy(tmp_path / "bag/bag_0.mcap", tmp_path / "copy")
            found = read_bag(tmp_path / "copy", topics=()).topics
            assert (found["/topic"].count if found else 0) >= ns - 100
    writer.close()


def test_what_was_written_before_the_disk_was_full_can_be_read(tmp_path: Path, writer: BagWriter) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, limits[1]))
    try:
        with pytest.raises(OSError, match="too large"):
            write_all(writer, random_bytes(100_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    writer.abandon()
    found = read_bag(tmp_path / "bag", topics=())
    assert found.topics["/topic"].count > 3000
    assert [problem for problem in found.problems if "damaged" in problem] == []


@pytest.mark.parametrize(("choice", "steps"), [("end", False), ("continue", True)])
def test_a_bag_that_is_removed_is_said_and_the_loop_does_as_it_was_told(
    start: Start, tmp_path: Path, choice: str, steps: bool
) -> None:
    where = tmp_path / "bag"
    command = ("run", "config/outages.yaml", "--bag", str(where), "--if-unwritable", choice, "--clock", "realtime")
    run = start("agv_analysis.cli", *command, "--duration", "3.0")
    run.until(lambda: any(file.stat().st_size > 5000 for file in where.glob("*.mcap")))
    shutil.rmtree(where)
    status, said = run.end()
    assert status == 1
    assert f"{where}: cannot be written any more: the file was removed" in " ".join(said.split())
    assert ("600 steps" in said) == steps
    assert "Traceback" not in said
