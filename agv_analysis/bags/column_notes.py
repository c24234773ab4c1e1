"""What the columns of a topic mean: units and the words that the definition of its type has for them.

Units of ROS's own types are those of REP 103; elsewhere one is taken from a comment that names it in brackets, as in
"start angle of the scan [rad]". What neither says has no unit here.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from agv_analysis.bags.bag_errors import UndecodableError
from agv_analysis.bags.layout import LOG_TIME, PUBLISH_TIME
from agv_analysis.bags.schema import (
    PRIMITIVES,
    STRING,
    WSTRING,
    definitions_by_name,
    parse_line,
    resolve_type,
    short_name,
)

_MAX_DEPTH = 32

_QUATERNION = {"x": "1", "y": "1", "z": "1", "w": "1"}

UNITS: dict[str, dict[str, str]] = {
    "builtin_interfaces/Time": {"sec": "s", "nanosec": "ns"},
    "builtin_interfaces/Duration": {"sec": "s", "nanosec": "ns"},
    "geometry_msgs/Point": {"x": "m", "y": "m", "z": "m"},
    "geometry_msgs/Point32": {"x": "m", "y": "m", "z": "m"},
    "geometry_msgs/Pose2D": {"x": "m", "y": "m", "theta": "rad"},
    "geometry_msgs/Quaternion": _QUATERNION,
    "geometry_msgs/Twist": {"linear": "m/s", "angular": "rad/s"},
    "geometry_msgs/Accel": {"linear": "m/s^2", "angular": "rad/s^2"},
    "geometry_msgs/Wrench": {"force": "N", "torque": "N*m"},
    "geometry_msgs/Transform": {"translation": "m"},
    "geometry_msgs/Inertia": {"m": "kg", "com": "m", "ixx": "kg*m^2", "ixy": "kg*m^2", "ixz": "kg*m^2",
                              "iyy": "kg*m^2", "iyz": "kg*m^2", "izz": "kg*m^2"},
    "sensor_msgs/Imu": {"angular_velocity": "rad/s", "linear_acceleration": "m/s^2"},
    "sensor_msgs/MagneticField": {"magnetic_field": "T"},
    "sensor_msgs/NavSatFix": {"latitude": "deg", "longitude": "deg", "altitude": "m", "position_covariance": "m^2"},
    "sensor_msgs/LaserScan": {"angle_min": "rad", "angle_max": "rad", "angle_increment": "rad", "time_increment": "s",
                              "scan_time": "s", "range_min": "m", "range_max": "m", "ranges": "m"},
    "sensor_msgs/Range": {"field_of_view": "rad", "min_range": "m", "max_range": "m", "range": "m", "variance": "m^2"},
    "sensor_msgs/Temperature": {"temperature": "degC"},
    "sensor_msgs/FluidPressure": {"fluid_pressure": "Pa", "variance": "Pa^2"},
    "sensor_msgs/Illuminance": {"illuminance": "lx"},
    "sensor_msgs/BatteryState": {"voltage": "V", "temperature": "degC", "current": "A", "charge": "A*h",
                                 "capacity": "A*h", "design_capacity": "A*h"},
}  # fmt: skip
"""Unit of a member by its type's name; one of a member that is a message holds for all values in it."""

_BRACKETS = re.compile(r"[\[(](m|mm|cm|km|rad|deg|s|ms|us|ns|Hz|kg|N|Pa|V|A|W|K|T|%|[a-zA-Z]+[/*][a-zA-Z/*^0-9]+)[\])]")
_WORDS = re.compile(r"\[(seconds|meters|radians|degrees|volts|amperes)\]")
_SYMBOLS = {"seconds": "s", "meters": "m", "radians": "rad", "degrees": "deg", "volts": "V", "amperes": "A"}


class Note(NamedTuple):
    """What a column means."""

    unit: str
    """Empty if nothing says it; "1" for a number without one."""
    meaning: str


_TIMES = {
    LOG_TIME: Note("ns", "when the recorder received the message, since 1970-01-01 00:00 UTC"),
    PUBLISH_TIME: Note("ns", "when the message was sent, or, where the bag does not say it, the log time"),
}


def column_notes(name: str, text: str) -> dict[str, Note]:
    """Notes by the dotted paths of a type's values; only those of the times if its definition is not understood."""
    notes = dict(_TIMES)
    try:
        texts = definitions_by_name(name, "ros2msg", text)
        _describe(texts, short_name(name), "", "", notes, 0)
    except UndecodableError:
        return dict(_TIMES)
    return notes


def _describe(
    texts: dict[str, str], kind: str, prefix: str, inherited: str, notes: dict[str, Note], depth: int
) -> None:
    comments: list[str] = []
    for line in texts[kind].splitlines():
        stripped = line.strip()
        if stripped.startswith("#"):
            comments.append(stripped.strip("# \t"))
            continue
        member = parse_line(line) if stripped else None
        if member is not None:
            meaning = " ".join([*comments, *_trailing(line)]).strip()
            unit = inherited or UNITS.get(kind, {}).get(member.path, "") or _unit_in(meaning)
            path, inner = prefix + member.path, str(member.element)
            notes[path] = Note(unit, meaning)
            if member.is_sequence:
                notes[f"len({path})"] = Note("1", f"number of elements of {path}")
            if inner not in (*PRIMITIVES, STRING, WSTRING) and depth < _MAX_DEPTH:
                _describe(texts, resolve_type(texts, inner, kind), f"{path}.", unit, notes, depth + 1)
        comments = []


def _trailing(line: str) -> list[str]:
    _, mark, comment = line.partition("#")
    return [comment.strip("# \t")] if mark else []


def _unit_in(comment: str) -> str:
    """The unit that a comment names in brackets, empty if it names none or several."""
    found = {*_BRACKETS.findall(comment), *(_SYMBOLS[word] for word in _WORDS.findall(comment))}
    return found.pop() if len(found) == 1 else ""
