"""CDR -> arrays, held against rosbags: every type of ROS 2 Jazzy that it knows, with values drawn at random."""

from __future__ import annotations

import contextlib
import itertools
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from agv_analysis.bags.bag_errors import UndecodableError
from agv_analysis.bags.layout import LEAD, trace
from agv_analysis.bags.message_batch import Batch
from agv_analysis.bags.message_table import Table
from agv_analysis.bags.schema import parse_schema

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = sorted(
    name for name in STORE.types if "/msg/" in name and "wstring" not in STORE.generate_msgdef(name, ros_version=2)[0]
)

NUMPY = {"bool": "?", "byte": "u1", "octet": "u1", "char": "u1", "float32": "f4", "float64": "f8"} | {
    f"{sign}int{bits}": f"{sign[:1] or 'i'}{bits // 8}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}


class Draw:
    """Random messages of any type, as rosbags' objects."""

    def __init__(self, seed: int, longest: int = 3) -> None:
        self._random = np.random.default_rng(seed)
        self._longest = longest

    def message(self, name: str) -> Any:
        fields = STORE.fielddefs[name][1]
        return STORE.types[name](**{field: self._value(kind) for field, kind in fields})

    def _value(self, kind: Any, count: int | None = None) -> Any:
        node, detail = kind
        if node == Nodetype.NAME:
            return self.message(detail)
        if node == Nodetype.BASE:
            return self._base(detail[0])
        inner, length = detail
        if node == Nodetype.SEQUENCE:
            length = int(self._random.integers(0, min(length or self._longest, self._longest) + 1))
        if inner[0] == Nodetype.BASE and inner[1][0] != "string":
            return self._numbers(inner[1][0], length)
        return [self._value(inner) for _ in range(length)]

    def _base(self, name: str) -> Any:
        if name == "string":
            return "".join(self._random.choice(list("abcöß€🚗 /"), self._random.integers(0, 9)))
        return self._numbers(name, 1)[0].item()

    def _numbers(self, name: str, count: int) -> Any:
        code = NUMPY[name]
        if code == "?":
            return self._random.integers(0, 2, count).astype(np.bool_)
        if code[0] == "f":
            return (self._random.normal(size=count) * self._random.choice([1, 1e30, np.inf, np.nan])).astype(code)
        info = np.iinfo(code)
        high = 127 if name in ("byte", "octet", "char") else info.max  # where rosbags and ROS agree
        return self._random.integers(info.min, high, count, dtype=code, endpoint=True)


def leaves(message: Any, prefix: str = "", index: tuple[int, ...] = ()) -> Any:
    """(path, index, value) of every value in a message; lengths of sequences as `len(path)`."""
    fields = STORE.fielddefs[message.__msgtype__][1]
    for name, (node, detail) in fields:
        value, path = getattr(message, name), prefix + name
        if name == "structure_needs_at_least_one_member":
            continue
        if node == Nodetype.SEQUENCE:
            yield f"len({path})", index, len(value)
        if node == Nodetype.NAME:
            yield from leaves(value, f"{path}.", index)
        elif node == Nodetype.BASE:
            yield path, index, value
        else:
            for i, item in enumerate(value):
                if detail[0][0] == Nodetype.NAME:
                    yield from leaves(item, f"{path}.", (*index, i))
                else:
                    yield path, (*index, i), item


def batch_of(payloads: list[bytes]) -> Batch:
    messages = [np.array([i, 1000 + i], "<i8").tobytes() + payload for i, payload in enumerate(payloads)]
    sizes = np.array([len(message) for message in messages])
    return Batch(np.frombuffer(b"".join(messages), np.uint8), np.cumsum(sizes) - sizes, sizes)


def serialise(message: Any, little: bool = True) -> bytes:
    return bytes(STORE.serialize_cdr(message, message.__msgtype__, little_endian=little))


def table_of(name: str, helper: Executor | None = None) -> Table:
    return Table(parse_schema(name, "ros2msg", STORE.generate_msgdef(name, ros_version=2)[0]), helper=helper)


def assert_same(row: Any, message: Any) -> None:
    for path, index, value in leaves(message):
        found = row[path][index] if index else row[path]
        if isinstance(value, str):
            assert found.decode() == value
        else:
            expected = np.array(value, found.dtype)
            assert found.tobytes() == expected.tobytes(), (path, index, found, value)


@pytest.mark.parametrize("name", TYPES)
def test_every_type_is_decoded_as_rosbags_encodes_it(name: str) -> None:
    draw = Draw(seed=len(name))
    messages = [draw.message(name) for _ in range(12)]
    table = table_of(name)
    for part in (messages[:1], messages[1:7], messages[7:]):
        table.append(batch_of([serialise(message) for message in part]))
    assert len(table.rows) == len(messages)
    assert table.layouts.misfits == 0
    for row, message in zip(table.rows, messages, strict=True):
        assert_same(row, message)


@pytest.mark.parametrize("name", ["nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/JointState"])
def test_both_byte_orders_in_one_batch(name: str) -> None:
    draw = Draw(seed=5)
    messages = [draw.message(name) for _ in range(20)]
    table = table_of(name)
    table.append(batch_of([serialise(message, little=i % 3 > 0) for i, message in enumerate(messages)]))
    for row, message in zip(table.rows, messages, strict=True):
        assert_same(row, message)


@pytest.mark.parametrize("name", ["nav_msgs/msg/Odometry", "sensor_msgs/msg/TimeReference", "std_msgs/msg/ColorRGBA"])
def test_the_fast_lane_gives_the_same_table(name: str) -> None:
    draw = Draw(seed=9)
    payloads = [serialise(draw.message(name), little=i % 5 > 0) for i in range(400)]
    payloads[100] = payloads[100][:-9]
    payloads[250:255] = [b""] * 5
    with ThreadPoolExecutor(1) as helper:
        usual, fast = table_of(name), table_of(name, helper)
        for begin, end in itertools.pairwise([0, 1, 90, 91, 270, 400]):
            usual.append(batch_of(payloads[begin:end]))
            fast.append(batch_of(payloads[begin:end]))
    assert usual.layouts.misfits == fast.layouts.misfits == 6
    assert fast.rows.dtype == usual.rows.dtype
    assert fast.rows.tobytes() == usual.rows.tobytes()


def test_the_fast_lane_learns_the_layouts_that_it_meets() -> None:
    kind = STORE.types["std_msgs/msg/String"]
    texts = ["lost", "delivered", "", "x" * 20] * 50
    with ThreadPoolExecutor(1) as helper:
        table = table_of("std_msgs/msg/String", helper)
        table.append(batch_of([serialise(kind(text)) for text in texts]))
        table.append(batch_of([serialise(kind(text)) for text in texts]))
    assert table.rows["data"].tolist() == [text.encode() for text in texts] * 2


def test_what_a_sequence_does_not_fill_is_nan_zero_or_empty() -> None:
    kind = STORE.types["sensor_msgs/msg/JointState"]
    header = Draw(1).message("std_msgs/msg/Header")
    full = kind(header, ["a", "bc"], np.array([1.0, 2.0]), np.array([]), np.array([]))
    bare = kind(header, [], np.array([]), np.array([]), np.array([]))
    table = table_of("sensor_msgs/msg/JointState")
    table.append(batch_of([serialise(bare), serialise(full), serialise(bare)]))
    assert table.rows["len(position)"].tolist() == [0, 2, 0]
    np.testing.assert_array_equal(table.rows["position"], [[np.nan] * 2, [1, 2], [np.nan] * 2])
    assert table.rows["name"].tolist() == [[b"", b""], [b"a", b"bc"], [b"", b""]]
    assert table.rows["velocity"].shape == (3, 0)


def test_a_column_of_strings_is_as_wide_as_the_longest() -> None:
    kind = STORE.types["std_msgs/msg/String"]
    table = table_of("std_msgs/msg/String")
    texts = ["lost", "delivered", "", "lost", "x" * 300]
    for text in texts:
        table.append(batch_of([serialise(kind(text))]))
    assert table.rows["data"].tolist() == [text.encode() for text in texts]
    assert table.rows["data"].dtype == "S300"


def test_a_string_without_its_final_zero_is_empty_or_cut_by_one() -> None:
    table = table_of("std_msgs/msg/String")
    little, big = b"\0\1\0\0", b"\0\0\0\0"
    contents = [
        little + b"\0\0\0\0", little + b"\1\0\0\0\0", little + b"\1\0\0\0m", big + b"\0\0\0\1m",
        little + b"\3\0\0\0map", big + b"\0\0\0\3map",
    ]  # fmt: skip
    table.append(batch_of(contents))
    assert table.rows["data"].tolist() == [b"", b"", b"", b"", b"ma", b"ma"]


def test_messages_of_another_type_are_counted_and_left_out() -> None:
    pose, twist = Draw(1).message("geometry_msgs/msg/PoseStamped"), Draw(1).message("geometry_msgs/msg/TwistStamped")
    table = table_of("geometry_msgs/msg/PoseStamped")
    table.append(
        batch_of([serialise(pose), serialise(twist), b"", b"\0\1", b"\0\7\0\0" + serialise(pose)[4:], serialise(pose)])
    )
    assert table.layouts.misfits == 4
    assert table.rows["log_time_ns"].tolist() == [0, 5]
    for row in table.rows:
        assert_same(row, pose)


def test_a_definition_that_is_not_the_messages_is_refused() -> None:
    table = table_of("std_msgs/msg/String")
    payload = serialise(Draw(1).message("geometry_msgs/msg/PoseStamped"))
    several = [batch_of([payload] * 50) for _ in range(10)]
    with pytest.raises(UndecodableError, match="not of its type"):  # noqa: PT012
        for batch in several:  # refused when enough of them have been seen
            table.append(batch)


@given(
    st.binary(max_size=200),
    st.sampled_from(["nav_msgs/msg/Path", "sensor_msgs/msg/PointCloud2", "std_msgs/msg/String"]),
)
@settings(max_examples=300, deadline=None, derandomize=True)
def test_no_bytes_make_it_raise_anything_else(content: bytes, name: str) -> None:
    kind = parse_schema(name, "ros2msg", STORE.generate_msgdef(name, ros_version=2)[0])
    with contextlib.suppress(UndecodableError):
        trace(kind, bytes(LEAD) + b"\0\1\0\0" + content)


def test_a_hostile_length_is_refused_before_anything_is_made_of_it() -> None:
    kind = parse_schema("a/A", "ros2msg", "float64[] values")
    with pytest.raises(UndecodableError, match="4294967295 long, 0 bytes are left"):
        trace(kind, bytes(LEAD) + b"\0\1\0\0" + b"\xff" * 4)
    with pytest.raises(UndecodableError, match="ends after"):
        trace(
            parse_schema("a/A", "ros2msg", "a/B[4000000000] many\n" + "=" * 80 + "\nMSG: a/B\nint8 x"),
            bytes(LEAD) + b"\0\1\0\0",
        )


def test_one_long_message_among_short_ones_does_not_take_all_memory() -> None:
    kind = STORE.types["std_msgs/msg/String"]
    table = table_of("std_msgs/msg/String")
    table.append(batch_of([serialise(kind("short"))] * 20_000))
    with pytest.raises(UndecodableError, match="differ so much in length"):
        table.append(batch_of([serialise(kind("x" * 1_000_000))]))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("a/B b", "without describing it"),
        ("a/A a", "nested more than"),
        ("int32", "not understood"),
        ("int32 x\nfloat64 y\nint32 x", "declares x twice"),
        ("int32 x\n" + "=" * 80 + "\nnothing", "instead of 'MSG: type'"),
    ],
)  # fmt: skip
def test_a_definition_that_cannot_be_used(text: str, complaint: str) -> None:
    with pytest.raises(UndecodableError, match=complaint):
        parse_schema("a/A", "ros2msg", text)


def test_a_definition_in_another_language_is_refused() -> None:
    with pytest.raises(UndecodableError, match="its definition is in 'omgidl'; ros2msg and ros2idl are read"):
        parse_schema("a/A", "omgidl", "")


def test_constants_comments_defaults_and_bounds() -> None:
    text = """
    # a comment
    int32 LIMIT=5
    string NAME = "a = b"   # another
    int32 x 7
    string<=10 name 'none'
    float32[2] pair [1.0, 2.0]
    uint8[<=4] few
    float64[] many
    """
    members = parse_schema("a/A", "ros2msg", text).members
    assert [(m.path, m.element, m.length, m.is_sequence) for m in members] == [
        ("x", "i4", None, False), ("name", "string", None, False), ("pair", "f4", 2, False), ("few", "u1", 4, True),
        ("many", "f8", None, True),
    ]  # fmt: skip
