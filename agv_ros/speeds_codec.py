"""Speeds over the next steps on the wire: trajectory_msgs/MultiDOFJointTrajectory <-> plain values, as in `codec`.

One point a step, the first at the stamp, each with one velocity and its time from the start.
"""

from __future__ import annotations

import math
import struct
from functools import lru_cache
from typing import NamedTuple

from agv_ros.codec import stamp_of
from agv_ros.messages import InvalidMessageError
from agv_ros.stamps import NS_PER_S

_ENCAPSULATION = b"\x00\x01\x00\x00"
_HEADER = len(_ENCAPSULATION)
_MOST_POINTS = 10_000


class SpeedsAhead(NamedTuple):
    """Speeds (v [m/s], w [rad/s]) of the steps from an instant on."""

    stamp_ns: int
    speeds: tuple[tuple[float, float], ...]


@lru_cache(maxsize=64)
def _points(order: str, count: int, begin: int) -> struct.Struct:
    """`count` points of one velocity each, the first of them `begin` bytes after the encapsulation header."""
    fields = order
    for _ in range(count):
        gap = -(begin + 8) % 8
        fields += f"II{gap}x6dIiI"
        begin += 8 + gap + 48 + 12
    return struct.Struct(fields)


def encode_speeds(ahead: SpeedsAhead, ts_ns: int, frame: str) -> bytes:
    """trajectory_msgs/MultiDOFJointTrajectory in `frame`; its one joint has the name of the frame."""
    name = frame.encode() + b"\0"
    text = struct.pack("<I", len(name)) + name + bytes(-len(name) % 4)
    head = struct.pack("<iI", *divmod(ahead.stamp_ns, NS_PER_S)) + text + struct.pack("<I", 1) + text
    head += struct.pack("<I", len(ahead.speeds))
    values: list[float] = []
    for step, (v, w) in enumerate(ahead.speeds):
        values += (0, 1, v, 0.0, 0.0, 0.0, 0.0, w, 0, *divmod(step * ts_ns, NS_PER_S))
    return _ENCAPSULATION + head + _points("<", len(ahead.speeds), len(head)).pack(*values)


def decode_speeds(data: bytes) -> SpeedsAhead:
    """trajectory_msgs/MultiDOFJointTrajectory with one velocity a point. Raises InvalidMessageError."""
    if len(data) < _HEADER + 16 or data[0] != 0 or data[1] > 1:
        raise InvalidMessageError(f"not a CDR message of this type: {len(data)} bytes")
    order = "<" if data[1] else ">"
    try:
        return SpeedsAhead(stamp_of(data), _decode_points(order, data))
    except struct.error:
        raise InvalidMessageError(f"message of speeds ends too soon, after {len(data)} bytes") from None


def _decode_points(order: str, data: bytes) -> tuple[tuple[float, float], ...]:
    position = _after_string(order, data, 8)
    (names,) = struct.unpack_from(order + "I", data, _HEADER + position)
    position += 4
    for _ in range(min(names, len(data))):
        position = _after_string(order, data, position)
    (count,) = struct.unpack_from(order + "I", data, _HEADER + position)
    position += 4
    if not 0 < count <= _MOST_POINTS:
        raise InvalidMessageError(f"{count} steps of speeds, must be 1 to {_MOST_POINTS}")
    values = _points(order, count, position).unpack_from(data, _HEADER + position)
    if any(values[i::11] != (wanted,) * count for i, wanted in ((0, 0), (1, 1), (8, 0))):
        raise InvalidMessageError("a step must have exactly one velocity and nothing else")
    speeds = tuple(zip(values[2::11], values[7::11], strict=True))
    if not all(math.isfinite(v) and math.isfinite(w) for v, w in speeds):
        raise InvalidMessageError("speeds are not finite")
    return speeds


def _after_string(order: str, data: bytes, position: int) -> int:
    """Where the whole word after a string at `position` begins."""
    (length,) = struct.unpack_from(order + "I", data, _HEADER + position)
    if length > len(data):
        raise InvalidMessageError(f"message ends inside a string, after {len(data)} bytes")
    return (position + 4 + int(length) + 3) // 4 * 4
