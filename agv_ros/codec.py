"""The loop's messages on the wire: CDR bytes <-> plain values.

rclpy takes and publishes serialised messages as they are (`raw=True`). Building a message object, converting it to C
and serialising it costs five times as much as packing its few numbers directly, and a control loop consists of little
else. So the loop's nodes speak CDR themselves, for exactly four types: geometry_msgs/PoseStamped,
geometry_msgs/TwistStamped, nav_msgs/Odometry and sensor_msgs/TimeReference; and they write diagnostics, transforms and
the clock, since rclpy leaves whatever memory held before in the gaps of a message, and equal runs shall have equal
bytes.

Theory of operation. A CDR stream is a 4-byte encapsulation header (byte 1: 1 little, 0 big endian) and the members in
order, each aligned to its own size counted from the end of that header. Up to the last string the layout of a type is
fixed by the lengths of its strings, so a layout is one `struct.Struct`, made once per (byte order, string lengths) and
kept. Padding is always written as zeros: equal values give equal bytes.

Decoders accept any frame_id, either byte order and trailing bytes, and raise InvalidMessageError, never struct.error,
on anything else: too short, a number that is not finite, a quaternion that is not a rotation, no stamp.

Source: OMG DDS-RTPS 2.5, 10.2 (encapsulation) and the CORBA CDR rules it refers to; REP 103 (units, yaw about +z).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from functools import lru_cache

from agv_ros.message_types import ODOMETRY, POSE
from agv_ros.messages import (
    FRAME_AGV,
    FRAME_MAP,
    FRAME_REFERENCE,
    SQUARED_LENGTH,
    Command,
    InvalidMessageError,
    Slot,
    StampedPose,
    TrackingError,
    quaternion_of_yaw,
    yaw_of_quaternion,
)
from agv_ros.stamps import NS_PER_S

_HEADER = 4
_MAX_STRING = 4096
_LENGTH = {order: struct.Struct(order + "I") for order in "<>"}
"""Length word of a string, by byte order."""


@lru_cache(maxsize=512)
def _layout(order: str, before: str, strings: tuple[int, ...], after: str, alignment: int) -> struct.Struct:
    """Struct of `before`, then strings of these lengths (length word and text each), then `after` aligned."""
    fields = before
    position = struct.calcsize("<" + before)
    for length in strings:
        gap = -position % 4
        fields += f"{gap}xI{length}s"
        position += gap + 4 + length
    return struct.Struct(f"{order}{fields}{-position % alignment}x{after}")


def _order(data: bytes) -> str:
    if len(data) < _HEADER + 12 or data[0] != 0 or data[1] > 1:
        raise InvalidMessageError(f"not a CDR message of this type: {len(data)} bytes")
    return "<" if data[1] else ">"


def _string_length(order: str, data: bytes, position: int) -> int:
    """Length word of the string at `position`, counted from the end of the encapsulation header."""
    try:
        (length,) = _LENGTH[order].unpack_from(data, _HEADER + position)
    except struct.error:
        raise InvalidMessageError(f"message ends inside a string, after {len(data)} bytes") from None
    if length > _MAX_STRING:
        raise InvalidMessageError(f"string of {length} bytes, at most {_MAX_STRING} are accepted")
    return int(length)


def _unpack(layout: struct.Struct, data: bytes) -> tuple[float, ...]:
    if len(data) < _HEADER + layout.size:
        raise InvalidMessageError(f"message has {len(data)} bytes, its type needs {_HEADER + layout.size}")
    return layout.unpack_from(data, _HEADER)


def _finite(what: str, values: tuple[float, ...]) -> None:
    if not all(map(math.isfinite, values)):
        raise InvalidMessageError(f"{what} is not finite: {', '.join(map(repr, values))}")


def _yaw(what: str, x: float, y: float, z: float, w: float) -> float:
    norm = x * x + y * y + z * z + w * w
    if not abs(norm - 1.0) < SQUARED_LENGTH:
        raise InvalidMessageError(f"{what} has a quaternion of squared length {norm!r}, must be 1")
    return yaw_of_quaternion(x, y, z, w)


def _instant(what: str, sec: float, nanosec: float) -> int:
    """Stamp [ns]. Raises InvalidMessageError for 0, which a message has whose sender set none."""
    stamp_ns = int(sec) * NS_PER_S + int(nanosec)
    if stamp_ns == 0:
        raise InvalidMessageError(f"{what} has the stamp 0, which means 'no time': its sender must set header.stamp")
    return stamp_ns


def _split(stamp_ns: int) -> tuple[int, int]:
    return divmod(stamp_ns, NS_PER_S)


def stamp_of(data: bytes) -> int:
    """Stamp [ns] of any message that begins with a std_msgs/Header or a time (rosgraph_msgs/Clock)."""
    if len(data) < _HEADER + 8:
        raise InvalidMessageError(f"message has {len(data)} bytes, too few for a stamp")
    sec, nanosec = struct.unpack_from("<iI" if data[1] else ">iI", data, _HEADER)
    return int(sec) * NS_PER_S + int(nanosec)


_LITTLE = b"\x00\x01\x00\x00"


@lru_cache(maxsize=512)
def _string(text: str) -> bytes:
    """A string as CDR holds it, with the zero at its end."""
    return text.encode() + b"\0"


def padded(data: bytes) -> bytes:
    """Message filled up to whole 4-byte words, as RTPS does on its way between processes but not within one.

    So a message has the same bytes wherever its reader is.
    """
    return data + bytes(-len(data) % 4)


def encode_clock(stamp_ns: int) -> bytes:
    """rosgraph_msgs/Clock."""
    return _LITTLE + struct.pack("<iI", *_split(stamp_ns))


def encode_pose(pose: StampedPose) -> bytes:
    """geometry_msgs/PoseStamped in frame `map`; z, roll and pitch are zero."""
    frame = _string(FRAME_MAP)
    layout = _layout("<", "iI", (len(frame),), "7d", 8)
    z, w = quaternion_of_yaw(pose.theta)
    return _LITTLE + layout.pack(*_split(pose.stamp_ns), len(frame), frame, pose.x, pose.y, 0.0, 0.0, 0.0, z, w)


def decode_pose(data: bytes) -> StampedPose:
    """geometry_msgs/PoseStamped; theta in (-pi, pi]. Raises InvalidMessageError, for the stamp 0, too."""
    order = _order(data)
    layout = _layout(order, "iI", (_string_length(order, data, 8),), "7d", 8)
    sec, nanosec, _, _, x, y, _, qx, qy, qz, qw = _unpack(layout, data)
    _finite("pose", (x, y))
    return StampedPose(_instant("pose", sec, nanosec), x, y, _yaw("pose", qx, qy, qz, qw))


def encode_transform(pose: StampedPose, child: str) -> bytes:
    """tf2_msgs/TFMessage with one transform: where frame `child` is in frame `map`."""
    frame, child_frame = _string(FRAME_MAP), _string(child)
    layout = _layout("<", "IiI", (len(frame), len(child_frame)), "7d", 8)
    z, w = quaternion_of_yaw(pose.theta)
    return _LITTLE + layout.pack(
        1, *_split(pose.stamp_ns), len(frame), frame, len(child_frame), child_frame, pose.x, pose.y, 0.0, 0.0, 0.0, z, w
    )


def encode_command(command: Command, prefix: str = "") -> bytes:
    """geometry_msgs/TwistStamped in frame `base_link`, whose name begins with `prefix`."""
    frame = _string(prefix + FRAME_AGV)
    layout = _layout("<", "iI", (len(frame),), "6d", 8)
    return _LITTLE + layout.pack(*_split(command.stamp_ns), len(frame), frame, command.v, 0.0, 0.0, 0.0, 0.0, command.w)


def encode_twist(command: Command) -> bytes:
    """geometry_msgs/Twist: the command without stamp and frame."""
    return _LITTLE + struct.pack("<6d", command.v, 0.0, 0.0, 0.0, 0.0, command.w)


def decode_command(data: bytes) -> Command:
    """geometry_msgs/TwistStamped. Raises InvalidMessageError, for the stamp 0, too."""
    order = _order(data)
    layout = _layout(order, "iI", (_string_length(order, data, 8),), "6d", 8)
    sec, nanosec, _, _, v, _, _, _, _, w = _unpack(layout, data)
    _finite("command", (v, w))
    return Command(_instant("command", sec, nanosec), v, w)


def _odometry_layout(order: str, frame: int, child: int) -> struct.Struct:
    return _layout(order, "iI", (frame, child), "7d288x6d288x", 8)


def encode_error(error: TrackingError, prefix: str = "") -> bytes:
    """nav_msgs/Odometry: frame_id `base_link`, child_frame_id `reference`; covariances zero (unknown).

    The names of both frames begin with `prefix`.
    """
    frame, child = _string(prefix + FRAME_AGV), _string(prefix + FRAME_REFERENCE)
    layout = _odometry_layout("<", len(frame), len(child))
    z, w = quaternion_of_yaw(error.theta_e)
    return _LITTLE + layout.pack(
        *_split(error.stamp_ns), len(frame), frame, len(child), child,
        error.x_e, error.y_e, 0.0, 0.0, 0.0, z, w, error.v_r, 0.0, 0.0, 0.0, 0.0, error.w_r,
    )  # fmt: skip


def decode_error(data: bytes) -> TrackingError:
    """nav_msgs/Odometry; theta_e in (-pi, pi]. Raises InvalidMessageError."""
    order = _order(data)
    frame = _string_length(order, data, 8)
    child = _string_length(order, data, (12 + frame + 3) // 4 * 4)
    values = _unpack(_odometry_layout(order, frame, child), data)
    sec, nanosec, _, _, _, _, x, y, _, qx, qy, qz, qw, v, _, _, _, _, w = values
    _finite("tracking error", (x, y, v, w))
    return TrackingError(_instant("message", sec, nanosec), x, y, _yaw("tracking error", qx, qy, qz, qw), v, w)


def decode_odometry(data: bytes) -> StampedPose:
    """nav_msgs/Odometry, the pose in it; theta in (-pi, pi]. Raises InvalidMessageError."""
    return StampedPose(*decode_error(data)[:4])


def pose_decoder(pose_type: str) -> Callable[[bytes], StampedPose]:
    """What reads poses of this type, one of `POSE_TYPES`."""
    return {POSE: decode_pose, ODOMETRY: decode_odometry}[pose_type]


def encode_slot(slot: Slot) -> bytes:
    """sensor_msgs/TimeReference: header.stamp = t_k, time_ref = freshest stamp held, source = outcome.

    The note goes into header.frame_id, which this type has no other use for.
    """
    source, note = _string(slot.outcome), _string(slot.note)
    layout = _layout("<", "iI", (len(note),), f"iII{len(source)}s", 4)
    return padded(
        _LITTLE + layout.pack(*_split(slot.stamp_ns), len(note), note, *_split(slot.freshest_ns), len(source), source)
    )


def decode_slot(data: bytes) -> Slot:
    """sensor_msgs/TimeReference. Raises InvalidMessageError."""
    order = _order(data)
    frame = _string_length(order, data, 8)
    source = _string_length(order, data, (12 + frame + 3) // 4 * 4 + 8)
    values = _unpack(_layout(order, "iI", (frame,), f"iII{source}s", 4), data)
    freshest = int(values[4]) * NS_PER_S + int(values[5])
    return Slot(int(values[0]) * NS_PER_S + int(values[1]), freshest, _text(values[-1]), _text(values[3]))


@lru_cache(maxsize=512)
def _text(value: object) -> str:
    assert isinstance(value, bytes)
    return value.rstrip(b"\0").decode("utf-8", "replace")


def _aligned_string(text: str) -> bytes:
    """A string that begins and ends on a whole word."""
    content = _string(text)
    return padded(struct.pack("<I", len(content)) + content)


def encode_diagnostics(stamp_ns: int, level: int, name: str, message: str, facts: Mapping[str, str]) -> bytes:
    """diagnostic_msgs/DiagnosticArray with one status; `level` is 0 (OK), 1 (WARN) or 2 (ERROR)."""
    head = struct.pack("<iI", *_split(stamp_ns)) + _aligned_string("") + struct.pack("<IBxxx", 1, level)
    status = _aligned_string(name) + _aligned_string(message) + _aligned_string("")
    values = b"".join(_aligned_string(key) + _aligned_string(value) for key, value in facts.items())
    return _LITTLE + head + status + struct.pack("<I", len(facts)) + values
