"""Bags as other programs write them: every storage that rosbag2 knows, split, indexed or not."""

from __future__ import annotations

import io
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore

from agv_analysis.bags import BagError, read_bag, storage

STORE = get_typestore(Stores.ROS2_JAZZY)
REPOSITORY = Path(__file__).parents[3]
POSE, TEXT, TF = "geometry_msgs/msg/PoseWithCovarianceStamped", "std_msgs/msg/String", "tf2_msgs/msg/TFMessage"
COUNT = 300


def _type(name: str) -> Any:
    return STORE.types[name]


def _header(ns: int, frame: str) -> Any:
    return _type("std_msgs/msg/Header")(_type("builtin_interfaces/msg/Time")(ns // 10**9, ns % 10**9), frame)


def pose(i: int) -> Any:
    point, turn = _type("geometry_msgs/msg/Point"), _type("geometry_msgs/msg/Quaternion")
    inner = _type("geometry_msgs/msg/Pose")(point(0.1 * i, -0.2 * i, 1e-300), turn(0.0, 0.0, 0.6, 0.8))
    covariance = np.arange(36) * (0.5 + i)
    return _type(POSE)(_header(10**9 + i, "map"), _type("geometry_msgs/msg/PoseWithCovariance")(inner, covariance))


def transforms(i: int) -> Any:
    vector, turn = _type("geometry_msgs/msg/Vector3"), _type("geometry_msgs/msg/Quaternion")
    transform = _type("geometry_msgs/msg/Transform")(vector(float(i), 2.0, 3.0), turn(0.0, 0.0, 0.0, 1.0))
    stamped = _type("geometry_msgs/msg/TransformStamped")
    return _type(TF)([stamped(_header(i, "odom"), f"wheel_{j}", transform) for j in range(i % 3)])


TOPICS = {"/amcl_pose": POSE, "/chatter": TEXT, "/tf": TF}


def messages() -> list[tuple[str, int, Any]]:
    """(topic, time [ns], message), in the order of their times."""
    found: list[tuple[str, int, Any]] = []
    for i in range(COUNT):
        ns = 10**9 + 1000 * i
        found += [("/amcl_pose", ns, pose(i)), ("/chatter", ns + 1, _type(TEXT)("word " * (i % 5)))]
        found += [("/tf", ns + 2, transforms(i))]
    return found


def payload(message: Any) -> bytes:
    return bytes(STORE.serialize_cdr(message, message.__msgtype__))


def write_mcap(path: Path, part: list[tuple[str, int, Any]] | None = None, **options: Any) -> None:
    with path.open("wb") as file:
        writer = Writer(file, **{"chunk_size": 20_000, **options})
        writer.start(profile="ros2", library="test")
        channels = {}
        for topic, kind in TOPICS.items():
            text = STORE.generate_msgdef(kind, ros_version=2)[0].encode()
            qos = {"offered_qos_profiles": "- depth: 10"}
            channels[topic] = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", text), qos)
        for topic, ns, message in messages() if part is None else part:
            writer.add_message(channels[topic], ns, payload(message), ns - 10)
        writer.add_metadata("agv_ncs", {"version": "1.2", "seed": "3"})
        writer.finish()  # type: ignore[no-untyped-call]


def assert_whole(path: Path, same_publish_time: bool = False) -> None:
    """The bag holds exactly what `messages` gives."""
    bag = read_bag(path)
    assert bag.is_complete, bag.problems
    assert {topic: (about.type, about.count) for topic, about in bag.topics.items()} == {
        topic: (kind, COUNT) for topic, kind in TOPICS.items()
    }
    times = np.array([ns for topic, ns, _ in messages() if topic == "/amcl_pose"])
    poses, texts, trees = bag["/amcl_pose"], bag["/chatter"], bag["/tf"]
    np.testing.assert_array_equal(poses["log_time_ns"], times)
    np.testing.assert_array_equal(poses["publish_time_ns"], times if same_publish_time else times - 10)
    np.testing.assert_array_equal(poses["pose.pose.position.y"], [-0.2 * i for i in range(COUNT)])
    np.testing.assert_array_equal(poses["pose.covariance"], [np.arange(36) * (0.5 + i) for i in range(COUNT)])
    assert texts["data"].tolist() == [b"word " * (i % 5) for i in range(COUNT)]
    np.testing.assert_array_equal(trees["len(transforms)"], [i % 3 for i in range(COUNT)])
    np.testing.assert_array_equal(
        trees["transforms.transform.translation.x"],
        [[i if j < i % 3 else np.nan for j in range(2)] for i in range(COUNT)],
    )
    assert trees["transforms.child_frame_id"][5].tolist() == [b"wheel_0", b"wheel_1"]


VARIANTS: dict[str, dict[str, Any]] = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "none": {"compression": CompressionType.NONE},
    "one chunk": {"chunk_size": 10**7},
    "a chunk for each message": {"chunk_size": 1},
    "without CRCs": {"enable_crcs": False},
    "CRC of the data section": {"enable_data_crcs": True},
    "without indexes": {"index_types": IndexType.NONE},
    "without message indexes": {"index_types": IndexType.CHUNK},
    "without summary": {
        "index_types": IndexType.NONE, "repeat_channels": False, "repeat_schemas": False,
        "use_statistics": False, "use_summary_offsets": False,
    },
    "unchunked": {"use_chunking": False},
    "unchunked without summary": {
        "use_chunking": False, "index_types": IndexType.NONE, "repeat_channels": False, "repeat_schemas": False,
        "use_statistics": False, "use_summary_offsets": False,
    },
}  # fmt: skip


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_kind_of_mcap_file(tmp_path: Path, variant: str) -> None:
    write_mcap(tmp_path / "bag.mcap", **VARIANTS[variant])
    assert_whole(tmp_path / "bag.mcap")


@pytest.fixture
def as_large(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of any size are read as large ones are: by compiled code."""
    for limit in ("LARGE", "LARGE_ONCE_LOADED"):
        monkeypatch.setattr(storage, limit, 0)


@pytest.mark.usefixtures("as_large")
@pytest.mark.parametrize("variant", VARIANTS)
def test_large_files_are_read_as_small_ones(tmp_path: Path, variant: str) -> None:
    write_mcap(tmp_path / "bag.mcap", **VARIANTS[variant])
    assert_whole(tmp_path / "bag.mcap")


IMPOSSIBLE: dict[str, tuple[Callable[[int], dict[str, int]], str]] = {
    "backwards": (lambda i: {"log": -5 if i == 250 else 0}, "logged before the one that it follows: 1"),
    "backwards over a chunk": (lambda i: {"log": 10**6 if i < 299 else 0}, "logged before the one that it follows: 1"),
    "twice": (lambda i: {"log": -1 if i == 250 else 0, "of": 249 if i == 250 else i}, "there twice: 1"),
    "of one time": (lambda i: {"log": -1 if i == 250 else 0}, ""),
    "logged too late": (lambda i: {"log": 2**63 if i == 0 else 0}, "a log or publish time after the year 2262: 1"),
    "published too late": (lambda i: {"publish": 2**63 if i == 7 else 0}, "publish time after the year 2262: 1"),
    "fraction": (lambda i: {"fraction": 10**9 if i in (3, 200) else 0}, "header.stamp.nanosec of a second or more: 2"),
    "none": (lambda i: {}, ""),
}  # fmt: skip


@pytest.mark.parametrize("what", IMPOSSIBLE)
def test_times_that_cannot_be_are_found_in_large_files_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """In a large file they are looked at while the messages are copied, in a small one when all of them are there."""
    change, said = IMPOSSIBLE[what]
    with (tmp_path / "bag.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=5_000)
        writer.start(profile="ros2", library="test")
        text = STORE.generate_msgdef(POSE, ros_version=2)[0].encode()
        channel = writer.register_channel("/pose", "cdr", writer.register_schema(POSE, "ros2msg", text))
        for i in range(COUNT):
            new = {"log": 0, "publish": 0, "fraction": 0, "of": i, **change(i)}
            sent = pose(new["of"])
            sent.header.stamp.nanosec += new["fraction"]
            writer.add_message(channel, 1000 + i + new["log"], payload(sent), 990 + new["of"] + new["publish"])
        writer.finish()  # type: ignore[no-untyped-call]
    small = read_bag(tmp_path / "bag.mcap")
    for limit in ("LARGE", "LARGE_ONCE_LOADED"):
        monkeypatch.setattr(storage, limit, 0)
    assert read_bag(tmp_path / "bag.mcap").problems == small.problems
    assert said in " ".join(small.problems)
    assert bool(said) == bool(small.problems)


@pytest.mark.usefixtures("as_large")
def test_a_topic_of_a_large_file_that_cannot_be_decoded(tmp_path: Path) -> None:
    """One in twenty of its messages is so long that the array would be out of all proportion to the others."""
    text = _type(TEXT)
    parts = [("/chatter", 10**9 + i, text("x" * (1 if i % 20 else 10**5))) for i in range(2001)]
    write_mcap(tmp_path / "bag.mcap", [*parts, ("/amcl_pose", 2 * 10**9, pose(1))], **VARIANTS["without summary"])
    bag = read_bag(tmp_path / "bag.mcap")
    with pytest.raises(BagError, match="/chatter: cannot be decoded: its strings or sequences differ so much"):
        bag["/chatter"]
    assert len(bag["/amcl_pose"]) == 1
    assert bag.topics["/chatter"].count == 2001


@pytest.mark.usefixtures("as_large")
def test_a_few_messages_of_a_large_file_that_are_out_of_all_proportion(tmp_path: Path) -> None:
    text = _type(TEXT)
    parts = [("/chatter", 10**9 + i, text("x" * (1 if i % 1000 else 10**5))) for i in range(2001)]
    write_mcap(tmp_path / "bag.mcap", parts, **VARIANTS["without summary"])
    bag = read_bag(tmp_path / "bag.mcap")
    assert len(bag["/chatter"]) == 1998
    assert [problem for problem in bag.problems if "/chatter" in problem and problem.endswith(": 3")]


def test_what_is_not_checked_is_said(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    write_mcap(path, enable_data_crcs=True)
    assert read_bag(path).problems == ()
    write_mcap(path, enable_crcs=False, chunk_size=10**7)
    assert "not checked, because there is no CRC: metadata records: 1, chunks: 1" in read_bag(path).problems
    write_mcap(path, use_chunking=False)
    unchecked = f"not checked, because there is no CRC: metadata records: 1, messages outside of chunks: {3 * COUNT}"
    assert unchecked in read_bag(path).problems
    write_mcap(path, **VARIANTS["without summary"])
    assert "file without statistics, in which a missing message would go undetected: 1" in read_bag(path).problems


def test_metadata_and_qos(tmp_path: Path) -> None:
    write_mcap(tmp_path / "bag.mcap")
    bag = read_bag(tmp_path / "bag.mcap")
    assert bag.metadata == {"agv_ncs": {"version": "1.2", "seed": "3"}}
    assert bag.topics["/tf"].offered_qos == "- depth: 10"
    assert "geometry_msgs/TransformStamped[] transforms" in bag.topics["/tf"].schema


def test_only_the_topics_asked_for_are_decoded(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    write_mcap(path)
    bag = read_bag(path, topics=["/chatter", "/nowhere"])
    assert list(bag.arrays) == ["/chatter"]
    assert bag.topics["/tf"].count == COUNT
    with pytest.raises(BagError, match="/tf was not asked for"):
        bag["/tf"]
    with pytest.raises(BagError, match="no topic /nowhere; it has /amcl_pose, /chatter, /tf"):
        bag["/nowhere"]
    assert bag.payloads("/tf") == [payload(transforms(i)) for i in range(COUNT)]
    assert read_bag(path, topics=()).arrays == {}


def test_a_directory_without_metadata_is_read_by_numbers(tmp_path: Path) -> None:
    every = messages()
    for number in range(12):
        write_mcap(tmp_path / f"bag_{number}.mcap", every[75 * number : 75 * number + 75])
    assert_whole(tmp_path)
    assert any("without metadata.yaml" in problem for problem in read_bag(tmp_path).problems)


def _fill(writer: Rosbag2Writer) -> None:
    connections = {topic: writer.add_connection(topic, kind, typestore=STORE) for topic, kind in TOPICS.items()}
    for topic, ns, message in messages():
        writer.write(connections[topic], ns, payload(message))


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE])
def test_rosbag2_directories_by_rosbags(tmp_path: Path, storage: StoragePlugin, mode: CompressionMode) -> None:
    writer = Rosbag2Writer(tmp_path / "bag", version=9, storage_plugin=storage)
    if mode != CompressionMode.NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        _fill(writer)
    assert_whole(tmp_path / "bag", same_publish_time=True)


@pytest.mark.parametrize("kind", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_compressed_directories_without_metadata(tmp_path: Path, kind: StoragePlugin, mode: CompressionMode) -> None:
    writer = Rosbag2Writer(tmp_path / "bag", version=9, storage_plugin=kind)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        _fill(writer)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    assert_whole(tmp_path / "bag", same_publish_time=True)
    (file,) = (tmp_path / "bag").iterdir()
    assert_whole(file, same_publish_time=True)


def test_a_bare_sqlite3_file(tmp_path: Path) -> None:
    with Rosbag2Writer(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        _fill(writer)
    assert_whole(tmp_path / "bag" / "bag.db3", same_publish_time=True)


def test_metadata_that_names_a_file_which_is_missing(tmp_path: Path) -> None:
    with Rosbag2Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        _fill(writer)
    metadata = tmp_path / "bag" / "metadata.yaml"
    text = metadata.read_text().replace("- bag.mcap", "- bag.mcap\n  - bag_1.mcap")
    metadata.write_text(text)
    bag = read_bag(tmp_path / "bag")
    assert len(bag["/tf"]) == COUNT
    assert not bag.is_complete
    assert "bag_1.mcap named by metadata.yaml but missing: 1" in bag.problems


def test_metadata_that_counts_more_messages(tmp_path: Path) -> None:
    with Rosbag2Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        _fill(writer)
    metadata = tmp_path / "bag" / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace(f"message_count: {COUNT}", f"message_count: {COUNT + 5}"))
    bag = read_bag(tmp_path / "bag")
    assert not bag.is_complete
    assert "/tf: message that metadata.yaml counts and that is not there: 5" in bag.problems


@pytest.mark.parametrize("text", ["", "]", "a: 1", "rosbag2_bagfile_information: 3", "&a [*a]"])
def test_metadata_that_is_none_is_not_used(tmp_path: Path, text: str) -> None:
    write_mcap(tmp_path / "bag.mcap")
    (tmp_path / "metadata.yaml").write_text(text)
    assert_whole(tmp_path)
    assert any("not understood" in problem for problem in read_bag(tmp_path).problems)


def test_one_bad_file_of_several_is_reported(tmp_path: Path) -> None:
    write_mcap(tmp_path / "bag_0.mcap")
    (tmp_path / "bag_1.mcap").write_bytes(b"nothing of the kind")
    bag = read_bag(tmp_path)
    assert len(bag["/tf"]) == COUNT
    assert not bag.is_complete


def test_what_is_no_bag(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="there is no such file or directory"):
        read_bag(tmp_path / "nowhere")
    with pytest.raises(BagError, match=r"no \.mcap or \.db3 file in this directory"):
        read_bag(tmp_path)
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(BagError, match=r"empty\.mcap: is empty"):
        read_bag(tmp_path / "empty.mcap")
    (tmp_path / "bad.db3").write_bytes(b"SQLite format 3\0" + bytes(200))
    with pytest.raises(BagError, match="sqlite3 cannot open it: file is not a database"):
        read_bag(tmp_path / "bad.db3")


def test_a_file_that_is_refused_is_closed(tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"nothing of the kind")
    with pytest.raises(BagError) as refusal:  # which holds on to all that was there when it was raised
        read_bag(tmp_path / "bad.mcap")
    still_open = [str(link.readlink()) for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
    assert str(tmp_path / "bad.mcap") not in still_open
    assert "is not an MCAP file" in str(refusal.value)


def test_a_topic_recorded_with_two_types_is_refused(tmp_path: Path) -> None:
    file = io.BytesIO()
    writer = Writer(file)
    writer.start()
    for kind in ("std_msgs/msg/String", "std_msgs/msg/Bool"):
        text = STORE.generate_msgdef(kind, ros_version=2)[0].encode()
        channel = writer.register_channel("/topic", "cdr", writer.register_schema(kind, "ros2msg", text))
        writer.add_message(channel, 1, payload(_type("std_msgs/msg/Bool")(True)), 1)
    writer.finish()  # type: ignore[no-untyped-call]
    (tmp_path / "bag.mcap").write_bytes(file.getvalue())
    bag = read_bag(tmp_path / "bag.mcap")
    with pytest.raises(BagError, match="messages of two types"):
        bag["/topic"]
    assert len(bag.payloads("/topic")) == 2


def test_the_sample_bag_as_mcap_ros2_support_reads_it() -> None:
    directory = REPOSITORY / "bags" / "sample"
    bag = read_bag(directory)
    assert bag.is_complete
    with next(directory.glob("*.mcap")).open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = list(reader.iter_decoded_messages(topics=["/edge/error", "/edge/slot"], log_time_order=False))
    errors = [message for _, channel, _, message in decoded if channel.topic == "/edge/error"]
    assert bag["/edge/error"]["pose.pose.position.x"].tolist() == [m.pose.pose.position.x for m in errors]
    assert bag["/edge/error"]["twist.twist.angular.z"].tolist() == [m.twist.twist.angular.z for m in errors]
    slots = [message for _, channel, _, message in decoded if channel.topic == "/edge/slot"]
    assert bag["/edge/slot"]["source"].tolist() == [m.source.encode() for m in slots]
    assert bag["/edge/slot"]["time_ref.nanosec"].tolist() == [m.time_ref.nanosec for m in slots]


def test_progress_ends_at_a_hundred(tmp_path: Path) -> None:
    write_mcap(tmp_path / "bag.mcap")
    shares: list[int] = []
    read_bag(tmp_path / "bag.mcap", progress=shares.append)
    assert shares == sorted(shares)
    assert shares[-1] <= 100


WITHOUT_ISAL = """
import sys
sys.modules["isal"] = None
from agv_analysis.bags import read_bag
bag = read_bag(sys.argv[1])
print(bag.problems, sum(len(rows) for rows in bag.arrays.values()))
"""


@pytest.mark.parametrize("damage", [0, 1])
def test_without_isal_checksums_are_compared_all_the_same(tmp_path: Path, damage: int) -> None:
    path = tmp_path / "bag.mcap"
    write_mcap(path, enable_data_crcs=True)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= damage
    path.write_bytes(data)
    bag = read_bag(path)
    expected = f"{bag.problems} {sum(len(rows) for rows in bag.arrays.values())}\n"
    assert bag.is_complete == (not damage)
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_ISAL, str(path)], capture_output=True, text=True, check=True, cwd=REPOSITORY
    )
    assert done.stdout == expected
