"""`agv-ncs bag`: what it writes is read back by other programs."""

from __future__ import annotations

import csv
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader

from agv_analysis.bags import read_bag
from agv_analysis.cli import main

REPOSITORY = Path(__file__).parents[3]
SAMPLE = REPOSITORY / "bags" / "sample"


def agv_ncs(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments], catch_exceptions=False)


def _payloads(path: Path) -> list[tuple[str, int, bytes]]:
    """(topic, log time, payload) of a rosbag2 directory, by rosbags."""
    with Reader(path) as reader:
        return [(connection.topic, time, data) for connection, time, data in reader.messages()]


@pytest.fixture
def cut(tmp_path: Path) -> Path:
    """The sample, three quarters of it, without metadata.yaml: what a power cut leaves."""
    directory = tmp_path / "cut"
    directory.mkdir()
    whole = next(SAMPLE.glob("*.mcap")).read_bytes()
    (directory / "cut_0.mcap").write_bytes(whole[: len(whole) * 3 // 4])
    return directory


def test_info_counts_as_metadata_does(tmp_path: Path) -> None:
    result = agv_ncs("bag", "info", SAMPLE, "--json", tmp_path / "info.json")
    assert result.exit_code == 0
    assert "nothing is known to be missing" in result.stdout
    summary = json.loads((tmp_path / "info.json").read_text())
    with Reader(SAMPLE) as reader:
        assert {topic["name"]: topic["messages"] for topic in summary["topics"]} == {
            topic: about.msgcount for topic, about in reader.topics.items()
        }
    pose = next(topic for topic in summary["topics"] if topic["name"] == "/agv/pose")
    assert pose["rate"] == pytest.approx(200.0)
    assert pose["longest_gap"] == pytest.approx(0.005)


def test_info_names_what_is_wrong(cut: Path) -> None:
    result = agv_ncs("bag", "info", cut)
    assert result.exit_code == 0
    assert "problem: file without an end: the recording was interrupted, or the file was cut: 1" in result.stdout
    assert result.stdout.endswith("the recording is not complete\n")


def test_info_counts_values_that_are_not_finite(tmp_path: Path) -> None:
    def record(opcode: int, content: bytes) -> bytes:
        return struct.pack("<BQ", opcode, len(content)) + content

    def text(content: str) -> bytes:
        return struct.pack("<I", len(content)) + content.encode()

    parts = [
        record(1, text("") + text("")),
        record(3, struct.pack("<H", 1) + text("a/msg/A") + text("ros2msg") + text("float64 x\nfloat64[] many")),
        record(4, struct.pack("<HH", 1, 1) + text("/a") + text("cdr") + struct.pack("<I", 0)),
    ]
    for x, many in ((1.0, [1.0, 2.0]), (float("nan"), []), (float("inf"), [3.0])):
        body = struct.pack(f"<Id I4x{len(many)}d" if many else "<Id I", 0x00000100, x, len(many), *many)
        parts.append(record(5, struct.pack("<HIQQ", 1, 0, 1, 1) + body))
    magic = b"\x89MCAP0\r\n"
    (tmp_path / "a.mcap").write_bytes(magic + b"".join(parts) + record(15, bytes(4)) + record(2, bytes(20)) + magic)
    assert "/a: x not finite: 2" in agv_ncs("bag", "info", tmp_path / "a.mcap").stdout


def test_a_path_without_a_bag_is_one_line(tmp_path: Path) -> None:
    result = agv_ncs("bag", "info", tmp_path)
    assert result.exit_code == 1
    assert result.stderr == f"Error: {tmp_path}: no bag: there is no .mcap or .db3 file in this directory\n"


def test_csv_is_exact(tmp_path: Path) -> None:
    result = agv_ncs("bag", "export", SAMPLE, "--csv", "--out", tmp_path / "out")
    assert result.exit_code == 0
    bag = read_bag(SAMPLE)
    with (tmp_path / "out" / "edge.error.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for column in ("pose.pose.position.x", "pose.pose.orientation.w", "log_time_ns"):
        assert [float(row[column]) for row in rows] == bag["/edge/error"][column].tolist()
    assert {row["child_frame_id"] for row in rows} == {"reference"}
    assert "pose.covariance[35]" in rows[0]
    with (tmp_path / "out" / "edge.slot.csv").open(newline="") as file:
        assert [row["source"] for row in csv.DictReader(file)] == bag["/edge/slot"]["source"].astype(str).tolist()


def test_npz_is_exact(tmp_path: Path) -> None:
    assert agv_ncs("bag", "export", SAMPLE, "--npz", "--out", tmp_path / "out.npz").exit_code == 0
    bag = read_bag(SAMPLE)
    with np.load(tmp_path / "out.npz") as arrays:
        assert sorted(arrays) == sorted(topic.lstrip("/") for topic in bag.topics)
        for topic, rows in bag.arrays.items():
            for column in rows.dtype.names or ():
                np.testing.assert_array_equal(arrays[topic.lstrip("/")][column], rows[column])


def test_parquet_is_exact(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    out = tmp_path / "out"
    assert agv_ncs("bag", "export", SAMPLE, "--parquet", "--topic", "/edge/slot", "--out", out).exit_code == 0
    assert [path.name for path in out.iterdir()] == ["edge.slot.parquet"]
    table, rows = parquet.read_table(out / "edge.slot.parquet"), read_bag(SAMPLE)["/edge/slot"]
    assert table["source"].to_pylist() == rows["source"].astype(str).tolist()
    assert table["time_ref.nanosec"].to_pylist() == rows["time_ref.nanosec"].tolist()


def test_parquet_says_what_its_columns_mean(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    agv_ncs("bag", "export", SAMPLE, "--parquet", "--topic", "/edge/error", "--out", tmp_path / "out")
    schema = parquet.read_schema(tmp_path / "out" / "edge.error.parquet")
    about = {name: schema.field(name).metadata for name in schema.names}
    assert about["log_time_ns"][b"unit"] == b"ns"
    assert about["header.stamp.sec"][b"unit"] == b"s"
    assert about["pose.pose.position.x"][b"unit"] == b"m"
    assert about["pose.pose.orientation.w"][b"unit"] == b"1"
    assert about["twist.twist.linear.x"][b"unit"] == b"m/s"
    assert about["twist.twist.angular.z"][b"unit"] == b"rad/s"
    assert b"6x6 covariance matrix" in about["pose.covariance[35]"][b"meaning"]
    assert schema.metadata[b"topic"] == b"/edge/error"
    assert schema.metadata[b"type"] == b"nav_msgs/msg/Odometry"


def test_tum_trajectories_are_exact(tmp_path: Path) -> None:
    result = agv_ncs("bag", "export", SAMPLE, "--tum", "--out", tmp_path / "out")
    assert result.exit_code == 0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"agv.pose.tum", "edge.pose.tum", "edge.error.tum"}
    lines = (tmp_path / "out" / "agv.pose.tum").read_text().splitlines()
    with (next(SAMPLE.glob("*.mcap"))).open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        poses = [message for _, _, _, message in reader.iter_decoded_messages(topics=["/agv/pose"])]
    assert len(lines) == len(poses)
    for line, message in zip(lines, poses, strict=True):
        p, q, stamp = message.pose.position, message.pose.orientation, message.header.stamp
        time, *values = line.split()
        assert time == f"{stamp.sec}.{stamp.nanosec:09d}"
        assert [float(value) for value in values] == [p.x, p.y, p.z, q.x, q.y, q.z, q.w]


def test_a_bag_without_poses_has_no_trajectory(tmp_path: Path) -> None:
    result = agv_ncs("bag", "export", SAMPLE, "--tum", "--topic", "/clock", "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert "no topic with poses: /clock" in result.stderr


def test_export_refuses_what_it_cannot_do(tmp_path: Path) -> None:
    assert "choose a format: --csv, --parquet, --npz, --tum" in agv_ncs("bag", "export", SAMPLE).stderr
    missing = agv_ncs("bag", "export", SAMPLE, "--csv", "--topic", "/nowhere", "--out", tmp_path / "out")
    assert missing.exit_code == 1
    assert "no topic /nowhere; it has /agv/cmd_vel" in missing.stderr
    (tmp_path / "there.npz").touch()
    there = agv_ncs("bag", "export", SAMPLE, "--npz", "--out", tmp_path / "there.npz")
    assert there.exit_code == 1
    assert "exists already" in there.stderr


@pytest.mark.parametrize("form", ["stamped", "unknown type", "no stamps"])
def test_outages_of_a_topic_are_those_that_were_left_out(tmp_path: Path, form: str) -> None:
    """Every message of which the losses are known, logged up to 2 ms late, of any type."""
    lost = [k for k in range(1000) if 100 <= k < 103 or k % 97 == 5 or 700 <= k < 720]
    late = np.random.default_rng(4).integers(0, 2_000_000, 1000)
    text = {"stamped": b"std_msgs/Header header\n" + b"=" * 80 + b"\nMSG: std_msgs/Header\n"
            b"builtin_interfaces/Time stamp\nstring frame_id", "no stamps": b"int32 a\nuint32 b\nuint64 c"}  # fmt: skip
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("my_msgs/msg/Scan", "ros2msg", text.get(form, b""))
        channel = writer.register_channel("/scan", "cdr", schema)
        for k in range(1000):
            if k not in lost:
                ns = 10**9 + 10**7 * k
                body = b"\0\1\0\0" + struct.pack("<iII", ns // 10**9, ns % 10**9, 1) + bytes(4)
                writer.add_message(channel, ns + int(late[k]), body, ns)
        writer.finish()  # type: ignore[no-untyped-call]
    out = tmp_path / "out.json"
    result = agv_ncs("bag", "outages", tmp_path / "a.mcap", "--topic", "scan", "--json", out)
    assert result.exit_code == 0
    uplink = json.loads(out.read_text())["uplink"]
    begins = sum(k - 1 not in lost for k in lost)
    assert (uplink["packets"], uplink["lost"], uplink["outages"]) == (1000, len(lost), begins)
    assert uplink["outage_max_s"] == pytest.approx(0.2, rel=0.05)
    ages = [k - max((j for j in range(k + 1) if j not in lost), default=0) for k in range(1000)]
    assert uplink["age"]["max_s"] == pytest.approx(0.01 * max(ages), rel=0.05)
    assert uplink["age"]["mean_s"] == pytest.approx(0.01 * np.mean(ages), rel=0.05)
    assert (uplink["delay"] is None) == (form != "stamped")
    if form == "stamped":
        assert uplink["delay"]["max_s"] == pytest.approx(late.max() * 1e-9, abs=1e-5)


def test_outages_with_a_period_that_the_messages_do_not_show(tmp_path: Path) -> None:
    """Only every third one came: their own distance is three periods."""
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/scan", "cdr", 0)
        for k in range(0, 300, 3):
            writer.add_message(channel, 10**9 + 10**7 * k, b"\0\1\0\0", 0)
        writer.finish()  # type: ignore[no-untyped-call]
    out = tmp_path / "out.json"
    arguments = ("bag", "outages", tmp_path / "a.mcap", "--topic", "/scan", "--json", out)
    assert agv_ncs(*arguments).exit_code == 0
    assert json.loads(out.read_text())["uplink"]["lost"] == 0
    assert agv_ncs(*arguments, "--period", "0.01").exit_code == 0
    uplink = json.loads(out.read_text())["uplink"]
    assert (uplink["packets"], uplink["lost"], uplink["outages"]) == (298, 198, 99)


def test_outages_of_a_topic_that_is_not_there(tmp_path: Path) -> None:
    result = agv_ncs("bag", "outages", SAMPLE, "--topic", "/nowhere")
    assert result.exit_code == 1
    assert "no topic /nowhere; it has /agv/cmd_vel" in result.stderr


def test_recovery_of_a_whole_bag_is_that_bag(tmp_path: Path) -> None:
    result = agv_ncs("bag", "recover", SAMPLE, tmp_path / "copy")
    assert result.exit_code == 0
    assert result.stderr == ""
    assert _payloads(tmp_path / "copy") == _payloads(SAMPLE)
    assert read_bag(tmp_path / "copy").metadata["agv_ncs"] == read_bag(SAMPLE).metadata["agv_ncs"]
    assert read_bag(tmp_path / "copy").problems == ()


def test_recovery_of_a_cut_bag_is_clean(cut: Path, tmp_path: Path) -> None:
    result = agv_ncs("bag", "recover", cut, tmp_path / "clean")
    assert result.exit_code == 0
    assert "the recording is not complete" in result.stderr
    recovered = _payloads(tmp_path / "clean")
    assert 0.5 * len(_payloads(SAMPLE)) < len(recovered) < len(_payloads(SAMPLE))
    assert set(recovered) < set(_payloads(SAMPLE))
    with (tmp_path / "clean" / "clean_0.mcap").open("rb") as file:
        assert sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages()) == len(recovered)


def test_recovery_to_a_file(cut: Path, tmp_path: Path) -> None:
    assert agv_ncs("bag", "recover", cut, tmp_path / "clean.mcap").exit_code == 0
    assert read_bag(tmp_path / "clean.mcap").is_complete


def test_recovery_overwrites_nothing(tmp_path: Path) -> None:
    result = agv_ncs("bag", "recover", SAMPLE, tmp_path)
    assert result.exit_code == 1
    assert "exists already" in result.stderr


def test_a_failed_recovery_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"no bag")
    result = agv_ncs("bag", "recover", tmp_path / "bad.mcap", tmp_path / "out")
    assert result.exit_code == 1
    assert [path.name for path in tmp_path.iterdir()] == ["bad.mcap"]
