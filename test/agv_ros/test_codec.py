"""The wire format against rclpy's serialisation, rosbags, mcap-ros2-support, messages made by hand, and rubbish."""

from __future__ import annotations

import importlib
import math
import struct
from collections.abc import Callable
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from agv_ros.codec import (
    decode_command,
    decode_error,
    decode_pose,
    decode_slot,
    encode_clock,
    encode_command,
    encode_error,
    encode_pose,
    encode_slot,
    stamp_of,
)
from agv_ros.messages import (
    DELIVERED,
    LOST,
    Command,
    InvalidMessageError,
    Slot,
    StampedPose,
    TrackingError,
    quaternion_of_yaw,
    yaw_of_quaternion,
)

NS = 1_000_000_000
STORE = get_typestore(Stores.ROS2_JAZZY)

Value = Any
"""One of the loop's messages as a plain value."""

stamps = st.integers(1, 2**31 * NS - 1)
numbers = st.floats(allow_nan=False, allow_infinity=False)
angles = st.floats(-math.pi, math.pi)
poses = st.builds(StampedPose, stamps, numbers, numbers, angles)
commands = st.builds(Command, stamps, numbers, numbers)
errors = st.builds(TrackingError, stamps, numbers, numbers, angles, numbers, numbers)
frames = st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=40)
slots = st.builds(
    Slot,
    stamps,
    st.integers(0, 2**31 * NS - 1),
    st.one_of(st.sampled_from([DELIVERED, LOST]), st.text(st.characters(exclude_characters="\0", codec="utf-8"))),
    frames,
)
values = st.one_of(poses, commands, errors, slots)

ENCODE: dict[type, Callable[[Any], bytes]] = {
    StampedPose: encode_pose, Command: encode_command, TrackingError: encode_error, Slot: encode_slot,
}  # fmt: skip
DECODE: dict[type, Callable[[bytes], Value]] = {
    StampedPose: decode_pose, Command: decode_command, TrackingError: decode_error, Slot: decode_slot,
}  # fmt: skip
TYPES = {
    StampedPose: "geometry_msgs/msg/PoseStamped",
    Command: "geometry_msgs/msg/TwistStamped",
    TrackingError: "nav_msgs/msg/Odometry",
    Slot: "sensor_msgs/msg/TimeReference",
}
PADDING = {StampedPose: (), Command: (26, 27), TrackingError: (26, 27, 42, 43)}
"""Bytes between members that carry nothing, by the alignment rules of CDR and the lengths of the frames."""
FRAMES = {StampedPose: "map", Command: "base_link", TrackingError: "base_link"}


def padding(value: Value) -> tuple[int, ...]:
    """The same of a value; a slot's note stands where others have their frame."""
    if not isinstance(value, Slot):
        return PADDING[type(value)]
    end = 16 + len(value.note.encode()) + 1
    return tuple(range(end, end + -end % 4))


def in_frame(value: Value, frame: str) -> Value:
    """What is read from a message in this frame."""
    return value._replace(note=frame) if isinstance(value, Slot) else value


def fields(value: Value, frame: str | None = None) -> dict[str, Any]:
    """What the message of a value says, by the definition of its type; `frame` in place of the frame it is in."""
    own = value.note if isinstance(value, Slot) else FRAMES[type(value)]
    header = {"stamp": time(value.stamp_ns), "frame_id": own if frame is None else frame}
    if isinstance(value, StampedPose):
        return {"header": header, "pose": pose(value.x, value.y, value.theta)}
    if isinstance(value, Command):
        return {"header": header, "twist": twist(value.v, value.w)}
    if isinstance(value, Slot):
        return {"header": header, "time_ref": time(value.freshest_ns), "source": value.outcome}
    return {
        "header": header,
        "child_frame_id": "reference" if frame is None else frame[::-1],
        "pose": {"pose": pose(value.x_e, value.y_e, value.theta_e), "covariance": [0.0] * 36},
        "twist": {"twist": twist(value.v_r, value.w_r), "covariance": [0.0] * 36},
    }


def time(stamp_ns: int) -> dict[str, int]:
    return {"sec": stamp_ns // NS, "nanosec": stamp_ns % NS}


def pose(x: float, y: float, theta: float) -> dict[str, dict[str, float]]:
    # REP 103: yaw about +z.
    turn = {"x": 0.0, "y": 0.0, "z": math.sin(theta / 2.0), "w": math.cos(theta / 2.0)}
    return {"position": {"x": x, "y": y, "z": 0.0}, "orientation": turn}


def twist(v: float, w: float) -> dict[str, dict[str, float]]:
    return {"linear": {"x": v, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": w}}


def rounded_up(data: bytes | bytearray) -> bytes:
    """As RTPS sends it: a whole number of 4-byte words."""
    return bytes(data) + bytes(-len(data) % 4)


def same(found: Value, value: Value) -> bool:
    """Equal, an angle up to the rounding of its quaternion."""
    turns = {"theta", "theta_e"} & set(value._fields)
    plain = [name for name in value._fields if name not in turns]
    return all(getattr(found, name) == getattr(value, name) for name in plain) and all(
        abs(math.remainder(getattr(found, name) - getattr(value, name), math.tau)) < 1e-15 for name in turns
    )


# -- rclpy -----------------------------------------------------------------------------------------------------------


def filled(message: Any, content: dict[str, Any]) -> Any:
    for name, item in content.items():
        if isinstance(item, dict):
            filled(getattr(message, name), item)
        else:
            setattr(message, name, item)
    return message


@lru_cache
def ros_class(name: str) -> Any:
    pytest.importorskip("rclpy", reason="ROS 2's own serialisation comes with rclpy")
    package, _, kind = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


def serialized(message: Any) -> bytes:
    from rclpy.serialization import serialize_message

    return bytes(serialize_message(message))


def deserialized(data: bytes, kind: type) -> Any:
    from rclpy.serialization import deserialize_message

    return deserialize_message(data, kind)


@settings(deadline=None, derandomize=True)
@given(values)
def test_bytes_are_those_that_ros_writes(value: Value) -> None:
    kind = ros_class(TYPES[type(value)])
    expected = bytearray(serialized(filled(kind(), fields(value))))
    for place in padding(value):
        expected[place] = 0  # ROS leaves there what was in memory
    assert ENCODE[type(value)](value) == rounded_up(expected)


@settings(deadline=None, derandomize=True)
@given(values)
def test_ros_reads_what_is_written(value: Value) -> None:
    kind = ros_class(TYPES[type(value)])
    assert deserialized(ENCODE[type(value)](value), kind) == filled(kind(), fields(value))


@settings(deadline=None, derandomize=True)
@given(values, frames)
def test_what_ros_writes_is_read_in_whatever_frame(value: Value, frame: str) -> None:
    data = serialized(filled(ros_class(TYPES[type(value)])(), fields(value, frame)))
    assert same(DECODE[type(value)](data), in_frame(value, frame))
    assert stamp_of(data) == value.stamp_ns


def test_the_clock_is_that_of_ros() -> None:
    clock = ros_class("rosgraph_msgs/msg/Clock")
    for stamp_ns in (0, 1, NS - 1, NS, 1_800_000_000_005_000_000):
        expected = serialized(filled(clock(), {"clock": time(stamp_ns)}))
        assert encode_clock(stamp_ns) == expected
        assert stamp_of(expected) == stamp_ns


# -- rosbags, both byte orders ---------------------------------------------------------------------------------------


def bag_message(name: str, content: dict[str, Any]) -> Any:
    """Message object of rosbags."""
    arguments: dict[str, Any] = {}
    for field, (_, kind) in STORE.fielddefs[name][1]:
        item = content[field]
        if isinstance(item, dict):
            item = bag_message(str(kind), item)
        arguments[field] = np.array(item) if isinstance(item, list) else item
    return STORE.types[name](**arguments)


@settings(deadline=None, derandomize=True)
@given(values)
def test_bytes_are_those_that_rosbags_writes(value: Value) -> None:
    name = TYPES[type(value)]
    assert ENCODE[type(value)](value) == rounded_up(bytes(STORE.serialize_cdr(bag_message(name, fields(value)), name)))


@settings(deadline=None, derandomize=True)
@given(values, frames, st.booleans(), st.binary(max_size=9))
def test_either_byte_order_is_read_with_anything_behind_it(value: Value, frame: str, little: bool, rest: bytes) -> None:
    name = TYPES[type(value)]
    data = bytes(STORE.serialize_cdr(bag_message(name, fields(value, frame)), name, little_endian=little))
    assert data[:2] == bytes([0, little])
    assert same(DECODE[type(value)](data + rest), in_frame(value, frame))
    assert stamp_of(data) == value.stamp_ns


@settings(deadline=None, derandomize=True)
@given(values)
def test_rosbags_reads_what_is_written(value: Value) -> None:
    name = TYPES[type(value)]
    found = STORE.deserialize_cdr(ENCODE[type(value)](value), name)
    assert said(found, fields(value)) == fields(value)


def said(message: Any, like: dict[str, Any]) -> dict[str, Any]:
    """The fields of a message object, as many as `like` has."""
    content = {}
    for name, item in like.items():
        found = getattr(message, name)
        content[name] = (
            said(found, item) if isinstance(item, dict) else list(found) if isinstance(item, list) else found
        )
    return content


# -- mcap-ros2-support -----------------------------------------------------------------------------------------------


@lru_cache
def dynamic_decoder(name: str) -> Callable[[bytes], SimpleNamespace]:
    schema, _ = STORE.generate_msgdef(name, ros_version=2)
    decoders: dict[str, Callable[[bytes], SimpleNamespace]] = generate_dynamic(name, schema)
    return decoders[name]


@settings(deadline=None, derandomize=True)
@given(values)
def test_mcap_ros2_support_reads_what_is_written(value: Value) -> None:
    found = dynamic_decoder(TYPES[type(value)])(ENCODE[type(value)](value))
    assert said(found, fields(value)) == fields(value)


# -- by hand ---------------------------------------------------------------------------------------------------------


def test_a_big_endian_pose_made_by_hand() -> None:
    data = (
        b"\x00\x00\x00\x00"
        + struct.pack(">iI", 7, 250_000_000)
        + struct.pack(">I", 5) + b"odom\0"  # 8 + 4 + 5 = 17, so 7 bytes up to the next multiple of 8
        + bytes(7)
        + struct.pack(">3d", 1.5, -2.5, 9.0)
        + struct.pack(">4d", 0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
    )  # fmt: skip
    assert decode_pose(data) == pytest.approx((7_250_000_000, 1.5, -2.5, math.pi / 2))


def test_a_little_endian_slot_made_by_hand() -> None:
    data = (
        b"\x00\x01\x00\x00"
        + struct.pack("<iI", 2, 5_000_000)
        + struct.pack("<I", 1) + b"\0" + bytes(3)
        + struct.pack("<iI", 1, 995_000_000)
        + struct.pack("<I", 5) + b"lost\0"
    )  # fmt: skip
    assert decode_slot(data) == Slot(2_005_000_000, 1_995_000_000, LOST)
    assert encode_slot(Slot(2_005_000_000, 1_995_000_000, LOST)) == rounded_up(data)


def test_frames_are_those_of_the_interface() -> None:
    assert b"\x04\0\0\0map\0" in encode_pose(StampedPose(1, 0.0, 0.0, 0.0))
    assert b"\x0a\0\0\0base_link\0" in encode_command(Command(1, 0.0, 0.0))
    error = encode_error(TrackingError(1, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert b"base_link\0" in error
    assert b"reference\0" in error


# -- there and back ----------------------------------------------------------------------------------------------------


@settings(deadline=None, derandomize=True)
@given(values)
def test_there_and_back(value: Value) -> None:
    encode, decode = ENCODE[type(value)], DECODE[type(value)]
    assert same(decode(encode(value)), value)
    assert encode(value) == encode(type(value)(*value))


@settings(deadline=None, derandomize=True)
@given(st.floats(-1e4, 1e4))
def test_an_angle_of_many_turns_comes_back_as_the_same_direction(theta: float) -> None:
    found = decode_pose(encode_pose(StampedPose(1, 0.0, 0.0, theta))).theta
    assert -math.pi <= found <= math.pi
    assert math.remainder(found - theta, math.tau) == pytest.approx(0.0, abs=1e-11)


@settings(deadline=None, derandomize=True)
@given(angles, st.floats(-1.2, 1.2), st.floats(-3.0, 3.0), st.floats(0.996, 1.004))
def test_yaw_of_any_rotation(yaw: float, pitch: float, roll: float, length: float) -> None:
    x, y, z, w = length * Rotation.from_euler("ZYX", (yaw, pitch, roll)).as_quat()
    assert math.remainder(yaw_of_quaternion(x, y, z, w) - yaw, math.tau) == pytest.approx(0.0, abs=1e-12)


@settings(deadline=None, derandomize=True)
@given(angles)
def test_a_yaw_is_a_turn_about_z(theta: float) -> None:
    z, w = quaternion_of_yaw(theta)
    assert (0.0, 0.0, z, w) == pytest.approx(tuple(Rotation.from_rotvec([0.0, 0.0, theta]).as_quat()), abs=1e-15)


# -- what must not enter the loop --------------------------------------------------------------------------------------

GOOD: list[Value] = [
    StampedPose(NS, 1.0, 2.0, 0.5), Command(NS, 1.0, 0.5), TrackingError(NS, 1.0, 2.0, 0.1, 1.0, 0.2),
    Slot(NS, NS, DELIVERED),
]  # fmt: skip


def sound(value: Value) -> bool:
    return all(math.isfinite(item) for item in value if not isinstance(item, str))


def is_refused(decode: Callable[[bytes], Value], data: bytes) -> bool:
    """Is it refused with the error that is due? What is accepted must be sound."""
    try:
        value = decode(data)
    except InvalidMessageError:
        return True
    assert isinstance(value, int) or sound(value)
    return False


@pytest.mark.parametrize("value", GOOD, ids=lambda value: type(value).__name__)
def test_a_message_cut_short_anywhere_is_refused(value: Value) -> None:
    name = TYPES[type(value)]
    data = bytes(STORE.serialize_cdr(bag_message(name, fields(value)), name))
    assert all(is_refused(DECODE[type(value)], data[:size]) for size in range(len(data)))
    assert all(is_refused(stamp_of, data[:size]) == (size < 12) for size in range(len(data)))


@pytest.mark.parametrize("value", GOOD, ids=lambda value: type(value).__name__)
@pytest.mark.parametrize("start", [b"\0\2\0\0", b"\0\3\0\0", b"\0\6\0\0", b"\0\7\0\0", b"\1\1\0\0", b"\xff\xff\0\0"])
def test_other_encapsulations_are_refused(value: Value, start: bytes) -> None:
    assert is_refused(DECODE[type(value)], start + ENCODE[type(value)](value)[4:])


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("value", GOOD[:3], ids=lambda value: type(value).__name__)
def test_numbers_that_are_not_finite_are_refused(value: Value, wrong: float) -> None:
    for name in value._fields[1:]:
        if name.startswith("theta"):
            continue  # no quaternion has such an angle
        with pytest.raises(InvalidMessageError, match="is not finite"):
            DECODE[type(value)](ENCODE[type(value)](value._replace(**{name: wrong})))


@pytest.mark.parametrize(
    "quaternion",
    [(0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0), (0.0, 0.0, math.inf, 0.0), (0.0, 0.0, 0.0, 1.01), (1e200,) * 4],
)
def test_quaternions_that_are_no_rotation_are_refused(quaternion: tuple[float, ...]) -> None:
    for value in (GOOD[0], GOOD[2]):
        data, name = ENCODE[type(value)](value), TYPES[type(value)]
        known = struct.pack("<4d", 0.0, 0.0, *quaternion_of_yaw(value[3]))
        assert data.count(known) == 1, name
        with pytest.raises(InvalidMessageError, match="quaternion of squared length"):
            DECODE[type(value)](data.replace(known, struct.pack("<4d", *quaternion)))


@pytest.mark.parametrize("value", GOOD, ids=lambda value: type(value).__name__)
@pytest.mark.parametrize("length", [4097, 2**31, 2**32 - 1])
def test_a_hostile_length_is_refused_before_anything_is_made_of_it(value: Value, length: int) -> None:
    data = ENCODE[type(value)](value)
    with pytest.raises(InvalidMessageError, match=f"string of {length} bytes, at most 4096"):
        DECODE[type(value)](data[:12] + struct.pack("<I", length) + data[16:])


@settings(deadline=None, derandomize=True, max_examples=500)
@given(st.sampled_from([*DECODE.values(), stamp_of]), st.binary(max_size=900))
def test_no_bytes_make_another_error(decode: Callable[[bytes], Value], data: bytes) -> None:
    is_refused(decode, data)
    is_refused(decode, b"\0\1\0\0" + data)


@settings(deadline=None, derandomize=True, max_examples=500)
@given(
    values,
    st.lists(st.tuples(st.integers(0, 800), st.integers(0, 255)), max_size=6),
    st.sampled_from([*DECODE.values(), stamp_of]),
)
def test_no_damage_makes_another_error(
    value: Value, damage: list[tuple[int, int]], decode: Callable[[bytes], Value]
) -> None:
    data = bytearray(ENCODE[type(value)](value))
    for place, byte in damage:
        data[place % len(data)] = byte
    is_refused(decode, bytes(data))


@pytest.mark.parametrize("value", GOOD, ids=lambda value: type(value).__name__)
def test_every_byte_at_every_place_of_the_head(value: Value) -> None:
    data = ENCODE[type(value)](value)
    for place in range(40):
        for byte in range(256):
            is_refused(DECODE[type(value)], data[:place] + bytes([byte]) + data[place + 1 :])
