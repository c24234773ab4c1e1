"""Columns with units and meaning, and trajectories of transforms."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from agv_analysis.bags import read_bag
from agv_analysis.bags.column_notes import Note, column_notes
from agv_analysis.bags.export import export_csv, export_parquet
from agv_analysis.bags.trajectories import trajectories_of

STORE = get_typestore(Stores.ROS2_JAZZY)
TF = "tf2_msgs/msg/TFMessage"


@pytest.mark.parametrize(
    ("path", "unit", "meaning"),
    [
        ("height", "mm", "how far above the ground [mm]"),
        ("speed", "", "in [m/s] or [km/h], as configured"),
        ("plain", "", ""),
        ("linear.x", "m/s", ""),
        ("len(many)", "1", "number of elements of many"),
        ("many.y", "m", "second coordinate"),
        ("angle", "rad", "start angle [rad] which way (left)"),
    ],
)
def test_units_and_meaning_from_the_definition(path: str, unit: str, meaning: str) -> None:
    text = """# What the file is about, which is of no field.

# how far above the ground [mm]
float64 height
int8 CONSTANT=3
float64 speed     # in [m/s] or [km/h], as configured
float64 plain

# start angle [rad]
float64 angle  # which way (left)
Vector linear
geometry_msgs/Point[] many
================================================================================
MSG: my_msgs/Vector
float64 x # of a speed [m/s]
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y  # second coordinate
"""
    note = column_notes("my_msgs/msg/Thing", text)[path]
    if path == "linear.x":
        meaning = "of a speed [m/s]"
    assert note == Note(unit, meaning)


def test_a_definition_that_is_not_understood_has_no_notes() -> None:
    assert set(column_notes("a/A", "what is this")) == {"log_time_ns", "publish_time_ns"}


def test_transforms_are_trajectories_by_frame(tmp_path: Path) -> None:
    types: dict[str, Any] = STORE.types
    vector, turn = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    transform, stamped = types["geometry_msgs/msg/Transform"], types["geometry_msgs/msg/TransformStamped"]
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        text = STORE.generate_msgdef(TF, ros_version=2)[0].encode()
        channel = writer.register_channel("/tf", "cdr", writer.register_schema(TF, "ros2msg", text))
        for k in range(6):
            found = []
            for frame in ("base", "arm")[: 1 + k % 2]:
                stamp = types["builtin_interfaces/msg/Time"](7, k)
                header = types["std_msgs/msg/Header"](stamp, "map")
                place = vector(float(k), np.nan if (k, frame) == (3, "arm") else 2.0, 3.0)
                found.append(stamped(header, frame, transform(place, turn(0.0, 0.0, 0.0, 1.0))))
            payload = bytes(STORE.serialize_cdr(types[TF](found), TF))
            writer.add_message(channel, 100 + k, payload, 100 + k)
        writer.finish()  # type: ignore[no-untyped-call]
    arm, base = trajectories_of(read_bag(tmp_path / "a.mcap")["/tf"])
    assert (arm.name, base.name) == ("arm", "base")
    assert list(arm.lines()) == ["7.000000001 1.0 2.0 3.0 0.0 0.0 0.0 1.0", "7.000000005 5.0 2.0 3.0 0.0 0.0 0.0 1.0"]
    assert base.times.tolist() == [7 * 10**9 + k for k in range(6)]
    assert base.poses[:, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


def test_names_that_are_no_file_names_are_encoded(tmp_path: Path) -> None:
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        for number, topic in enumerate(["/../../up", "a\0b", "a b", "a_b"]):
            schema = writer.register_schema("std_msgs/msg/Int32", "ros2msg", b"int32 data")
            channel = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channel, number, b"\0\1\0\0" + bytes(4), number)
        writer.finish()  # type: ignore[no-untyped-call]
    paths = export_csv(read_bag(tmp_path / "a.mcap"), tmp_path / "out")
    assert sorted(path.name for path in paths) == sorted(["......up.csv", "a%00b.csv", "a%20b.csv", "a_b.csv"])
    assert {path.parent for path in paths} == {tmp_path / "out"}


@pytest.mark.parametrize(
    "odd",
    [
        [("position.x", "f8"), ("position.y", "f8", 2), ("position.z", "f8")],
        [("position.x", "S3"), ("position.y", "S3"), ("position.z", "S3")],
        [("len(poses)", "u4"), ("poses.child_frame_id", "S2"), ("poses.position.x", "f8", 2)],
    ],
)
def test_columns_that_only_have_the_names_of_a_pose_are_none(odd: list[Any]) -> None:
    turn = [(f"{odd[-1][0].rpartition('position')[0]}orientation.{axis}", *odd[-1][1:]) for axis in "xyzw"]
    rest = [(odd[-1][0][:-1] + axis, *odd[-1][1:]) for axis in "yz"] if len(odd[-1]) > 2 else []
    rows = np.zeros(3, [("log_time_ns", "i8"), *odd, *rest, *turn])
    assert list(trajectories_of(rows)) == []


MIXED = """# which way [rad]
float64 angle
string name
bool ok
int64 whole
float32[2] pair
geometry_msgs/Point[] points
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
"""


@pytest.mark.parametrize("library", ["pandas", "polars", "pyarrow"])
def test_other_libraries_read_parquet_as_it_was_sent(tmp_path: Path, library: str) -> None:
    reader = pytest.importorskip(f"{library}.parquet" if library == "pyarrow" else library)
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(MIXED, "my_msgs/msg/Mixed"))
    point, mixed = store.types["geometry_msgs/msg/Point"], store.types["my_msgs/msg/Mixed"]
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("my_msgs/msg/Mixed", "ros2msg", MIXED.encode())
        channel = writer.register_channel("/a/b", "cdr", schema)
        for i in range(3):
            points = [point(1.0, 2.0, float(i))] * i
            sent = mixed(0.1 * i, "ä" * i, i == 1, 2**60 + i, np.array([i, -1], np.float32), points)
            payload = bytes(store.serialize_cdr(sent, "my_msgs/msg/Mixed"))
            writer.add_message(channel, 10**18 + i, payload, 10**18)
        writer.finish()  # type: ignore[no-untyped-call]
    (path,) = export_parquet(read_bag(tmp_path / "a.mcap"), tmp_path / "tables")
    table = reader.read_table(path) if library == "pyarrow" else reader.read_parquet(path)
    names = table.column_names if library == "pyarrow" else list(table.columns)

    def column(name: str) -> list[Any]:
        values: list[Any] = table[name].to_pylist() if library == "pyarrow" else table[name].to_list()
        return values

    assert path.name == "a.b.parquet"
    assert names == [
        "log_time_ns", "publish_time_ns", "angle", "name", "ok", "whole", "pair[0]", "pair[1]", "len(points)",
        "points.x[0]", "points.x[1]", "points.y[0]", "points.y[1]", "points.z[0]", "points.z[1]",
    ]  # fmt: skip
    assert column("log_time_ns") == [10**18, 10**18 + 1, 10**18 + 2]
    assert column("angle") == [0.0, 0.1, 0.2]
    assert column("name") == ["", "ä", "ää"]
    assert [bool(value) for value in column("ok")] == [False, True, False]
    assert column("whole") == [2**60, 2**60 + 1, 2**60 + 2]
    assert column("pair[0]") == [0.0, 1.0, 2.0]
    assert column("len(points)") == [0, 1, 2]
    assert np.array_equal(column("points.z[1]"), [np.nan, np.nan, 2.0], equal_nan=True)
    about = pytest.importorskip("pyarrow.parquet").read_schema(path)
    assert about.field("angle").metadata == {b"unit": b"rad", b"meaning": b"which way [rad]"}
